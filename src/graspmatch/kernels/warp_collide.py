"""The hand as matching sees it, what is around it, and how they get out of each other, for CPU and CUDA.

Legend as in `warp_match`: g preshape, R rotation, p position of the pivot, x point of the scene, u = A x + b the same
in node units of the hand's field; s sample, y = R^T (x - p) that point in the hand's frame, about the pivot.
"""

import warp as wp

from graspmatch.kernels.warp_blocks import (
    BLOCK,
    bits_below,
    block_point,
    blocks_near,
    lane_sum,
    lane_sum_of,
    lanes,
    lowest_bit,
    points_below,
    points_under,
)
from graspmatch.kernels.warp_fields import FieldStack, interpolate_at

FLAGS = f"{wp.config.cpu_compiler_flags or '-march=native'} -mreassociate"
"""For the CPU: sums of floats may be vectorised, and so be added up in another order."""
wp.set_module_options({"enable_backward": False, "fast_math": False, "cpu_compiler_flags": FLAGS})

Pull = wp.types.vector(length=7, dtype=wp.float32)
"""Sums over some points: of what they pull at the position and at the rotation, and how many do."""


@wp.struct
class Hand:
    """What the matching asks of all preshapes: samples one behind the other, fields as stacks."""

    samples: wp.array(dtype=wp.vec3)
    weights: wp.array(dtype=wp.float32)
    start: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    tool_centre_point: wp.array(dtype=wp.vec3)
    inverse_inertia: wp.array(dtype=wp.mat33)
    distance: FieldStack
    distance_step: wp.float32
    """Between its levels [m]."""
    nearest_sample: wp.array(dtype=wp.int32)
    outline_start: wp.array(dtype=wp.int32)
    """First block of its corners."""
    outline_count: wp.array(dtype=wp.int32)
    """Number of its corners."""


@wp.struct
class Surroundings:
    """C of the paper but for the coordinates of its points: so many blocks of them, first those of the target, then
    those of obstacles, and the table as the plane normal . x = offset."""

    blocks: wp.int32
    target_blocks: wp.int32
    normal: wp.vec3
    offset: wp.float32
    has_table: wp.int32


@wp.func
def collision_pass(
    hand: Hand,
    scene: Surroundings,
    points: wp.array(dtype=wp.float32),
    balls: wp.array(dtype=wp.float32),
    outline: wp.array(dtype=wp.float32),
    levels: wp.array(dtype=wp.int32),
    g: int,
    p: wp.vec3,
    R: wp.mat33,
    lane: int,
):
    """Eqs. (12) and (18): the scene in the hand's frame, its points inside the hand, and the pull of a surface of the
    hand towards each. For the target it is the inner surface, so that the object ends up between the fingers. Obstacles
    and table must get out of the hand where they came in: the nearest surface, the corner that is below."""
    gt = wp.vec3(0.0, 0.0, 0.0)
    gw = wp.vec3(0.0, 0.0, 0.0)
    colliding = int(0)
    field = hand.distance
    A = wp.transpose(R) / field.spacing
    b = -(A * p) - field.origin[g] / field.spacing
    group = int(0)
    while group * BLOCK < scene.blocks:
        near = blocks_near(0.0, 0.0, field, levels, hand.distance_step, g, A, b, balls, group, scene.blocks)
        while near != wp.uint32(0):
            block = group * BLOCK + lowest_bit(near)
            near = near & (near - wp.uint32(1))
            mask = points_below(1, field, levels, g, A, b, points, block)
            if block < scene.target_blocks:
                pull = pull_inwards(
                    mask,
                    field.values,
                    field.start[g],
                    field.dims[g],
                    field.spacing,
                    field.origin[g],
                    hand.nearest_sample,
                    hand.samples,
                    hand.start[g],
                    A,
                    b,
                    points,
                    3 * BLOCK * block,
                )
            else:
                pull = push_outwards(mask, field, g, A, b, points, block)
            gt += wp.vec3(pull[0], pull[1], pull[2])
            gw += wp.vec3(pull[3], pull[4], pull[5])
            colliding += int(pull[6])
        group += 1
    gt = R * gt
    gw = R * gw
    if scene.has_table != 0:
        up = wp.transpose(R) * scene.normal
        level = scene.offset - wp.dot(scene.normal, p)  # of the table above the pivot
        corners = hand.outline_count[g]
        block = lane
        while block * BLOCK < corners:
            corner = hand.outline_start[g] + block
            mask = points_under(up, level, outline, corner) & bits_below(corners - block * BLOCK)
            while mask != wp.uint32(0):
                s = block_point(outline, corner, lowest_bit(mask))
                mask = mask & (mask - wp.uint32(1))
                height = wp.dot(up, s) - level
                gt += height * scene.normal
                gw += height * wp.cross(R * s, scene.normal)
                colliding += 1
            block += lanes()
    colliding = int(lane_sum(float(colliding)))
    scale = 1.0 / float(wp.max(colliding, 1))
    return scale * lane_sum_of(gt), scale * lane_sum_of(gw), colliding


@wp.func_native("""
    const float* x = points.data + first;
    const float* grid = values.data + start;
    const int* nearest_sample = nearest.data + start;
    const float* sample = (const float*)samples.data + 3 * first_sample;
    const int dx = dims[1] * dims[2], dy = dims[2];
    float t0 = 0.0f, t1 = 0.0f, t2 = 0.0f, w0 = 0.0f, w1 = 0.0f, w2 = 0.0f, inside = 0.0f;
    for (; mask != 0; mask &= mask - 1) {
#if defined(__CUDA_ARCH__)
        int n = __ffs(mask) - 1;
#else
        int n = __builtin_ctz(mask);
#endif
        float u0 = A.data[0][0] * x[n] + A.data[0][1] * x[32 + n] + A.data[0][2] * x[64 + n] + b[0];
        float u1 = A.data[1][0] * x[n] + A.data[1][1] * x[32 + n] + A.data[1][2] * x[64 + n] + b[1];
        float u2 = A.data[2][0] * x[n] + A.data[2][1] * x[32 + n] + A.data[2][2] * x[64 + n] + b[2];
        int i = wp::min(wp::max((int)u0, 0), dims[0] - 2);
        int j = wp::min(wp::max((int)u1, 0), dims[1] - 2);
        int k = wp::min(wp::max((int)u2, 0), dims[2] - 2);
        float f0 = u0 - i, f1 = u1 - j, f2 = u2 - k;
        if (wp::min(wp::min(f0, f1), f2) < 0.0f || wp::max(wp::max(f0, f1), f2) > 1.0f)
            continue;  // outside of the field, where the hand is not
        int at = i * dx + j * dy + k;
        const float* low = grid + at;
        const float* high = low + dx;
        float c00 = low[0] + f0 * (high[0] - low[0]);
        float c01 = low[1] + f0 * (high[1] - low[1]);
        float c10 = low[dy] + f0 * (high[dy] - low[dy]);
        float c11 = low[dy + 1] + f0 * (high[dy + 1] - low[dy + 1]);
        float c0 = c00 + f1 * (c10 - c00), c1 = c01 + f1 * (c11 - c01);
        float is_inside = c0 + f2 * (c1 - c0) < 0.0f ? 1.0f : 0.0f;
        at += (f0 < 0.5f ? 0 : dx) + (f1 < 0.5f ? 0 : dy) + (f2 < 0.5f ? 0 : 1);
        const float* s = sample + 3 * nearest_sample[at];
        float y0 = spacing * u0 + origin[0], y1 = spacing * u1 + origin[1], y2 = spacing * u2 + origin[2];
        t0 += is_inside * (s[0] - y0);
        t1 += is_inside * (s[1] - y1);
        t2 += is_inside * (s[2] - y2);
        w0 += is_inside * (s[2] * y1 - s[1] * y2);
        w1 += is_inside * (s[0] * y2 - s[2] * y0);
        w2 += is_inside * (s[1] * y0 - s[0] * y1);
        inside += is_inside;
    }
    wp::vec_t<7, float> sums;
    sums[0] = t0, sums[1] = t1, sums[2] = t2, sums[3] = w0, sums[4] = w1, sums[5] = w2, sums[6] = inside;
    return sums;
""")
def pull_inwards(
    mask: wp.uint32,
    values: wp.array(dtype=wp.float32),
    start: int,
    dims: wp.vec3i,
    spacing: float,
    origin: wp.vec3,
    nearest: wp.array(dtype=wp.int32),
    samples: wp.array(dtype=wp.vec3),
    first_sample: int,
    A: wp.mat33,
    b: wp.vec3,
    points: wp.array(dtype=wp.float32),
    first: int,
) -> Pull:
    """Of those points of a block that lie inside the hand: r = s - y and s x r = -s x y, where s is the sample nearest
    to the node next to the point. In C++, on plain pointers (see `warp_blocks`): it is half of all matching."""
    ...


@wp.func
def push_outwards(
    mask: wp.uint32,
    field: FieldStack,
    g: int,
    A: wp.mat33,
    b: wp.vec3,
    points: wp.array(dtype=wp.float32),
    block: int,
) -> Pull:
    """The same of obstacles, which get out where they are least deep: r along the slope of the field, and y x r."""
    gt = wp.vec3(0.0, 0.0, 0.0)
    gw = wp.vec3(0.0, 0.0, 0.0)
    colliding = float(0.0)
    while mask != wp.uint32(0):
        u = A * block_point(points, block, lowest_bit(mask)) + b
        mask = mask & (mask - wp.uint32(1))
        depth = -interpolate_at(field, g, u)
        if depth > 0.0:
            residual = depth * outwards(field, g, u)
            gt += residual
            gw += wp.cross(field.spacing * u + field.origin[g], residual)
            colliding += 1.0
    return Pull(gt[0], gt[1], gt[2], gw[0], gw[1], gw[2], colliding)


@wp.func
def outwards(stack: FieldStack, g: int, u: wp.vec3) -> wp.vec3:
    """Direction in which a distance field grows, at a position in node units."""
    dx = wp.vec3(0.5, 0.0, 0.0)
    dy = wp.vec3(0.0, 0.5, 0.0)
    dz = wp.vec3(0.0, 0.0, 0.5)
    return wp.normalize(
        wp.vec3(
            interpolate_at(stack, g, u + dx) - interpolate_at(stack, g, u - dx),
            interpolate_at(stack, g, u + dy) - interpolate_at(stack, g, u - dy),
            interpolate_at(stack, g, u + dz) - interpolate_at(stack, g, u - dz),
        )
    )
