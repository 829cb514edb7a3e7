"""Clouds in blocks of 32 points, and which points of a block can matter to a hand, for CPU and CUDA.

Most points of a scene are far from the hand. A byte for each cell of a hand's field bounds its values from below; a
block of points is looked up there in one loop that a CPU runs as vector instructions, and what may lie below the limit
comes out as the bits of one word. Only those points are then looked at exactly.

Three things let the compiler vectorise the loop: a block has first all x, then all y, then all z; what the loop sums is
an integer; and it is written in C++, on plain pointers. Arrays of Warp have a stride that is known only when the kernel
runs, so that loops over them gather one by one what lies side by side.

Most blocks are far from the hand, too. Each lies in a ball, and 32 balls are looked up like the points of a block
before any of their points are.

On CUDA the 32 lanes of a warp share the blocks of one hand out among them; on a CPU one thread has them all. (Tiles
would do the same, but on a CPU they share memory between threads.)

Legend: u = A x + b a point in node units, level the byte of a cell, mask the bits, n a point in its block.
"""

import warp as wp

from graspmatch.kernels.warp_fields import FieldStack

wp.set_module_options({"enable_backward": False, "fast_math": False})

BLOCK = wp.constant(32)
"""Points of a block: the bits of a word."""


FAR = wp.constant(1.0e3)
"""Where the points are that fill up a block [m]."""


LANES = 32
"""Threads of a CUDA warp."""


MOST_BLOCKS = wp.constant(0xFFFFFF)
"""As `POSITIVE`, for blocks."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
""")
def lanes() -> int:
    """How many lanes work on one element."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int apart = 16; apart > 0; apart /= 2)
        value += __shfl_xor_sync(0xffffffffu, value, apart);
#endif
    return value;
""")
def lane_sum(value: float) -> float:
    """The sum over all lanes, known to each of them."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int apart = 16; apart > 0; apart /= 2)
        value = fminf(value, __shfl_xor_sync(0xffffffffu, value, apart));
#endif
    return value;
""")
def lane_min(value: float) -> float:
    """The least over all lanes, known to each of them."""
    ...


@wp.func
def lane_sum_of(v: wp.vec3) -> wp.vec3:
    return wp.vec3(lane_sum(v[0]), lane_sum(v[1]), lane_sum(v[2]))


@wp.func
def level_of(value: float, step: float) -> int:
    """The level that a cell has at least where none of its values is below `value`; a limit of `points_below`."""
    return 1 + int(wp.clamp(wp.ceil(value / step), 0.0, 255.0))


@wp.func
def points_below(
    limit: int,
    stack: FieldStack,
    levels: wp.array(dtype=wp.int32),
    g: int,
    A: wp.mat33,
    b: wp.vec3,
    points: wp.array(dtype=wp.float32),
    block: int,
) -> wp.uint32:
    """The points of a block in cells whose level is below the limit, a bit each; a point outside counts as in the
    nearest cell."""
    return cells_below(limit, stack.start[g], stack.dims[g], levels, A, b, points, 3 * BLOCK * block)


@wp.func_native("""
    const float* x = points.data + first;
    const float* y = x + 32;
    const float* z = y + 32;
    const int* words = levels.data;
    unsigned int mask = 0;
    for (int n = 0; n < 32; ++n) {
        int i = (int)(A.data[0][0] * x[n] + A.data[0][1] * y[n] + A.data[0][2] * z[n] + b[0]);
        int j = (int)(A.data[1][0] * x[n] + A.data[1][1] * y[n] + A.data[1][2] * z[n] + b[1]);
        int k = (int)(A.data[2][0] * x[n] + A.data[2][1] * y[n] + A.data[2][2] * z[n] + b[2]);
        i = wp::min(wp::max(i, 0), dims[0] - 2);
        j = wp::min(wp::max(j, 0), dims[1] - 2);
        k = wp::min(wp::max(k, 0), dims[2] - 2);
        unsigned int at = start + (i * dims[1] + j) * dims[2] + k;
        int level = (words[at >> 2] >> ((at & 3) << 3)) & 255;
        mask |= (level < limit ? 1u : 0u) << n;
    }
    return mask;
""")
def cells_below(
    limit: int,
    start: int,
    dims: wp.vec3i,
    levels: wp.array(dtype=wp.int32),
    A: wp.mat33,
    b: wp.vec3,
    points: wp.array(dtype=wp.float32),
    first: int,
) -> wp.uint32:
    """`points_below` for the 32 points whose coordinates begin with the number `first`."""
    ...


@wp.func
def blocks_near(
    limit: float,
    beyond: float,
    stack: FieldStack,
    levels: wp.array(dtype=wp.int32),
    level_step: float,
    g: int,
    A: wp.mat33,
    b: wp.vec3,
    balls: wp.array(dtype=wp.float32),
    group: int,
    blocks: int,
) -> wp.uint32:
    """The blocks of a group of 32 whose points can have a value below the limit and be no farther than `beyond` [m]
    outside of the grid, a bit each; of a field that changes by no more than the way that one goes. On CUDA each lane
    sees its own block only."""
    cell = 1.8 * stack.spacing  # from a point to any corner of its cell
    near = balls_below(
        limit + cell, beyond, level_step, stack.spacing, stack.start[g], stack.dims[g], levels, A, b, balls, 128 * group
    )
    return near & bits_below(blocks - BLOCK * group)


@wp.func_native("""
    const float* x = balls.data + first;
    const float* y = x + 32;
    const float* z = y + 32;
    const float* radius = z + 32;
    const int* words = levels.data;
    const float per_step = 1.0f / step, per_node = 1.0f / spacing;
    const float last0 = dims[0] - 1, last1 = dims[1] - 1, last2 = dims[2] - 1;
    unsigned int mask = 0;
#if defined(__CUDA_ARCH__)
    for (int n = threadIdx.x & 31, end = n + 1; n < end; ++n) {
#else
    for (int n = 0; n < 32; ++n) {
#endif
        float u0 = A.data[0][0] * x[n] + A.data[0][1] * y[n] + A.data[0][2] * z[n] + b[0];
        float u1 = A.data[1][0] * x[n] + A.data[1][1] * y[n] + A.data[1][2] * z[n] + b[1];
        float u2 = A.data[2][0] * x[n] + A.data[2][1] * y[n] + A.data[2][2] * z[n] + b[2];
        float v0 = wp::min(wp::max(u0, 0.0f), last0);
        float v1 = wp::min(wp::max(u1, 0.0f), last1);
        float v2 = wp::min(wp::max(u2, 0.0f), last2);
        float outside = (u0 - v0) * (u0 - v0) + (u1 - v1) * (u1 - v1) + (u2 - v2) * (u2 - v2);
        float farthest = (radius[n] + beyond) * per_node;
        int i = wp::min((int)v0, dims[0] - 2);
        int j = wp::min((int)v1, dims[1] - 2);
        int k = wp::min((int)v2, dims[2] - 2);
        unsigned int at = start + (i * dims[1] + j) * dims[2] + k;
        int level = (words[at >> 2] >> ((at & 3) << 3)) & 255;
        int least = 2 + (int)wp::min(wp::max((limit + radius[n]) * per_step, 0.0f), 255.0f);
        mask |= (((level < least) & (outside <= farthest * farthest)) ? 1u : 0u) << n;
    }
    return mask;
""")
def balls_below(
    limit: float,
    beyond: float,
    step: float,
    spacing: float,
    start: int,
    dims: wp.vec3i,
    levels: wp.array(dtype=wp.int32),
    A: wp.mat33,
    b: wp.vec3,
    balls: wp.array(dtype=wp.float32),
    first: int,
) -> wp.uint32:
    """`blocks_near` for the 32 balls whose centres, then radii, begin with the number `first`."""
    ...


@wp.func
def points_under(normal: wp.vec3, offset: float, points: wp.array(dtype=wp.float32), block: int) -> wp.uint32:
    """The points of a block with normal . x < offset, a bit each."""
    first = 3 * BLOCK * (block & MOST_BLOCKS)
    mask = wp.uint32(0)
    n = int(0)
    while n < BLOCK:
        height = normal[0] * points[first + n]
        height += normal[1] * points[first + BLOCK + n] + normal[2] * points[first + 2 * BLOCK + n]
        mask = mask | (wp.where(height < offset, wp.uint32(1), wp.uint32(0)) << wp.uint32(n))
        n += 1
    return mask


@wp.func
def block_point(points: wp.array(dtype=wp.float32), block: int, n: int) -> wp.vec3:
    first = 3 * BLOCK * block
    return wp.vec3(points[first + n], points[first + BLOCK + n], points[first + 2 * BLOCK + n])


@wp.func
def lowest_bit(mask: wp.uint32) -> int:
    """Index of the lowest bit that is set."""
    return wp.bit_count((mask & (~mask + wp.uint32(1))) - wp.uint32(1))


@wp.func
def bits_below(count: int) -> wp.uint32:
    """The lowest `count` bits, all or none where there are no so many."""
    return wp.where(count >= BLOCK, ~wp.uint32(0), (wp.uint32(1) << wp.uint32(wp.clamp(count, 0, 31))) - wp.uint32(1))
