"""Where closing fingers, palm and table touch an object between them, for CPU and CUDA.

Legend: i grasp, o index of a point of the object, k its place among those near to what touches; R, p turn
and shift of the body into the gripper frame; x point there, u the same in node units, n outward normal; p preshape, f
finger, g what touches (the fingers, then palm, then table); t closing fraction at which a finger covers a point: its
level sets are the finger's surface on its way.
"""

import warp as wp

from graspmatch.kernels.warp_avoid import arrival_at
from graspmatch.kernels.warp_blocks import BLOCK, FAR, level_of, lowest_bit, points_below
from graspmatch.kernels.warp_fields import NEVER, FieldStack, interpolate, node_units
from graspmatch.kernels.warp_wrench import Contacts

wp.set_module_options({"enable_backward": False, "fast_math": False})

LATE = 0.25
"""Closing fraction after a finger's first contact in which it goes much farther than a contact patch is deep."""
FACING_FIRST = 0.2
"""Cosine between the way of a finger and its push on a point, at least, for a first contact ..."""
FACING = 0.5
"""... and for the rest of the patch: beside an edge of the object, the other face is not touched."""
PALM_FACING = 0.5
"""The same for the approach and what the palm touches."""
SAME_FACE = 0.8
"""Cosine between the normals of a face and of a point on its edge."""
PALM_TOUCHES = 0.002
"""Points nearer to the palm than this touch it [m]."""
PALM_WAY = 0.006
"""... if it comes nearer by half of this, so far straight back along the approach: else it is beside them [m]."""
TABLE_TOUCHES = 0.0015
"""Points lower above the table than this lie on it [m]."""


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
    distance: FieldStack
    """Signed distance of the open hand, about its pivot."""
    distance_levels: wp.array(dtype=wp.int32)
    distance_step: wp.float32
    out_of_reach: wp.array(dtype=wp.int32)
    """Of those grids, for each node a byte that is zero where a point can be touched."""
    pivot: wp.array(dtype=wp.vec3)
    approach: wp.vec3


@wp.struct
class Reached:
    """Scratch: the points of each grasp that its hand can reach, and of these the few near to each finger and palm."""

    index: wp.array2d(dtype=wp.int32)
    blocks: wp.array2d(dtype=wp.float32)
    """Where they are in the body, as `warp_blocks` has them."""
    count: wp.array2d(dtype=wp.int32)
    """Of those near to each, ..."""
    near: wp.array3d(dtype=wp.int32)
    """... their indices, ..."""
    excess: wp.array3d(dtype=wp.float32)
    """... and how far from touching they are: for a start closing fractions, then distances [m]."""


@wp.func
def node_value(stack: FieldStack, g: int, i: int, j: int, k: int) -> float:
    dims = stack.dims[g]
    return stack.values[stack.start[g] + (i * dims[1] + j) * dims[2] + k]


@wp.func
def slope(before: float, here: float, after: float) -> float:
    """Central difference; one-sided where the finger never gets to one side."""
    if before < NEVER and after < NEVER:
        return 0.5 * (after - before)
    if after < NEVER:
        return after - here
    if before < NEVER:
        return here - before
    return 0.0


@wp.func
def slowness(stack: FieldStack, g: int, x: wp.vec3) -> wp.vec3:
    """Along the way of a finger's surface, the closing fraction that it takes for each metre there [1/m]: the gradient
    of its field."""
    dims = stack.dims[g]
    u = node_units(stack, g, x)
    i = wp.clamp(int(u[0] + 0.5), 1, dims[0] - 2)
    j = wp.clamp(int(u[1] + 0.5), 1, dims[1] - 2)
    k = wp.clamp(int(u[2] + 0.5), 1, dims[2] - 2)
    here = node_value(stack, g, i, j, k)
    if here >= NEVER:
        return wp.vec3(0.0, 0.0, 0.0)
    gradient = wp.vec3(
        slope(node_value(stack, g, i - 1, j, k), here, node_value(stack, g, i + 1, j, k)),
        slope(node_value(stack, g, i, j - 1, k), here, node_value(stack, g, i, j + 1, k)),
        slope(node_value(stack, g, i, j, k - 1), here, node_value(stack, g, i, j, k + 1)),
    )
    return gradient / stack.spacing


@wp.func
def is_before_palm(stack: FieldStack, g: int, x: wp.vec3, gap: float, approach: wp.vec3) -> bool:
    """Whether the hand is straight back along the approach, not beside the point."""
    return interpolate(stack, g, x - PALM_WAY * approach) < gap - 0.5 * PALM_WAY


@wp.func
def across(n: wp.vec3) -> wp.vec3:
    """A unit vector perpendicular to n."""
    hint = wp.where(wp.abs(n[0]) > 0.9, wp.vec3(0.0, 1.0, 0.0), wp.vec3(1.0, 0.0, 0.0))
    return wp.normalize(wp.cross(n, hint))


@wp.func
def push_at(grid: int, x: wp.vec3, n: wp.vec3, is_edge: int, face: wp.vec3, hand: Hand) -> wp.vec3:
    """Direction in which a finger pushes a point: against the normal; beside an edge, where it may be any between those
    of the faces, along the middle of that and the finger's way, unless the finger lies on a `face` with that normal
    (zero where it lies on none).
    `grid` is the finger's; the palm has none (-1)."""
    push = -n
    if grid >= 0 and is_edge == 1 and wp.dot(n, face) <= SAME_FACE:
        way = slowness(hand.arrival, grid, x)
        push = wp.normalize(push + way / wp.max(wp.length(way), 1.0e-3))
    return push


@wp.func
def spread_patch(
    i: int,
    g: int,
    grid: int,
    start: int,
    face: wp.vec3,
    R: wp.mat33,
    shift: wp.vec3,
    tolerance: float,
    body: Body,
    hand: Hand,
    reached: Reached,
    contacts: Contacts,
):
    """Contacts of g: `start`, and of the points near it whose excess is within the tolerance those farthest along two
    axes; all by their indices."""
    x0 = R * body.points[start] + shift
    n0 = R * body.normals[start]
    contacts.point[i, g, 0] = x0
    contacts.push[i, g, 0] = push_at(grid, x0, n0, body.is_edge[start], face, hand)
    a = across(n0)
    b = wp.cross(n0, a)
    reach = wp.vec4(0.0, 0.0, 0.0, 0.0)
    corner = wp.vec4i(start, start, start, start)
    for k in range(reached.count[i, g]):
        if reached.excess[i, g, k] <= tolerance:
            o = reached.near[i, g, k]
            x = R * body.points[o] + shift - x0
            along = wp.vec2(wp.dot(x, a), wp.dot(x, b))
            for s in range(4):
                value = along[s // 2] * wp.where(s % 2 == 0, 1.0, -1.0)
                if value > reach[s]:
                    reach[s] = value
                    corner[s] = o
    found = int(1)
    beyond = body.beyond[start]
    for s in range(4):
        o = corner[s]
        is_new = o != start
        for r in range(s):
            is_new = is_new and corner[r] != o
        if is_new:
            x = R * body.points[o] + shift
            contacts.point[i, g, found] = x
            contacts.push[i, g, found] = push_at(grid, x, R * body.normals[o], body.is_edge[o], face, hand)
            beyond += body.beyond[o]
            found += 1
    contacts.count[i, g] = found
    contacts.beyond[i, g] = beyond / float(found)


@wp.func
def gather(i: int, p: int, R: wp.mat33, shift: wp.vec3, body: Body, hand: Hand, reached: Reached) -> int:
    """Note the points that the hand can reach, at most as many as there is room for, and say how many blocks they
    fill."""
    spacing = hand.distance.spacing
    b = (shift - hand.pivot[p] - hand.distance.origin[p]) / spacing + wp.vec3(0.5, 0.5, 0.5)  # the nearest node
    count = int(0)
    block = int(0)
    while block < body.blocks.shape[0] // (3 * BLOCK):
        mask = points_below(1, hand.distance, hand.out_of_reach, p, R / spacing, b, body.blocks, block)
        while mask != wp.uint32(0):
            if count < reached.index.shape[1]:
                o = block * BLOCK + lowest_bit(mask)
                reached.index[i, count] = o
                put_in_block(reached.blocks, i, count, body.points[o])
                count += 1
            mask = mask & (mask - wp.uint32(1))
        block += 1
    blocks = (count + BLOCK - 1) // BLOCK
    for rest in range(count, blocks * BLOCK):
        put_in_block(reached.blocks, i, rest, wp.vec3(FAR, FAR, FAR))
    return blocks


@wp.func
def put_in_block(blocks: wp.array2d(dtype=wp.float32), i: int, k: int, x: wp.vec3):
    """Coordinates of the k-th point of a row of blocks."""
    first = k // BLOCK * 3 * BLOCK + k % BLOCK
    for axis in range(3):
        blocks[i, first + axis * BLOCK] = x[axis]


@wp.func
def touch_table(i: int, g: int, R: wp.mat33, shift: wp.vec3, floor: float, up: wp.vec3, body: Body, contacts: Contacts):
    """Up to four corners that lie on the table: the lowest, and those farthest from it and from one another."""
    lowest = float(1.0e30)
    x0 = wp.vec3()
    for c in range(body.corners.shape[0]):
        x = R * body.corners[c] + shift
        height = wp.dot(up, x)
        if height < lowest:
            lowest = height
            x0 = x
    contacts.count[i, g] = 0
    if lowest - floor <= TABLE_TOUCHES:
        contacts.point[i, g, 0] = x0
        contacts.push[i, g, 0] = up
        a = across(up)
        b = wp.cross(up, a)
        reach = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for s in range(4):
            contacts.point[i, g, 1 + s] = x0
            contacts.push[i, g, 1 + s] = up
        for c in range(body.corners.shape[0]):
            x = R * body.corners[c] + shift
            if wp.dot(up, x) <= wp.max(lowest, floor) + TABLE_TOUCHES:
                along = wp.vec2(wp.dot(x - x0, a), wp.dot(x - x0, b))
                for s in range(4):
                    value = along[s // 2] * wp.where(s % 2 == 0, 1.0, -1.0)
                    if value > reach[s]:
                        reach[s] = value
                        contacts.point[i, g, 1 + s] = x
        contacts.count[i, g] = 5


@wp.func
def note_near(i: int, g: int, o: int, excess: float, reached: Reached):
    """One more point that is near to a finger or the palm."""
    k = reached.count[i, g]
    reached.near[i, g, k] = o
    reached.excess[i, g, k] = excess
    reached.count[i, g] = k + 1


@wp.func
def touch(
    i: int,
    p: int,
    blocks: int,
    R: wp.mat33,
    shift: wp.vec3,
    tolerance: float,
    body: Body,
    hand: Hand,
    reached: Reached,
    fraction: wp.array2d(dtype=wp.float32),
    contacts: Contacts,
):
    """For each finger the fraction at which it first touches, and the contacts of its patch: of the points within
    `tolerance` [m] of its surface by then, up to five. And those of the palm, if the object touches it."""
    fingers = fraction.shape[1]
    grid = p * fingers  # all fingers of a preshape have grids of one shape
    palm_start = int(-1)
    palm_gap = float(PALM_TOUCHES)
    for f in range(fingers):
        fraction[i, f] = NEVER
        contacts.count[i, f] = -1  # for now, which point it is
    for g in range(fingers + 1):
        reached.count[i, g] = 0
    points = reached.blocks[i]
    A = R / hand.arrival.spacing
    b = (shift - hand.arrival.origin[grid]) / hand.arrival.spacing
    b_palm = (shift - hand.pivot[p] - hand.distance.origin[p]) / hand.distance.spacing
    block = int(0)
    while block < blocks:
        for f in range(fingers):
            # the last level is that of cells never swept
            limit = wp.min(level_of(fraction[i, f] + LATE, hand.arrival_step), 255)
            mask = points_below(limit, hand.arrival, hand.arrival_levels, grid + f, A, b, points, block)
            while mask != wp.uint32(0):
                o = reached.index[i, block * BLOCK + lowest_bit(mask)]
                mask = mask & (mask - wp.uint32(1))
                x = R * body.points[o] + shift
                t = arrival_at(hand.arrival, grid + f, node_units(hand.arrival, grid + f, x))
                if t < wp.min(fraction[i, f] + LATE, NEVER):
                    note_near(i, f, o, t, reached)
                if t < fraction[i, f]:
                    way = slowness(hand.arrival, grid + f, x)
                    if -wp.dot(R * body.normals[o], way) >= FACING_FIRST * wp.length(way):
                        fraction[i, f] = t
                        contacts.count[i, f] = o
        limit = level_of(PALM_TOUCHES + tolerance, hand.distance_step)
        mask = points_below(limit, hand.distance, hand.distance_levels, p, A, b_palm, points, block)
        while mask != wp.uint32(0):
            o = reached.index[i, block * BLOCK + lowest_bit(mask)]
            mask = mask & (mask - wp.uint32(1))
            if wp.dot(R * body.normals[o], hand.approach) < -PALM_FACING:
                x = R * body.points[o] + shift - hand.pivot[p]
                gap = interpolate(hand.distance, p, x)
                if gap > PALM_TOUCHES or is_before_palm(hand.distance, p, x, gap, hand.approach):
                    note_near(i, fingers, o, gap, reached)
                    if gap <= palm_gap:
                        palm_gap = gap
                        palm_start = o
        block += 1
    for f in range(fingers):
        start = contacts.count[i, f]
        on_face = int(-1)
        nearest = float(tolerance)
        contacts.count[i, f] = 0
        if fraction[i, f] <= 1.0:
            for k in range(reached.count[i, f]):  # from fractions to distances
                o = reached.near[i, f, k]
                late = reached.excess[i, f, k] - fraction[i, f]
                if late < LATE:
                    way = slowness(hand.arrival, grid + f, R * body.points[o] + shift)
                    if o != start and -wp.dot(R * body.normals[o], way) < FACING * wp.length(way):
                        late = float(NEVER)
                    else:
                        late = late / wp.max(wp.length(way), 1.0e-3)
                reached.excess[i, f, k] = late
                if late <= nearest and body.is_edge[o] == 0:
                    nearest = late
                    on_face = o
            face = wp.vec3(0.0, 0.0, 0.0)
            if on_face >= 0:
                start = on_face
                face = R * body.normals[on_face]
            spread_patch(i, f, grid + f, start, face, R, shift, tolerance, body, hand, reached, contacts)
    contacts.count[i, fingers] = 0
    if palm_start >= 0:
        spread_patch(
            i, fingers, -1, palm_start, hand.approach, R, shift, palm_gap + tolerance, body, hand, reached, contacts
        )
