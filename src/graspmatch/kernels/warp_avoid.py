"""Backing a hand off until it is free, and closing its fingers, for all candidates at once, on CPU and CUDA.

On CUDA a warp works on one candidate, each of its lanes on a share of the points; on a CPU one thread has them all.

Legend: group 32 blocks, near those of them that matter, i candidate, g its preshape, T its pose, x a point of the
scene, u = A x + b the same in node units, levels the bounds that `warp_blocks` looks it up in, d way back.
"""

import warp as wp

from graspmatch.kernels.warp_arrival import arrival_at
from graspmatch.kernels.warp_blocks import (
    BLOCK,
    bits_below,
    block_point,
    blocks_near,
    lane_min,
    lanes,
    level_of,
    lowest_bit,
    points_below,
)
from graspmatch.kernels.warp_fields import (
    NEVER,
    FieldStack,
    interpolate_at,
    is_inside,
    node_offset,
    place_of,
    to_node_units,
    turn_of,
)
from graspmatch.kernels.warp_queue import Queue, take

wp.set_module_options({"enable_backward": False, "fast_math": False})


FAR = wp.constant(1.0e3)
"""Points outside of a grid count however far they are, up to this [m]."""


@wp.func
def way_back(
    corridor: FieldStack,
    points: wp.array(dtype=wp.float32),
    balls: wp.array(dtype=wp.float32),
    levels: wp.array(dtype=wp.int32),
    level_step: float,
    blocks: int,
    back: wp.vec3,
    clearance: float,
    step: float,
    g: int,
    T: wp.mat44,
    least: float,
    most: float,
) -> float:
    """Smallest way back along the approach from which hand and approach keep their clearance; above the most if none.

    The way back only ever grows from point to point, so one pass over the scene finds it: what is clear of the way in
    stays clear of it, but for the stretch that backing off adds at its start. `least` is what is known to be needed,
    `back` the direction back in node units.
    """
    A = to_node_units(corridor, T)
    b = node_offset(corridor, g, A, T)
    limit = level_of(clearance, level_step)
    d = least
    group = int(0)
    while group * BLOCK < blocks and d <= most:
        left = ~wp.uint32(0)
        looked = float(-1.0)
        near = wp.uint32(0)
        while left != wp.uint32(0) and d <= most:
            if d > looked:
                moved = b + d * back
                near = blocks_near(clearance, FAR, corridor, levels, level_step, g, A, moved, balls, group, blocks)
                looked = d
            near = near & left
            left = wp.uint32(0)
            if near != wp.uint32(0):
                n = lowest_bit(near)
                left = ~bits_below(n + 1)
                block = group * BLOCK + n
                mask = points_below(limit, corridor, levels, g, A, b + d * back, points, block)
                while mask != wp.uint32(0):
                    u = A * block_point(points, block, lowest_bit(mask)) + b
                    mask = mask & (mask - wp.uint32(1))
                    while d <= most and is_near(corridor, g, u + d * back, clearance):
                        d += step
        group += 1
    return -lane_min(-d)


@wp.kernel
def back_off(
    queue: Queue,
    corridor: FieldStack,
    points: wp.array(dtype=wp.float32),
    balls: wp.array(dtype=wp.float32),
    levels: wp.array(dtype=wp.int32),
    level_step: float,
    blocks: int,
    approach: wp.vec3,
    clearance: float,
    step: float,
    preshape_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.mat44),
    wider: wp.array(dtype=wp.int32),
    least_in: wp.array2d(dtype=wp.float32),
    most: float,
    preshape_out: wp.array(dtype=wp.int32),
    least_out: wp.array(dtype=wp.float32),
    retreat_out: wp.array(dtype=wp.float32),
):
    """Of each candidate's preshape and the wider ones the narrowest with the smallest way back, at most `most`; none is
    looked at beyond the first that needs less than a step. `least_in` has the way that each preshape needs in any case,
    `least_out` the smallest of those that were looked at."""
    i = take(queue, wp.tid() / lanes())
    if i < 0:
        return
    lane = wp.tid() % lanes()
    back = approach / corridor.spacing
    g = preshape_in[i]
    chosen = g
    smallest = float(wp.inf)
    needed = float(wp.inf)
    while g >= 0 and needed >= step:
        least = least_in[i, g]
        smallest = wp.min(smallest, least)
        enough = wp.min(needed, most)  # who needs more is no better
        d = way_back(
            corridor, points, balls, levels, level_step, blocks, back, clearance, step, g, pose_in[i], least, enough
        )
        if d <= enough and d < needed:
            needed = d
            chosen = g
        g = wider[g]
    if lane == 0:
        preshape_out[i] = chosen
        least_out[i] = smallest
        retreat_out[i] = needed


@wp.kernel
def least_distance(
    queue: Queue,
    corridor: FieldStack,
    points: wp.array(dtype=wp.float32),
    balls: wp.array(dtype=wp.float32),
    levels: wp.array(dtype=wp.int32),
    level_step: float,
    blocks: int,
    preshape_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.mat44),
    clearance_out: wp.array(dtype=wp.float32),
):
    """Smallest distance of the scene to the hand and its way in."""
    i = take(queue, wp.tid() / lanes())
    if i < 0:
        return
    g = preshape_in[i]
    A = to_node_units(corridor, pose_in[i])
    b = node_offset(corridor, g, A, pose_in[i])
    smallest = float(1.0e30)
    group = int(0)
    while group * BLOCK < blocks:
        near = blocks_near(smallest, FAR, corridor, levels, level_step, g, A, b, balls, group, blocks)
        while near != wp.uint32(0):
            block = group * BLOCK + lowest_bit(near)
            near = near & (near - wp.uint32(1))
            mask = points_below(level_of(smallest, level_step), corridor, levels, g, A, b, points, block)
            while mask != wp.uint32(0):
                x = block_point(points, block, lowest_bit(mask))
                mask = mask & (mask - wp.uint32(1))
                smallest = wp.min(smallest, interpolate_at(corridor, g, A * x + b))
        group += 1
    clearance_out[i] = lane_min(smallest)


@wp.kernel
def clear_ways(
    queue: Queue,
    corridor: FieldStack,
    points: wp.array(dtype=wp.float32),
    balls: wp.array(dtype=wp.float32),
    levels: wp.array(dtype=wp.int32),
    level_step: float,
    blocks: int,
    corners: wp.array2d(dtype=wp.vec3),
    up: wp.vec3,
    table: float,
    clearance: float,
    error_in: wp.array(dtype=wp.mat44),
    preshape_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.mat44),
    count_out: wp.array(dtype=wp.int32),
):
    """Of some displacements of the hand (`error_in`, in its own frame) how many leave more than a clearance
    to the scene along the way in, and to the table at its end.

    `corners` are those of the hull of each preshape's open hand, `table` its height along `up`.
    """
    i = take(queue, wp.tid() / lanes())
    if i < 0:
        return
    g = preshape_in[i]
    limit = level_of(clearance, level_step)
    count = int(0)
    j = int(0)
    while j < error_in.shape[0]:
        T = pose_in[i] * error_in[j]
        up_hand = wp.transpose(turn_of(T)) * up
        lowest = float(1.0e30)
        for v in range(corners.shape[1]):
            lowest = wp.min(lowest, wp.dot(up_hand, corners[g, v]))
        is_clear = wp.where(lowest + wp.dot(up, place_of(T)) - table > clearance, 1.0, 0.0)
        A = to_node_units(corridor, T)
        b = node_offset(corridor, g, A, T)
        group = int(0)
        while group * BLOCK < blocks and is_clear > 0.0:
            near = blocks_near(clearance, FAR, corridor, levels, level_step, g, A, b, balls, group, blocks)
            while near != wp.uint32(0) and is_clear > 0.0:
                block = group * BLOCK + lowest_bit(near)
                near = near & (near - wp.uint32(1))
                mask = points_below(limit, corridor, levels, g, A, b, points, block)
                while mask != wp.uint32(0):
                    x = block_point(points, block, lowest_bit(mask))
                    mask = mask & (mask - wp.uint32(1))
                    if interpolate_at(corridor, g, A * x + b) <= clearance:
                        is_clear = 0.0
                        mask = wp.uint32(0)
            group += 1
        count += int(lane_min(is_clear))
        j += 1
    count_out[i] = count


@wp.func
def is_near(stack: FieldStack, g: int, u: wp.vec3, distance: float) -> bool:
    return is_inside(u, stack.dims[g]) and interpolate_at(stack, g, u) < distance


@wp.kernel
def first_contact(
    queue: Queue,
    fingers: int,
    arrival: FieldStack,
    points: wp.array(dtype=wp.float32),
    balls: wp.array(dtype=wp.float32),
    levels: wp.array(dtype=wp.int32),
    level_step: float,
    swept: wp.array(dtype=wp.int32),
    swept_step: float,
    first_block: int,
    end_block: int,
    preshape_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.mat44),
    fraction_out: wp.array(dtype=wp.float32),
):
    """For each finger the closing fraction at which it meets the first scene point; `NEVER` if there is none. `swept`
    has the levels of how far each node is from what the finger sweeps."""
    i = take(queue, wp.tid() / lanes())
    if i < 0:
        return
    A = to_node_units(arrival, pose_in[i])
    g = preshape_in[i] * fingers
    b = node_offset(arrival, g, A, pose_in[i])  # the grids of a preshape's fingers lie alike
    f = int(0)
    while f < fingers:
        earliest = float(NEVER)
        group = first_block / BLOCK
        while group * BLOCK < end_block:
            near = blocks_near(0.0, 0.0, arrival, swept, swept_step, g + f, A, b, balls, group, end_block)
            near = near & ~bits_below(first_block - group * BLOCK)
            while near != wp.uint32(0):
                block = group * BLOCK + lowest_bit(near)
                near = near & (near - wp.uint32(1))
                limit = wp.min(level_of(earliest, level_step), 255)  # the last level is that of cells never swept
                mask = points_below(limit, arrival, levels, g + f, A, b, points, block)
                while mask != wp.uint32(0):
                    x = block_point(points, block, lowest_bit(mask))
                    mask = mask & (mask - wp.uint32(1))
                    earliest = wp.min(earliest, arrival_at(arrival, g + f, A * x + b))
            group += 1
        fraction_out[i * fingers + f] = lane_min(earliest)
        f += 1
