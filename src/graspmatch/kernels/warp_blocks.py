"""Clouds in blocks of 32 points, and which points of a block can matter to a hand, for CPU and CUDA.

Most points of a scene are far from the hand. A byte for each cell of a hand's field bounds its values from below; a
block of points is looked up there in one loop that a CPU runs as vector instructions, and what may lie below the limit
comes out as the bits of one word. Only those points are then looked at exactly.

Three things let the compiler vectorise the loop: a block has first all x, then all y, then all z, in an array that is
passed to the kernel directly (of arrays inside structs it does not know that they are contiguous); the loop is a
`while` (a `range` keeps its step in memory); and what it sums is an integer.

On CUDA the 32 lanes of a warp share the blocks of one hand out among them; on a CPU one thread has them all. (Tiles
would do the same, but on a CPU they share memory between threads.)

Legend: u = A x + b a point in node units, level the byte of a cell, mask the bits, n a point in its block.
"""

import warp as wp

from graspmatch.kernels.warp_fields import POSITIVE, FieldStack

wp.set_module_options({"enable_backward": False, "fast_math": False})

BLOCK = wp.constant(32)
"""Points of a block: the bits of a word."""


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
def level_at(stack: FieldStack, levels: wp.array(dtype=wp.int32), g: int, low: wp.vec3i) -> int:
    """The level of a cell, by its lowest node."""
    dims = stack.dims[g]
    at = stack.start[g] + (low[0] * dims[1] + low[1]) * dims[2] + low[2]
    return (levels[at >> 2] >> ((at & 3) << 3)) & 255


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
    dims = stack.dims[g]
    start = stack.start[g]
    first = 3 * BLOCK * (block & MOST_BLOCKS)
    mask = wp.uint32(0)
    n = int(0)
    while n < BLOCK:
        u = A * wp.vec3(points[first + n], points[first + BLOCK + n], points[first + 2 * BLOCK + n]) + b
        i = wp.min(wp.max(int(u[0]), 0), dims[0] - 2)
        j = wp.min(wp.max(int(u[1]), 0), dims[1] - 2)
        k = wp.min(wp.max(int(u[2]), 0), dims[2] - 2)
        at = start + (i * dims[1] + j) * dims[2] + k
        level = (levels[(at & POSITIVE) >> 2] >> ((at & 3) << 3)) & 255
        mask = mask | (wp.where(level < limit, wp.uint32(1), wp.uint32(0)) << wp.uint32(n))
        n += 1
    return mask


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
    """The lowest `count` bits, or all."""
    return wp.where(count >= BLOCK, ~wp.uint32(0), (wp.uint32(1) << wp.uint32(wp.min(count, 31))) - wp.uint32(1))
