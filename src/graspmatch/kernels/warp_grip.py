"""Where closing fingers touch an object, and how well the contacts hold it, for CPU and CUDA.

Legend, as in `warp_fields`: x point, u position in node units, g index of a grid; t closing fraction of a finger (its level
sets are the finger's surface on its way); n direction of a contact's push on the object; d direction in the space of
wrenches, force and torque, the torque divided by a length.
"""

import warp as wp

from graspmatch.kernels.warp_avoid import arrival_at
from graspmatch.kernels.warp_fields import NEVER, FieldStack, is_inside, low_node, node_units

wp.set_module_options({"enable_backward": False, "fast_math": False})

CORNERS = wp.constant(5)
"""Contacts that stand for one finger's patch: where it touches first, and its corners."""


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
def arrival_slope(stack: FieldStack, g: int, u: wp.vec3) -> wp.vec3:
    """Gradient of the closing fraction at the node next to `u` [1/m]: where the finger's surface moves to."""
    dims = stack.dims[g]
    i = wp.clamp(int(u[0] + 0.5), 1, dims[0] - 2)
    j = wp.clamp(int(u[1] + 0.5), 1, dims[1] - 2)
    k = wp.clamp(int(u[2] + 0.5), 1, dims[2] - 2)
    here = node_value(stack, g, i, j, k)
    if here >= NEVER:
        return wp.vec3(0.0, 0.0, 0.0)
    return (
        wp.vec3(
            slope(node_value(stack, g, i - 1, j, k), here, node_value(stack, g, i + 1, j, k)),
            slope(node_value(stack, g, i, j - 1, k), here, node_value(stack, g, i, j + 1, k)),
            slope(node_value(stack, g, i, j, k - 1), here, node_value(stack, g, i, j, k + 1)),
        )
        / stack.spacing
    )


@wp.func
def push_of(outward: wp.vec3, towards: wp.vec3, least_cosine: float) -> wp.vec3:
    """A face of the object is pushed along its normal; an edge, whose normal is not the finger's, along the finger's."""
    if wp.dot(-outward, towards) >= least_cosine:
        return -outward
    return towards


@wp.kernel
def find_contacts(
    first: int,
    fingers: int,
    arrival: FieldStack,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    tolerance: float,
    least_cosine: float,
    preshape_in: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3),
    rotation_in: wp.array(dtype=wp.quat),
    fraction_out: wp.array2d(dtype=wp.float32),
    count_out: wp.array2d(dtype=wp.int32),
    point_out: wp.array3d(dtype=wp.vec3),
    push_out: wp.array3d(dtype=wp.vec3),
):
    """For each finger the fraction at which it first touches, and up to CORNERS contacts of its patch: the points that its
    surface is within `tolerance` [m] of by then, farthest apart along two axes of the patch. Gripper frame."""
    i = first + wp.tid()
    for f in range(fingers):
        g = preshape_in[i] * fingers + f
        dims = arrival.dims[g]
        earliest = float(NEVER)
        touching = int(-1)
        for c in range(points.shape[0]):
            u = node_units(arrival, g, wp.quat_rotate_inv(rotation_in[i], points[c] - position_in[i]))
            if is_inside(u, dims):
                low = low_node(u, dims)
                t = arrival_at(arrival, g, low, u - wp.vec3(float(low[0]), float(low[1]), float(low[2])))
                if t < earliest:
                    earliest = t
                    touching = c
        fraction_out[i, f] = earliest
        count_out[i, f] = 0
        if earliest <= 1.0:
            x0 = wp.quat_rotate_inv(rotation_in[i], points[touching] - position_in[i])
            towards = wp.normalize(arrival_slope(arrival, g, node_units(arrival, g, x0)))
            n0 = -wp.quat_rotate_inv(rotation_in[i], normals[touching])
            if wp.length_sq(towards) < 0.5:
                towards = n0
            n0 = push_of(-n0, towards, least_cosine)
            point_out[i, f, 0] = x0
            push_out[i, f, 0] = n0
            # Two axes of the patch.
            a = wp.cross(n0, wp.vec3(1.0, 0.0, 0.0))
            if wp.abs(n0[0]) > 0.9:
                a = wp.cross(n0, wp.vec3(0.0, 1.0, 0.0))
            a = wp.normalize(a)
            b = wp.cross(n0, a)
            reach = wp.vec4(-1.0e30, -1.0e30, -1.0e30, -1.0e30)
            corner = wp.vec4i(touching, touching, touching, touching)
            for c in range(points.shape[0]):
                x = wp.quat_rotate_inv(rotation_in[i], points[c] - position_in[i])
                u = node_units(arrival, g, x)
                if is_inside(u, dims):
                    low = low_node(u, dims)
                    t = arrival_at(arrival, g, low, u - wp.vec3(float(low[0]), float(low[1]), float(low[2])))
                    if t <= 1.0:
                        speed = wp.length(arrival_slope(arrival, g, u))
                        if t - earliest <= tolerance * speed:
                            along = wp.vec2(wp.dot(x - x0, a), wp.dot(x - x0, b))
                            for s in range(4):
                                value = along[s // 2] * wp.where(s % 2 == 0, 1.0, -1.0)
                                if value > reach[s]:
                                    reach[s] = value
                                    corner[s] = c
            count = int(1)
            for s in range(4):
                c = corner[s]
                is_new = c != touching
                for r in range(s):
                    is_new = is_new and corner[r] != c
                if is_new:
                    x = wp.quat_rotate_inv(rotation_in[i], points[c] - position_in[i])
                    h = wp.normalize(arrival_slope(arrival, g, node_units(arrival, g, x)))
                    outward = wp.quat_rotate_inv(rotation_in[i], normals[c])
                    point_out[i, f, count] = x
                    push_out[i, f, count] = push_of(outward, wp.where(wp.length_sq(h) < 0.5, n0, h), least_cosine)
                    count += 1
            count_out[i, f] = count


@wp.func
def finger_support(
    i: int,
    f: int,
    count: int,
    point: wp.array3d(dtype=wp.vec3),
    push: wp.array3d(dtype=wp.vec3),
    centre: wp.vec3,
    length: float,
    friction: float,
    torsion: float,
    force: wp.vec3,
    torque: wp.vec3,
) -> wp.spatial_vector:
    """The wrench of one finger pressing with unit normal force that goes farthest along a direction: the best contact,
    at the best point of its friction cone, torsion included."""
    best = float(-1.0e30)
    wrench = wp.spatial_vector()
    for c in range(count):
        n = push[i, f, c]
        r = (point[i, f, c] - centre) / length
        v = force + wp.cross(torque, r)  # d . (f, r x f) = f . (d_force + d_torque x r)
        tangential = v - wp.dot(v, n) * n
        slide = wp.length(tangential)
        twist = wp.dot(torque, n)
        # max of v.n + v.t + twist * m over |t|^2 / friction^2 + m^2 / torsion^2 <= 1
        across = wp.sqrt(friction * friction * slide * slide + torsion * torsion * twist * twist)
        value = wp.dot(v, n) + across
        if value > best:
            best = value
            t = wp.vec3(0.0, 0.0, 0.0)
            m = float(0.0)
            if across > 1.0e-9:
                t = friction * friction / across * tangential
                m = torsion * torsion / across * twist
            total = n + t
            wrench = wp.spatial_vector(total, wp.cross(r, total) + m * n)
    return wrench


@wp.func
def support(
    i: int,
    fingers: int,
    count: wp.array2d(dtype=wp.int32),
    point: wp.array3d(dtype=wp.vec3),
    push: wp.array3d(dtype=wp.vec3),
    centre: wp.vec3,
    length: float,
    friction: float,
    torsion: float,
    least: float,
    most: float,
    load: wp.spatial_vector,
    d: wp.spatial_vector,
) -> wp.spatial_vector:
    """The wrench that the grasp can exert, load included, which goes farthest along d."""
    total = load
    for f in range(fingers):
        if count[i, f] > 0:
            w = finger_support(
                i, f, count[i, f], point, push, centre, length, friction, torsion,
                wp.spatial_top(d), wp.spatial_bottom(d),
            )  # fmt: skip
            total += wp.where(wp.dot(w, d) > 0.0, most, least) * w
    return total


@wp.kernel
def wrench_margin(
    first: int,
    fingers: int,
    directions: wp.array(dtype=wp.spatial_vector),
    descents: int,
    steps: int,
    friction: float,
    torsion: float,
    least: float,
    most: float,
    weight: float,
    length: float,
    count_in: wp.array2d(dtype=wp.int32),
    point_in: wp.array3d(dtype=wp.vec3),
    push_in: wp.array3d(dtype=wp.vec3),
    centre_in: wp.array(dtype=wp.vec3),
    down_in: wp.array(dtype=wp.vec3),
    margin_out: wp.array(dtype=wp.float32),
):
    """Smallest wrench, in units of one finger's force, that the grasp does not resist; below zero: how much is missing to
    hold the object at all. The least of the support function over directions, then refined by descent on the sphere."""
    i = first + wp.tid()
    load = wp.spatial_vector(weight * down_in[i], wp.vec3(0.0, 0.0, 0.0))
    touching = int(0)
    for f in range(fingers):
        touching += wp.where(count_in[i, f] > 0, 1, 0)
    if touching == 0:
        margin_out[i] = -1.0
        return
    best = float(1.0e30)
    d_best = wp.spatial_vector()
    second = float(1.0e30)
    d_second = wp.spatial_vector()
    for k in range(directions.shape[0]):
        d = directions[k]
        h = wp.dot(
            support(
                i, fingers, count_in, point_in, push_in, centre_in[i], length, friction, torsion, least, most, load, d
            ),
            d,
        )
        if h < best:
            second = best
            d_second = d_best
            best = h
            d_best = d
        elif h < second:
            second = h
            d_second = d
    margin = best
    for s in range(descents):
        d = wp.where(s == 0, d_best, d_second)
        rate = float(0.5)
        for _ in range(steps):
            w = support(
                i, fingers, count_in, point_in, push_in, centre_in[i], length, friction, torsion, least, most, load, d
            )
            h = wp.dot(w, d)
            margin = wp.min(margin, h)
            across = w - h * d
            d = wp.normalize(d - rate / (1.0 + wp.length(across)) * across)
            rate = 0.85 * rate
        w = support(
            i, fingers, count_in, point_in, push_in, centre_in[i], length, friction, torsion, least, most, load, d
        )
        margin = wp.min(margin, wp.dot(w, d))
    margin_out[i] = margin
