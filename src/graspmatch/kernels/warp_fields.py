"""Look-ups in stacks of regular grids, and the nearest-neighbour field of a cloud, for CPU and CUDA.

Legend: x point, u position in node units, g index of a grid in its stack, i, j, k node.
"""

import warp as wp

from graspmatch.kernels.warp_queue import Queue, take

wp.set_module_options({"enable_backward": False, "fast_math": False})

POSITIVE = wp.constant(0x7FFFFFFF)
"""What an index can be at most: masked by it, the compiler knows that none is negative, that is, counts from the end,
and vectorises better."""
NEVER = 2.0
"""Closing fraction of what a finger never meets: beyond 1, where it is closed."""


@wp.struct
class FieldStack:
    """Grids of one spacing, one behind the other in one array; each has its own origin and shape."""

    values: wp.array(dtype=wp.float32)
    start: wp.array(dtype=wp.int32)
    origin: wp.array(dtype=wp.vec3)
    dims: wp.array(dtype=wp.vec3i)
    spacing: wp.float32


@wp.struct
class NearestField:
    """For each node of a grid the index of the nearest point of a cloud."""

    index: wp.array(dtype=wp.int32)
    points: wp.array(dtype=wp.vec3)
    coordinates: wp.array(dtype=wp.float32)
    """The same points: all x, then all y, then all z."""
    origin: wp.vec3
    dims: wp.vec3i
    spacing: wp.float32


@wp.func
def node_units(stack: FieldStack, g: int, x: wp.vec3) -> wp.vec3:
    return (x - stack.origin[g]) / stack.spacing


@wp.func
def turn_of(T: wp.mat44) -> wp.mat33:
    return wp.mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@wp.func
def place_of(T: wp.mat44) -> wp.vec3:
    return wp.vec3(T[0, 3], T[1, 3], T[2, 3])


@wp.func
def to_node_units(stack: FieldStack, T: wp.mat44) -> wp.mat33:
    """A of u = A x + b, which is x in the frame T, in node units of a grid g."""
    return wp.transpose(turn_of(T)) / stack.spacing


@wp.func
def node_offset(stack: FieldStack, g: int, A: wp.mat33, T: wp.mat44) -> wp.vec3:
    """b of that."""
    return -(A * place_of(T)) - stack.origin[g] / stack.spacing


@wp.func
def is_inside(u: wp.vec3, dims: wp.vec3i) -> bool:
    return (
        u[0] >= 0.0
        and u[1] >= 0.0
        and u[2] >= 0.0
        and u[0] <= float(dims[0] - 1)
        and u[1] <= float(dims[1] - 1)
        and u[2] <= float(dims[2] - 1)
    )


@wp.func
def clamp_units(u: wp.vec3, dims: wp.vec3i) -> wp.vec3:
    return wp.vec3(
        wp.clamp(u[0], 0.0, float(dims[0] - 1)),
        wp.clamp(u[1], 0.0, float(dims[1] - 1)),
        wp.clamp(u[2], 0.0, float(dims[2] - 1)),
    )


@wp.func
def low_node(u: wp.vec3, dims: wp.vec3i) -> wp.vec3i:
    """The lower corner of the cell of `u`, such that the upper corner exists."""
    return wp.vec3i(wp.min(int(u[0]), dims[0] - 2), wp.min(int(u[1]), dims[1] - 2), wp.min(int(u[2]), dims[2] - 2))


@wp.func
def flat(node: wp.vec3i, dims: wp.vec3i) -> int:
    return (node[0] * dims[1] + node[1]) * dims[2] + node[2]


@wp.func
def interpolate(stack: FieldStack, g: int, x: wp.vec3) -> float:
    """Trilinear value; outside, the border's value plus the distance to the border."""
    return interpolate_at(stack, g, node_units(stack, g, x))


@wp.func
def interpolate_at(stack: FieldStack, g: int, u: wp.vec3) -> float:
    """The same at a position in node units."""
    return trilinear(stack.values, stack.start[g], stack.dims[g], stack.spacing, u)


@wp.func_native("""
    float v0 = wp::min(wp::max(u[0], 0.0f), dims[0] - 1.0f);
    float v1 = wp::min(wp::max(u[1], 0.0f), dims[1] - 1.0f);
    float v2 = wp::min(wp::max(u[2], 0.0f), dims[2] - 1.0f);
    int i = wp::min((int)v0, dims[0] - 2);
    int j = wp::min((int)v1, dims[1] - 2);
    int k = wp::min((int)v2, dims[2] - 2);
    float f0 = v0 - i, f1 = v1 - j, f2 = v2 - k;
    const float* low = values.data + start + (i * dims[1] + j) * dims[2] + k;
    const float* high = low + dims[1] * dims[2];
    float c00 = low[0] + f0 * (high[0] - low[0]);
    float c01 = low[1] + f0 * (high[1] - low[1]);
    low += dims[2];
    high += dims[2];
    float c10 = low[0] + f0 * (high[0] - low[0]);
    float c11 = low[1] + f0 * (high[1] - low[1]);
    float c0 = c00 + f1 * (c10 - c00), c1 = c01 + f1 * (c11 - c01);
    float outside = (u[0] - v0) * (u[0] - v0) + (u[1] - v1) * (u[1] - v1) + (u[2] - v2) * (u[2] - v2);
    return c0 + f2 * (c1 - c0) + (outside > 0.0f ? spacing * sqrtf(outside) : 0.0f);
""")
def trilinear(values: wp.array(dtype=wp.float32), start: int, dims: wp.vec3i, spacing: float, u: wp.vec3) -> float:
    """That in C++, on plain pointers: arrays of Warp have a stride and look out for indices that count from the end."""
    ...


@wp.func
def nearest_index(field: NearestField, x: wp.vec3) -> int:
    """Index of the nearest point: the best of the candidates carried by the eight nodes around x.

    Exact but where rounding lost a candidate; `test_nearest_field_agrees_with_a_tree` bounds that share.
    """
    u = clamp_units((x - field.origin) / field.spacing, field.dims)
    low = low_node(u, field.dims)
    at = flat(low, field.dims)
    dx = field.dims[1] * field.dims[2]
    dy = field.dims[2]
    best = int(-1)
    last = int(-1)
    best_distance = float(1.0e30)
    for corner in range(8):
        node = at + (corner & 1) + ((corner >> 1) & 1) * dy + (corner >> 2) * dx
        candidate = field.index[node]
        if candidate != last:
            distance = wp.length_sq(x - field.points[candidate])
            if distance < best_distance:
                best_distance = distance
                best = candidate
            last = candidate
    return best


FINENESS = wp.constant(4096.0)
"""Of squared distances as integers, per squared node: integers, for the compiler does not know that writing a float
leaves the coordinates alone."""
FARTHEST = wp.constant(500000.0)
"""Squared distance [nodes] from which on all are alike."""


@wp.func
def try_row(
    index_in: wp.array(dtype=wp.int32),
    giver: int,
    index_out: wp.array(dtype=wp.int32),
    square_out: wp.array(dtype=wp.int32),
    taker: int,
    shift: int,
    dims: wp.vec3i,
    u: wp.array(dtype=wp.float32),
    count: int,
):
    """Every node of the row `taker` along z takes the candidate of a node of the row `giver`, so much farther along it,
    if that is nearer."""
    x = float(taker / dims[1])
    y = float(taker % dims[1])
    below = wp.max(-shift, 0)
    take = (taker * dims[2] + below) & POSITIVE
    give = (giver * dims[2] + wp.max(shift, 0)) & POSITIVE
    length = dims[2] - wp.abs(shift)
    k = int(0)
    while k < length:
        c = index_in[give + k] & POSITIVE
        dx = u[c] - x
        dy = u[count + c] - y
        dz = u[2 * count + c] - float(below + k)
        square = int(FINENESS * wp.min(dx * dx + dy * dy + dz * dz, FARTHEST))
        before = square_out[take + k]
        index_out[take + k] = wp.where(square < before, c, index_out[take + k])
        square_out[take + k] = wp.min(square, before)
        k += 1


@wp.func
def farthest_of(square: wp.array(dtype=wp.int32), row: int, length: int) -> int:
    """The largest squared distance of a row."""
    farthest = int(0)
    start = (row * length) & POSITIVE
    k = int(0)
    while k < length:
        farthest = wp.max(farthest, square[start + k])
        k += 1
    return farthest


@wp.func
def clear_row(
    index_out: wp.array(dtype=wp.int32), square_out: wp.array(dtype=wp.int32), row: int, length: int, none: int
):
    """A row without candidates."""
    start = (row * length) & POSITIVE
    k = int(0)
    while k < length:
        index_out[start + k] = none
        square_out[start + k] = int(FINENESS * FARTHEST)
        k += 1


@wp.kernel
def sweep_along(
    queue: Queue,
    dims: wp.vec3i,
    count: int,
    u: wp.array(dtype=wp.float32),
    index_in: wp.array(dtype=wp.int32),
    index_out: wp.array(dtype=wp.int32),
    square_out: wp.array(dtype=wp.int32),
):
    """First pass of a separable distance transform that carries indices: every node of a row along z takes the nearest
    of the candidates in its row. Passes along z, y and x give the nearest point up to the rounding of seeds to nodes.

    `u` has the points in node units, all x, then all y and z; the last of them is farther than all, and stands for
    none.
    """
    row = take(queue, wp.tid())
    if row < 0:
        return
    x = float(row / dims[1])
    y = float(row % dims[1])
    clear_row(index_out, square_out, row, dims[2], count - 1)
    start = (row * dims[2]) & POSITIVE
    n = int(0)
    while n < dims[2]:
        c = index_in[row * dims[2] + n]
        if c < count - 1:
            dx = u[c] - x
            dy = u[count + c] - y
            across = dx * dx + dy * dy
            height = u[2 * count + c]
            k = int(0)
            while k < dims[2]:
                dz = height - float(k)
                square = int(FINENESS * wp.min(across + dz * dz, FARTHEST))
                before = square_out[start + k]
                index_out[start + k] = wp.where(square < before, c, index_out[start + k])
                square_out[start + k] = wp.min(square, before)
                k += 1
        n += 1


@wp.kernel
def sweep_across(
    queue: Queue,
    axis: int,
    dims: wp.vec3i,
    count: int,
    u: wp.array(dtype=wp.float32),
    index_in: wp.array(dtype=wp.int32),
    index_out: wp.array(dtype=wp.int32),
    square_out: wp.array(dtype=wp.int32),
):
    """The other passes, along x (axis 0) and y (axis 1): from row to row."""
    row = take(queue, wp.tid())
    if row < 0:
        return
    at = row / dims[1]
    stride = dims[1]
    if axis == 1:
        at = row % dims[1]
        stride = int(1)
    clear_row(index_out, square_out, row, dims[2], count - 1)
    try_row(index_in, row, index_out, square_out, row, 0, dims, u, count)
    farthest = farthest_of(square_out, row, dims[2])
    d = int(1)
    # A candidate d rows away lies at least d - 1/2 nodes off.
    while d < dims[axis] and FINENESS * (float(d) - 0.5) * (float(d) - 0.5) < float(farthest):
        if at >= d:
            try_row(index_in, row - d * stride, index_out, square_out, row, 0, dims, u, count)
        if at + d < dims[axis]:
            try_row(index_in, row + d * stride, index_out, square_out, row, 0, dims, u, count)
        farthest = farthest_of(square_out, row, dims[2])
        d += 1


@wp.kernel
def refine_nearest(
    queue: Queue,
    dims: wp.vec3i,
    count: int,
    u: wp.array(dtype=wp.float32),
    index_in: wp.array(dtype=wp.int32),
    index_out: wp.array(dtype=wp.int32),
    square_out: wp.array(dtype=wp.int32),
):
    """Every node of a row along z also tries the candidates of its 26 neighbours, which mends most of what rounding
    lost."""
    row = take(queue, wp.tid())
    if row < 0:
        return
    clear_row(index_out, square_out, row, dims[2], count - 1)
    i = wp.max(row / dims[1] - 1, 0)
    while i < wp.min(row / dims[1] + 2, dims[0]):
        j = wp.max(row % dims[1] - 1, 0)
        while j < wp.min(row % dims[1] + 2, dims[1]):
            for shift in range(-1, 2):
                try_row(index_in, i * dims[1] + j, index_out, square_out, row, shift, dims, u, count)
            j += 1
        i += 1


@wp.kernel
def query_nearest(
    queue: Queue, field: NearestField, x_in: wp.array(dtype=wp.vec3), index_out: wp.array(dtype=wp.int32)
):
    i = take(queue, wp.tid())
    if i < 0:
        return
    index_out[i] = nearest_index(field, x_in[i])


@wp.kernel
def query_stack(
    queue: Queue,
    stack: FieldStack,
    grid_in: wp.array(dtype=wp.int32),
    x_in: wp.array(dtype=wp.vec3),
    value_out: wp.array(dtype=wp.float32),
):
    i = take(queue, wp.tid())
    if i < 0:
        return
    value_out[i] = interpolate(stack, grid_in[i], x_in[i])
