"""Look-ups in stacks of regular grids, and the nearest-neighbour field of a cloud, for CPU and CUDA.

Legend: x point, u position in node units, g index of a grid in its stack, i, j, k node.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

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
    origin: wp.vec3
    dims: wp.vec3i
    spacing: wp.float32


@wp.func
def node_units(stack: FieldStack, g: int, x: wp.vec3) -> wp.vec3:
    return (x - stack.origin[g]) / stack.spacing


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
    dims = stack.dims[g]
    u = node_units(stack, g, x)
    v = clamp_units(u, dims)
    low = low_node(v, dims)
    f = v - wp.vec3(float(low[0]), float(low[1]), float(low[2]))
    at = stack.start[g] + flat(low, dims)
    dx = dims[1] * dims[2]
    dy = dims[2]
    c00 = wp.lerp(stack.values[at], stack.values[at + dx], f[0])
    c01 = wp.lerp(stack.values[at + 1], stack.values[at + dx + 1], f[0])
    c10 = wp.lerp(stack.values[at + dy], stack.values[at + dx + dy], f[0])
    c11 = wp.lerp(stack.values[at + dy + 1], stack.values[at + dx + dy + 1], f[0])
    return wp.lerp(wp.lerp(c00, c10, f[1]), wp.lerp(c01, c11, f[1]), f[2]) + stack.spacing * wp.length(u - v)


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


@wp.func
def closer(points: wp.array(dtype=wp.vec3), x: wp.vec3, a: int, b: int) -> int:
    """Of two candidate indices (-1 is none) the one nearer to x."""
    if a < 0:
        return b
    if b < 0:
        return a
    if wp.length_sq(points[b] - x) < wp.length_sq(points[a] - x):
        return b
    return a


@wp.kernel
def sweep_nearest(
    first: int,
    axis: int,
    origin: wp.vec3,
    dims: wp.vec3i,
    spacing: float,
    points: wp.array(dtype=wp.vec3),
    seed_in: wp.array(dtype=wp.int32),
    index_out: wp.array(dtype=wp.int32),
):
    """One pass of a separable distance transform that carries indices: every node of one grid line takes the nearest of
    the candidates on its line. Passes along x, y and z give the nearest point up to the rounding of seeds to nodes."""
    line = first + wp.tid()
    n = dims[axis]
    stride = int(1)
    base = int(0)
    node = wp.vec3i(0, 0, 0)
    if axis == 0:
        stride = dims[1] * dims[2]
        base = line
        node = wp.vec3i(0, line // dims[2], line % dims[2])
    elif axis == 1:
        stride = dims[2]
        base = (line // dims[2]) * dims[1] * dims[2] + line % dims[2]
        node = wp.vec3i(line // dims[2], 0, line % dims[2])
    else:
        base = line * dims[2]
        node = wp.vec3i(line // dims[1], line % dims[1], 0)
    start = origin + spacing * wp.vec3(float(node[0]), float(node[1]), float(node[2]))
    step = wp.vec3(0.0, 0.0, 0.0)
    step[axis] = spacing
    for i in range(n):
        x = start + float(i) * step
        best = seed_in[base + i * stride]
        reach = float(1.0e30)
        if best >= 0:
            reach = wp.length(points[best] - x)
        d = int(1)
        # A candidate d nodes away lies at least (d - 1/2) spacings off along this axis.
        while d < n and (float(d) - 0.5) * spacing < reach:
            if i >= d:
                best = closer(points, x, best, seed_in[base + (i - d) * stride])
            if i + d < n:
                best = closer(points, x, best, seed_in[base + (i + d) * stride])
            if best >= 0:
                reach = wp.length(points[best] - x)
            d += 1
        index_out[base + i * stride] = best


@wp.kernel
def refine_nearest(
    first: int,
    origin: wp.vec3,
    dims: wp.vec3i,
    spacing: float,
    points: wp.array(dtype=wp.vec3),
    index_in: wp.array(dtype=wp.int32),
    index_out: wp.array(dtype=wp.int32),
):
    """Every node also tries the candidates of its 26 neighbours, which mends most of what rounding lost."""
    at = first + wp.tid()
    i = at // (dims[1] * dims[2])
    j = (at // dims[2]) % dims[1]
    k = at % dims[2]
    x = origin + spacing * wp.vec3(float(i), float(j), float(k))
    best = index_in[at]
    for a in range(wp.max(i - 1, 0), wp.min(i + 2, dims[0])):
        for b in range(wp.max(j - 1, 0), wp.min(j + 2, dims[1])):
            for c in range(wp.max(k - 1, 0), wp.min(k + 2, dims[2])):
                candidate = index_in[(a * dims[1] + b) * dims[2] + c]
                if candidate != best:
                    best = closer(points, x, best, candidate)
    index_out[at] = best


@wp.kernel
def query_nearest(first: int, field: NearestField, x_in: wp.array(dtype=wp.vec3), index_out: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    index_out[i] = nearest_index(field, x_in[i])


@wp.kernel
def query_stack(
    first: int,
    stack: FieldStack,
    grid_in: wp.array(dtype=wp.int32),
    x_in: wp.array(dtype=wp.vec3),
    value_out: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    value_out[i] = interpolate(stack, grid_in[i], x_in[i])
