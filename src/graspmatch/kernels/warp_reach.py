"""Which points of an object the fingers and the palm of a hand can touch when it closes, for CPU and CUDA.

Legend: i grasp, o index of a point of the object, k its place among those that a finger can reach; R, shift turn and
place of the body in the gripper frame; p preshape, f finger, g what touches (the fingers, then palm).
"""

import warp as wp

from graspmatch.kernels.warp_blocks import BLOCK, FAR, level_of, lowest_bit, points_below
from graspmatch.kernels.warp_fields import FieldStack

wp.set_module_options({"enable_backward": False, "fast_math": False})

PALM_TOUCHES = 0.002
"""Points nearer to the palm than this touch it [m]."""


@wp.struct
class Body:
    """The object, turned as the world is; origin at the centre of mass."""

    points: wp.array(dtype=wp.vec3)
    blocks: wp.array(dtype=wp.float32)
    """The same as `warp_blocks` has them."""
    normals: wp.array(dtype=wp.vec3)
    is_edge: wp.array(dtype=wp.int32)
    """Whether a point is beside an edge: what touches there pushes along no normal of the object's alone."""
    beyond: wp.array(dtype=wp.float32)
    """How far each point is from what was seen of the object [m]."""
    corners: wp.array(dtype=wp.vec3)
    """Those that can lie on a plane."""
    down: wp.vec3
    table: wp.float32
    """Height of the table, against `down` [m]; far below where there is none."""


@wp.struct
class Hand:
    """What can touch of all preshapes, gripper frame."""

    arrival: FieldStack
    """One grid for each finger of each preshape."""
    arrival_levels: wp.array(dtype=wp.int32)
    arrival_step: wp.float32
    """Between levels."""
    slowest: wp.array(dtype=wp.float32)
    """For each grid the closing fraction that hardly any part of the finger's surface takes for a metre [1/m]."""
    distance: FieldStack
    """Signed distance of the open hand, about its pivot."""
    distance_levels: wp.array(dtype=wp.int32)
    distance_step: wp.float32
    out_of_reach: wp.array(dtype=wp.int32)
    """Of those grids, for each node a byte that is zero where a point can be touched."""
    swept_levels: wp.array(dtype=wp.int32)
    """Of the distance of each node of `arrival` from those that the finger sweeps, in the same steps."""
    room: wp.float32
    """Points farther from where fingers sweep are not touched, even if the object is pushed [m]."""
    pivot: wp.array(dtype=wp.vec3)
    approach: wp.vec3


@wp.struct
class Reached:
    """Scratch: the points of each grasp that each finger can reach, the palm, and, last, any of them; and of the first
    the few near to it."""

    index: wp.array3d(dtype=wp.int32)
    blocks: wp.array3d(dtype=wp.float32)
    """Where they are in the body, as `warp_blocks` has them, ..."""
    size: wp.array2d(dtype=wp.int32)
    """... and how many that are."""
    count: wp.array2d(dtype=wp.int32)
    """Of those near to each, ..."""
    near: wp.array3d(dtype=wp.int32)
    """... their places among those that it can reach, ..."""
    excess: wp.array3d(dtype=wp.float32)
    """... how far from touching they are: for a start closing fractions, then distances [m], ..."""
    slowness: wp.array4d(dtype=wp.float32)
    """... and along the way of a finger's surface the closing fraction that it takes there for each node: x, y, z and
    its length."""


@wp.func
def gather(i: int, p: int, R: wp.mat33, shift: wp.vec3, body: Body, hand: Hand, reached: Reached):
    """Note the points that the hand can reach, at most as many as there is room for, and of these those of each finger
    and of the palm."""
    spacing = hand.distance.spacing
    A = R / spacing
    b = (shift - hand.pivot[p] - hand.distance.origin[p]) / spacing
    fingers = reached.slowness.shape[1]
    every = fingers + 1
    node = b + wp.vec3(0.5, 0.5, 0.5)  # the nearest
    count = int(0)
    block = int(0)
    while block < body.blocks.shape[0] // (3 * BLOCK):
        mask = points_below(1, hand.distance, hand.out_of_reach, p, A, node, body.blocks, block)
        while mask != wp.uint32(0):
            if count < reached.index.shape[2]:
                put_in_block(i, every, count, block * BLOCK + lowest_bit(mask), body, reached)
                count += 1
            mask = mask & (mask - wp.uint32(1))
        block += 1
    fill_up(i, every, count, reached)
    limit = level_of(hand.room, hand.distance_step)
    for f in range(fingers):
        finger = p * fingers + f
        b_finger = (shift - hand.arrival.origin[finger]) / hand.arrival.spacing
        gather_of(
            i, f, limit, hand.arrival, hand.swept_levels, finger, R / hand.arrival.spacing, b_finger, body, reached
        )
    limit = level_of(hand.room + PALM_TOUCHES, hand.distance_step)
    gather_of(i, fingers, limit, hand.distance, hand.distance_levels, p, A, b, body, reached)


@wp.func
def gather_of(
    i: int,
    g: int,
    limit: int,
    stack: FieldStack,
    levels: wp.array(dtype=wp.int32),
    grid: int,
    A: wp.mat33,
    b: wp.vec3,
    body: Body,
    reached: Reached,
):
    """Of the points that the hand can reach, note for g those in cells whose level is below the limit."""
    every = reached.index.shape[1] - 1
    count = int(0)
    for block in range(blocks_of(i, every, reached)):
        mask = points_below(limit, stack, levels, grid, A, b, reached.blocks[i, every], block)
        while mask != wp.uint32(0):
            k = block * BLOCK + lowest_bit(mask)
            if k < reached.size[i, every]:  # not what fills up the last block
                put_in_block(i, g, count, reached.index[i, every, k], body, reached)
                count += 1
            mask = mask & (mask - wp.uint32(1))
    fill_up(i, g, count, reached)


@wp.func
def put_in_block(i: int, g: int, k: int, o: int, body: Body, reached: Reached):
    """A point of the body as the k-th of g."""
    x = body.points[o]
    reached.index[i, g, k] = o
    first = k // BLOCK * 3 * BLOCK + k % BLOCK
    for axis in range(3):
        reached.blocks[i, g, first + axis * BLOCK] = x[axis]


@wp.func
def fill_up(i: int, g: int, count: int, reached: Reached):
    """Note how many points g has, and fill up the last block with points far away."""
    reached.size[i, g] = count
    for k in range(count, blocks_of(i, g, reached) * BLOCK):
        first = k // BLOCK * 3 * BLOCK + k % BLOCK
        for axis in range(3):
            reached.blocks[i, g, first + axis * BLOCK] = FAR


@wp.func
def blocks_of(i: int, g: int, reached: Reached) -> int:
    """How many blocks the points of g fill."""
    return (reached.size[i, g] + BLOCK - 1) // BLOCK
