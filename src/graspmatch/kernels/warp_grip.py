"""Where closing fingers touch an object, and how well the contacts hold it, for CPU and CUDA.

Legend, as in `warp_fields`: x point, u position in node units, g index of a grid; i candidate, f finger, c point or
contact; t closing fraction of a finger (its level sets are the finger's surface on its way); n direction in which a
contact pushes the object; d, w direction and point in the space of wrenches: force and torque, torques divided by a
length.
"""

import warp as wp

from graspmatch.kernels.warp_avoid import arrival_at
from graspmatch.kernels.warp_fields import NEVER, FieldStack, interpolate, is_inside, low_node, node_units

wp.set_module_options({"enable_backward": False, "fast_math": False})

LATE = 0.25
"""Closing fraction after a finger's first contact in which it goes much farther than a contact patch is deep."""
CORNERS = 5
"""Contacts that stand for one finger's patch: where it touches first, and its corners."""


@wp.func
def node_value(stack: FieldStack, g: int, i: int, j: int, k: int) -> float:
    dims = stack.dims[g]
    return stack.values[stack.start[g] + (i * dims[1] + j) * dims[2] + k]


@wp.func
def fraction_at(stack: FieldStack, g: int, u: wp.vec3) -> float:
    """Closing fraction at which a finger covers a point inside its grid; `NEVER` where it does not."""
    if node_value(stack, g, int(u[0] + 0.5), int(u[1] + 0.5), int(u[2] + 0.5)) >= NEVER:
        return float(NEVER)  # as `arrival_at` says too, after more work
    low = low_node(u, stack.dims[g])
    return arrival_at(stack, g, low, u - wp.vec3(float(low[0]), float(low[1]), float(low[2])))


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
def slowness(stack: FieldStack, g: int, x: wp.vec3) -> float:
    """Closing fraction that a finger's surface takes for each metre there [1/m]: the length of the field's gradient."""
    dims = stack.dims[g]
    u = node_units(stack, g, x)
    i = wp.clamp(int(u[0] + 0.5), 1, dims[0] - 2)
    j = wp.clamp(int(u[1] + 0.5), 1, dims[1] - 2)
    k = wp.clamp(int(u[2] + 0.5), 1, dims[2] - 2)
    here = node_value(stack, g, i, j, k)
    if here >= NEVER:
        return 0.0
    gradient = wp.vec3(
        slope(node_value(stack, g, i - 1, j, k), here, node_value(stack, g, i + 1, j, k)),
        slope(node_value(stack, g, i, j - 1, k), here, node_value(stack, g, i, j + 1, k)),
        slope(node_value(stack, g, i, j, k - 1), here, node_value(stack, g, i, j, k + 1)),
    )
    return wp.length(gradient) / stack.spacing


@wp.func
def across(n: wp.vec3) -> wp.vec3:
    """A unit vector perpendicular to n."""
    hint = wp.where(wp.abs(n[0]) > 0.9, wp.vec3(0.0, 1.0, 0.0), wp.vec3(1.0, 0.0, 0.0))
    return wp.normalize(wp.cross(n, hint))


@wp.func
def spread_patch(
    i: int,
    f: int,
    start: int,
    tolerance: float,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    p: wp.vec3,
    q: wp.quat,
    excess: wp.array3d(dtype=wp.float32),
    point_out: wp.array3d(dtype=wp.vec3),
    push_out: wp.array3d(dtype=wp.vec3),
) -> int:
    """Of the points whose excess is within the tolerance, `start` and those farthest from it along two axes."""
    x0 = wp.quat_rotate_inv(q, points[start] - p)
    n0 = -wp.quat_rotate_inv(q, normals[start])
    point_out[i, f, 0] = x0
    push_out[i, f, 0] = n0
    count = int(1)
    a = across(n0)
    b = wp.cross(n0, a)
    reach = wp.vec4(0.0, 0.0, 0.0, 0.0)
    corner = wp.vec4i(start, start, start, start)
    for c in range(points.shape[0]):
        if excess[i, f, c] <= tolerance:
            x = wp.quat_rotate_inv(q, points[c] - p)
            along = wp.vec2(wp.dot(x - x0, a), wp.dot(x - x0, b))
            for s in range(4):
                value = along[s // 2] * wp.where(s % 2 == 0, 1.0, -1.0)
                if value > reach[s]:
                    reach[s] = value
                    corner[s] = c
    for s in range(4):
        is_new = corner[s] != start
        for r in range(s):
            is_new = is_new and corner[r] != corner[s]
        if is_new:
            point_out[i, f, count] = wp.quat_rotate_inv(q, points[corner[s]] - p)
            push_out[i, f, count] = -wp.quat_rotate_inv(q, normals[corner[s]])
            count += 1
    return count


@wp.kernel
def find_palm_contacts(
    first: int,
    palm: int,
    distance: FieldStack,
    pivot: wp.array(dtype=wp.vec3),
    approach: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    facing: float,
    reach: float,
    tolerance: float,
    preshape_in: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3),
    rotation_in: wp.array(dtype=wp.quat),
    excess: wp.array3d(dtype=wp.float32),
    count_out: wp.array2d(dtype=wp.int32),
    point_out: wp.array3d(dtype=wp.vec3),
    push_out: wp.array3d(dtype=wp.vec3),
):
    """Where the object would lie against the palm if the fingers pulled it in: of the points that face against the
    approach, if any is within `reach` [m] of the hand, the patch within `tolerance` [m] of the nearest."""
    i = first + wp.tid()
    q = rotation_in[i]
    p = position_in[i]
    g = preshape_in[i]
    nearest = float(1.0e30)
    start = int(-1)
    for c in range(points.shape[0]):
        gap = float(1.0e30)
        if wp.dot(wp.quat_rotate_inv(q, normals[c]), approach) < -facing:
            gap = interpolate(distance, g, wp.quat_rotate_inv(q, points[c] - p) - pivot[g])
        excess[i, palm, c] = gap
        if gap < nearest:
            nearest = gap
            start = c
    count_out[i, palm] = 0
    if nearest <= reach:
        for c in range(points.shape[0]):
            excess[i, palm, c] = excess[i, palm, c] - nearest
        count_out[i, palm] = spread_patch(i, palm, start, tolerance, points, normals, p, q, excess, point_out, push_out)


@wp.kernel
def find_contacts(
    first: int,
    fingers: int,
    arrival: FieldStack,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    tolerance: float,
    preshape_in: wp.array(dtype=wp.int32),
    position_in: wp.array(dtype=wp.vec3),
    rotation_in: wp.array(dtype=wp.quat),
    excess: wp.array3d(dtype=wp.float32),
    fraction_out: wp.array2d(dtype=wp.float32),
    count_out: wp.array2d(dtype=wp.int32),
    point_out: wp.array3d(dtype=wp.vec3),
    push_out: wp.array3d(dtype=wp.vec3),
):
    """For each finger the fraction at which it first touches, and up to CORNERS contacts of its patch: of the points
    within `tolerance` [m] of its surface by then, the first and those farthest along two axes, both ways.

    Points and pushes are in the gripper frame; a contact pushes against the object's normal. `excess` is scratch:
    how far each point is from the finger's surface when that first touches.
    """
    i = first + wp.tid()
    q = rotation_in[i]
    p = position_in[i]
    for f in range(fingers):
        fraction_out[i, f] = NEVER
        count_out[i, f] = 0
    for c in range(points.shape[0]):
        x = wp.quat_rotate_inv(q, points[c] - p)
        u = node_units(arrival, preshape_in[i] * fingers, x)  # all fingers of a preshape have one grid
        inside = is_inside(u, arrival.dims[preshape_in[i] * fingers])
        for f in range(fingers):
            t = float(NEVER)
            if inside:
                t = fraction_at(arrival, preshape_in[i] * fingers + f, u)
            excess[i, f, c] = t
            if t < fraction_out[i, f]:
                fraction_out[i, f] = t
                count_out[i, f] = c  # for now, which point it is
    for f in range(fingers):
        start = count_out[i, f]
        earliest = fraction_out[i, f]
        count_out[i, f] = 0
        if earliest <= 1.0:
            g = preshape_in[i] * fingers + f
            for c in range(points.shape[0]):  # from fractions to distances
                late = excess[i, f, c] - earliest
                if late < LATE:
                    late = late / wp.max(slowness(arrival, g, wp.quat_rotate_inv(q, points[c] - p)), 1.0e-3)
                excess[i, f, c] = late
            count_out[i, f] = spread_patch(i, f, start, tolerance, points, normals, p, q, excess, point_out, push_out)


@wp.struct
class Grip:
    """Contacts of all candidates, gripper frame, and how fingers press."""

    count: wp.array2d(dtype=wp.int32)
    point: wp.array3d(dtype=wp.vec3)
    push: wp.array3d(dtype=wp.vec3)
    centre: wp.array(dtype=wp.vec3)
    """Centre of mass: torques are about it ..."""
    length: wp.float32
    """... and divided by this [m]."""
    friction: wp.float32
    torsion: wp.float32
    """Torsional friction [m], divided by `length`."""
    most: wp.float32
    """A finger on the object presses with 1 to `most` times its rated force, the palm with 0 to `most` times."""


@wp.func
def finger_wrench(grip: Grip, i: int, f: int, d: wp.spatial_vector) -> wp.spatial_vector:
    """The wrench of one finger pressing with unit normal force that goes farthest along d, of all contacts and of their
    friction cones: |t|^2 / friction^2 + m^2 / torsion^2 <= 1 for the force t across, the torque m about the normal."""
    force = wp.spatial_top(d)
    torque = wp.spatial_bottom(d)
    best = float(-1.0e30)
    wrench = wp.spatial_vector()
    for c in range(grip.count[i, f]):
        n = grip.push[i, f, c]
        r = (grip.point[i, f, c] - grip.centre[i]) / grip.length
        v = force + wp.cross(torque, r)  # d . (f, r x f) = f . v
        slide = v - wp.dot(v, n) * n
        twist = wp.dot(torque, n)
        friction = grip.friction * grip.friction
        torsion = grip.torsion * grip.torsion
        gain = wp.sqrt(friction * wp.length_sq(slide) + torsion * twist * twist)
        value = wp.dot(v, n) + gain
        if value > best:
            best = value
            scale = wp.where(gain > 1.0e-9, 1.0 / wp.max(gain, 1.0e-9), 0.0)
            total = n + scale * friction * slide
            wrench = wp.spatial_vector(total, wp.cross(r, total) + scale * torsion * twist * n)
    return wrench


@wp.func
def farthest_wrench(
    grip: Grip, fingers: int, i: int, load: wp.spatial_vector, d: wp.spatial_vector
) -> wp.spatial_vector:
    """Of all wrenches that the grasp can exert, the load included, one that goes farthest along d."""
    total = load
    for f in range(fingers):
        if grip.count[i, f] > 0:
            w = finger_wrench(grip, i, f, d)
            total += wp.where(wp.dot(w, d) > 0.0, grip.most, 1.0) * w
    if grip.count[i, fingers] > 0:
        w = finger_wrench(grip, i, fingers, d)
        total += wp.where(wp.dot(w, d) > 0.0, grip.most, 0.0) * w
    return total


@wp.kernel
def wrench_margin(
    first: int,
    fingers: int,
    grip: Grip,
    directions: wp.array(dtype=wp.spatial_vector),
    steps: int,
    load_in: wp.array(dtype=wp.vec3),
    margin_out: wp.array(dtype=wp.float32),
):
    """Smallest wrench that the grasp cannot resist besides the load, in units of one finger's force (Ferrari and Canny
    1992, with given finger forces). Below zero, the smallest that is missing to hold the object still.

    It is the least support of the set of wrenches over all directions: the least over some, followed by a descent from
    the two best.
    """
    i = first + wp.tid()
    load = wp.spatial_vector(load_in[i], wp.vec3(0.0, 0.0, 0.0))
    best = float(1.0e30)
    second = float(1.0e30)
    d_best = wp.spatial_vector()
    d_second = wp.spatial_vector()
    for k in range(directions.shape[0]):
        d = directions[k]
        h = wp.dot(farthest_wrench(grip, fingers, i, load, d), d)
        if h < best:
            second = best
            d_second = d_best
            best = h
            d_best = d
        elif h < second:
            second = h
            d_second = d
    margin = best
    for s in range(2):
        d = wp.where(s == 0, d_best, d_second)
        rate = float(0.5)
        for _ in range(steps):
            w = farthest_wrench(grip, fingers, i, load, d)
            h = wp.dot(w, d)
            margin = wp.min(margin, h)
            slope_on_sphere = w - h * d
            d = wp.normalize(d - rate / (1.0 + wp.length(slope_on_sphere)) * slope_on_sphere)
            rate = 0.85 * rate
        margin = wp.min(margin, wp.dot(farthest_wrench(grip, fingers, i, load, d), d))
    margin_out[i] = margin
