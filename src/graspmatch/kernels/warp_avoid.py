"""Backing a hand off until it is free, and closing its fingers, for all candidates at once, on CPU and CUDA.

Legend: i candidate, g its preshape, R, p its pose, c scene point, x the same in the gripper frame, d way back.
"""

import warp as wp

from graspmatch.kernels.warp_fields import NEVER, FieldStack, interpolate, is_inside, low_node, node_units

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.kernel
def back_off(
    first: int,
    corridor: FieldStack,
    approach: wp.vec3,
    clearance: float,
    step: float,
    most: float,
    scene: wp.array(dtype=wp.vec3),
    preshape_in: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3),
    rotation_in: wp.array(dtype=wp.quat),
    least_in: wp.array(dtype=wp.float32),
    retreat_out: wp.array(dtype=wp.float32),
):
    """Smallest way back along the approach from which hand and approach keep their clearance; more than `most` if none.

    The way back only ever grows from point to point, so one pass over the scene finds it: what is clear of the way in
    stays clear of it, but for the stretch that backing off adds at its start. `least_in` is what is known to be needed.
    """
    i = first + wp.tid()
    g = preshape_in[i]
    q = rotation_in[i]
    p = position_in[i]
    d = least_in[i]
    for c in range(scene.shape[0]):
        x = wp.quat_rotate_inv(q, scene[c] - p)
        while d <= most and is_near(corridor, g, x + d * approach, clearance):
            d += step
        if d > most:
            break
    retreat_out[i] = d


@wp.kernel
def least_distance(
    first: int,
    corridor: FieldStack,
    scene: wp.array(dtype=wp.vec3),
    preshape_in: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3),
    rotation_in: wp.array(dtype=wp.quat),
    clearance_out: wp.array(dtype=wp.float32),
):
    """Smallest distance of the scene to the hand and its way in."""
    i = first + wp.tid()
    smallest = float(1.0e30)
    for c in range(scene.shape[0]):
        x = wp.quat_rotate_inv(rotation_in[i], scene[c] - position_in[i])
        smallest = wp.min(smallest, interpolate(corridor, preshape_in[i], x))
    clearance_out[i] = smallest


@wp.func
def is_near(stack: FieldStack, g: int, x: wp.vec3, distance: float) -> bool:
    return is_inside(node_units(stack, g, x), stack.dims[g]) and interpolate(stack, g, x) < distance


@wp.func
def arrival_at(stack: FieldStack, g: int, low: wp.vec3i, f: wp.vec3) -> float:
    """Closing fraction at which a finger covers the point at `f` in the cell `low`: trilinear where all eight nodes are
    covered, else that of the nearest node, since the field jumps to `NEVER` at the edge of what the finger sweeps."""
    dims = stack.dims[g]
    total = float(0.0)
    largest = float(0.0)
    nearest = float(NEVER)
    for corner in range(8):
        a = corner >> 2
        b = (corner >> 1) & 1
        c = corner & 1
        value = stack.values[stack.start[g] + ((low[0] + a) * dims[1] + low[1] + b) * dims[2] + low[2] + c]
        weight = wp.where(a == 1, f[0], 1.0 - f[0]) * wp.where(b == 1, f[1], 1.0 - f[1])
        weight = weight * wp.where(c == 1, f[2], 1.0 - f[2])
        total += weight * value
        largest = wp.max(largest, value)
        if (f[0] >= 0.5) == (a == 1) and (f[1] >= 0.5) == (b == 1) and (f[2] >= 0.5) == (c == 1):
            nearest = value
    return wp.where(largest < NEVER, total, nearest)


@wp.kernel
def first_contact(
    first: int,
    fingers: int,
    arrival: FieldStack,
    scene: wp.array(dtype=wp.vec3),
    preshape_in: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3),
    rotation_in: wp.array(dtype=wp.quat),
    fraction_out: wp.array2d(dtype=wp.float32),
):
    """For each finger the closing fraction at which it meets the first scene point; `NEVER` if there is none."""
    i = first + wp.tid()
    g = preshape_in[i] * fingers
    dims = arrival.dims[g]
    for f in range(fingers):
        fraction_out[i, f] = NEVER
    for c in range(scene.shape[0]):
        u = node_units(arrival, g, wp.quat_rotate_inv(rotation_in[i], scene[c] - position_in[i]))
        if is_inside(u, dims):
            low = low_node(u, dims)
            within = u - wp.vec3(float(low[0]), float(low[1]), float(low[2]))
            for f in range(fingers):
                fraction_out[i, f] = wp.min(fraction_out[i, f], arrival_at(arrival, g + f, low, within))
