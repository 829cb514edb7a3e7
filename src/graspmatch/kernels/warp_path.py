"""Whether a hand that moves on a straight line meets a point of the scene, for all candidates at once, on CPU and CUDA.

On CUDA a warp works on one candidate, each of its lanes on a share of the points; on a CPU one thread has them all.

Legend: i candidate, g its preshape, x a point of the scene, u = A x + b the same in node units, v the
way of that point as the hand sees it, in node units, s how far along it from 0 to 1, lower and upper where that line
enters and leaves the hand's grid.
"""

import warp as wp

from graspmatch.kernels.warp_blocks import BLOCK, block_point, lane_min, lanes
from graspmatch.kernels.warp_fields import FieldStack, interpolate_at, node_offset, to_node_units
from graspmatch.kernels.warp_queue import Queue, take

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.kernel
def way_clearance(
    queue: Queue,
    hand: FieldStack,
    points: wp.array(dtype=wp.float32),
    first_block: int,
    end_block: int,
    enough: float,
    way_in: wp.array(dtype=wp.vec3),
    preshape_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.mat44),
    clearance_out: wp.array(dtype=wp.float32),
):
    """Smallest distance of some blocks of points to the hand anywhere on its way; where no point comes nearer than
    `enough`, that."""
    i = take(queue, wp.tid() / lanes())
    if i < 0:
        return
    g = preshape_in[i]
    A = to_node_units(hand, pose_in[i])
    b = node_offset(hand, g, A, pose_in[i])
    v = -(A * way_in[i])
    smallest = enough
    block = first_block + wp.tid() % lanes()
    while block < end_block:
        n = int(0)
        while n < BLOCK:
            u = A * block_point(points, block, n) + b
            smallest = nearest_on_way(hand, g, u, v, smallest)
            n += 1
        block += lanes()
    clearance_out[i] = lane_min(smallest)


@wp.func
def nearest_on_way(hand: FieldStack, g: int, u: wp.vec3, v: wp.vec3, known: float) -> float:
    """The least distance of the hand to the points u + s v, if it is less than the known one: sphere tracing, for no
    point on the line is nearer than that within a step as long as what is left of the distance."""
    dims = hand.dims[g]
    lower = float(0.0)
    upper = float(1.0)
    for axis in range(3):
        edge = float(dims[axis] - 1)
        if wp.abs(v[axis]) < 1.0e-9:
            if u[axis] < 0.0 or u[axis] > edge:
                upper = -1.0
        else:
            near = -u[axis] / v[axis]
            far = (edge - u[axis]) / v[axis]
            lower = wp.max(lower, wp.min(near, far))
            upper = wp.min(upper, wp.max(near, far))
    length = wp.length(v) * hand.spacing
    smallest = known
    s = lower
    while s <= upper:
        distance = interpolate_at(hand, g, u + s * v)
        smallest = wp.min(smallest, distance)
        s += wp.max(distance - smallest, 0.25 * hand.spacing) / wp.max(length, 1.0e-9)
    return smallest
