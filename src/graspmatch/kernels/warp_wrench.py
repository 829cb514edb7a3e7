"""The wrenches that pressing fingers exert on an object, for CPU and CUDA.

Legend: i grasp, g what presses (the fingers, then palm, then table), c its contacts; n direction in which a contact
pushes the object; d, w direction and point in the space of wrenches: force and torque, torques about the centre of mass
and divided by a length. Forces are in units of one finger's force.
"""

import warp as wp

from graspmatch.kernels.warp_queue import Queue, take

wp.set_module_options({"enable_backward": False, "fast_math": False})

CORNERS = 5
"""Contacts that stand for one patch: where it touches first, and its corners."""
REACTION = 10.0
"""Palm and table press back with at most so many times one finger's force."""
GAP = 0.2
"""The search for the least wrench ends where it is at most this share too long."""


ROOM = 12
"""Corners of the set of wrenches that the search for the least one keeps."""
EXCHANGES = 12
"""Times that it moves shares between them, for each new corner."""
Row = wp.types.vector(length=6, dtype=wp.float32)
Corners = wp.types.matrix(shape=(ROOM, 6), dtype=wp.float32)
Products = wp.types.matrix(shape=(ROOM, ROOM), dtype=wp.float32)
Shares = wp.types.vector(length=ROOM, dtype=wp.float32)


@wp.func
def as_row(w: wp.spatial_vector) -> Row:
    return Row(w[0], w[1], w[2], w[3], w[4], w[5])


@wp.func
def from_row(row: Row) -> wp.spatial_vector:
    return wp.spatial_vector(row[0], row[1], row[2], row[3], row[4], row[5])


@wp.struct
class Contacts:
    """Where all grasps touch, gripper frame."""

    count: wp.array2d(dtype=wp.int32)
    point: wp.array3d(dtype=wp.vec3)
    push: wp.array3d(dtype=wp.vec3)
    centre: wp.array(dtype=wp.vec3)
    """Of mass: torques are about it."""
    beyond: wp.array2d(dtype=wp.float32)
    """How far from what was seen each touches, the mean over its contacts [m]."""
    touching: wp.array2d(dtype=wp.int32)
    """As `count`, but what touches without pressing counts, too: scratch of `hold`."""
    start: wp.array2d(dtype=wp.int32)
    """Scratch of `lay_out`: number of the first contact of each, ..."""
    rows: wp.array3d(dtype=wp.float32)
    """... and for each contact its push, its arm, and how far it goes where one looks."""


@wp.struct
class Pressure:
    """How hard what touches presses, and how rough it is."""

    drive: wp.array(dtype=wp.int32)
    """For each finger the first one of those that its drive closes too: itself, where it has a drive of its own."""
    share: wp.array(dtype=wp.float32)
    """For each finger how many fingers its drive closes."""
    most: wp.float32
    """A finger with a drive of its own presses with 1 to `most` times its rated force."""
    friction: wp.array(dtype=wp.float32)
    """Of each grasp."""
    torsion: wp.float32
    """Torsional friction [m]."""
    length: wp.float32
    """By which torques are divided [m]."""


@wp.func
def lay_out(contacts: Contacts, pressure: Pressure, i: int):
    """Note where contacts and friction cones of a grasp are, side by side: before wrenches are looked for."""
    found = int(0)
    for g in range(contacts.count.shape[1]):
        contacts.start[i, g] = found
        for c in range(contacts.count[i, g]):
            n = contacts.push[i, g, c]
            r = (contacts.point[i, g, c] - contacts.centre[i]) / pressure.length
            for axis in range(3):
                contacts.rows[i, axis, found] = n[axis]
                contacts.rows[i, 3 + axis, found] = r[axis]
            found += 1
    contacts.start[i, contacts.count.shape[1]] = found


@wp.func_native("""
    float* push = rows.data + (size_t)i * 7 * rows.shape[2];
    float* arm = push + 3 * rows.shape[2];
    float* __restrict farthest = arm + 3 * rows.shape[2];
    const int room = rows.shape[2];
    for (int c = 0; c < count; ++c) {
        float n0 = push[c], n1 = push[room + c], n2 = push[2 * room + c];
        float r0 = arm[c], r1 = arm[room + c], r2 = arm[2 * room + c];
        float v0 = d[0] + d[4] * r2 - d[5] * r1;
        float v1 = d[1] + d[5] * r0 - d[3] * r2;
        float v2 = d[2] + d[3] * r1 - d[4] * r0;
        float along = v0 * n0 + v1 * n1 + v2 * n2;
        float twist = d[3] * n0 + d[4] * n1 + d[5] * n2;
        v0 -= along * n0;
        v1 -= along * n1;
        v2 -= along * n2;
        float squared = friction * (v0 * v0 + v1 * v1 + v2 * v2) + torsion * twist * twist;
#if defined(__CUDA_ARCH__)
        farthest[c] = along + sqrtf(squared);
#else
        farthest[c] = along + __builtin_elementwise_sqrt(squared);
#endif
    }
""")
def look_along(
    d: wp.spatial_vector, friction: float, torsion: float, rows: wp.array3d(dtype=wp.float32), i: int, count: int
):
    """How far the wrench of unit normal force of each contact goes along d, within its friction cone: for the force t
    across and the torque m about the normal |t|^2 / friction^2 + m^2 / torsion^2 <= 1. Given are the squares of both.

    In C++, so that a CPU looks at 8 contacts at once."""
    ...


@wp.func
def unit_wrench(contacts: Contacts, pressure: Pressure, i: int, c: int, d: wp.spatial_vector) -> wp.spatial_vector:
    """The wrench of unit normal force of one contact that goes farthest along d."""
    n = wp.vec3(contacts.rows[i, 0, c], contacts.rows[i, 1, c], contacts.rows[i, 2, c])
    r = wp.vec3(contacts.rows[i, 3, c], contacts.rows[i, 4, c], contacts.rows[i, 5, c])
    friction = pressure.friction[i] * pressure.friction[i]
    torsion = pressure.torsion / pressure.length * pressure.torsion / pressure.length
    torque = wp.spatial_bottom(d)
    v = wp.spatial_top(d) + wp.cross(torque, r)  # d . (f, r x f) = f . v
    slide = v - wp.dot(v, n) * n
    twist = wp.dot(torque, n)
    gain = wp.sqrt(friction * wp.length_sq(slide) + torsion * twist * twist)
    scale = wp.where(gain > 1.0e-9, 1.0 / wp.max(gain, 1.0e-9), 0.0)
    total = n + scale * friction * slide
    return wp.spatial_vector(total, wp.cross(r, total) + scale * torsion * twist * n)


@wp.func
def farthest_contact(contacts: Contacts, i: int, g: int) -> int:
    """Of the contacts of g, of which there is one at least, the one that goes farthest along where one looks."""
    best = contacts.start[i, g]
    for c in range(best + 1, contacts.start[i, g + 1]):
        if contacts.rows[i, 6, c] > contacts.rows[i, 6, best]:
            best = c
    return best


@wp.func
def farthest_wrench(
    contacts: Contacts, pressure: Pressure, i: int, load: wp.spatial_vector, d: wp.spatial_vector
) -> wp.spatial_vector:
    """Of all wrenches on the object, the load included, one that goes farthest along d.

    A drive of several fingers shares out its force among them as the object pushes back; palm and table only react.
    """
    fingers = pressure.drive.shape[0]
    friction = pressure.friction[i] * pressure.friction[i]
    torsion = pressure.torsion / pressure.length * pressure.torsion / pressure.length
    look_along(d, friction, torsion, contacts.rows, i, contacts.start[i, fingers + 2])
    total = load
    for drive in range(fingers):
        farthest = float(-1.0e30)
        contact = int(-1)
        force = float(0.0)
        for f in range(drive, fingers):
            if pressure.drive[f] == drive and contacts.start[i, f + 1] > contacts.start[i, f]:
                c = farthest_contact(contacts, i, f)
                h = contacts.rows[i, 6, c]
                if h > farthest:
                    farthest = h
                    contact = c
                    force = pressure.share[f]
                    if pressure.share[f] == 1.0 and h > 0.0:
                        force = pressure.most
        if contact >= 0:
            total += force * unit_wrench(contacts, pressure, i, contact, d)
    for g in range(fingers, fingers + 2):
        if contacts.start[i, g + 1] > contacts.start[i, g]:
            c = farthest_contact(contacts, i, g)
            if contacts.rows[i, 6, c] > 0.0:
                total += REACTION * unit_wrench(contacts, pressure, i, c, d)
    return total


@wp.func
def least_wrench(
    contacts: Contacts,
    pressure: Pressure,
    i: int,
    load: wp.spatial_vector,
    guess: wp.spatial_vector,
    tolerance: float,
    steps: int,
) -> wp.spatial_vector:
    """Of all wrenches on the object about the shortest: along it the object moves. Zero if that is within tolerance.

    Each step finds one more corner of the set of wrenches, against w, from a guess of its direction on; then shares are
    moved between the `ROOM` corners that are kept, from the one that goes farthest along w to the one that goes least
    (Lacoste-Julien and Jaggi 2015, pairwise steps of Frank and Wolfe's method). The support against w bounds from below
    how short a wrench can be.
    """
    corner = Corners()
    product = Products()
    along = Shares()
    share = Shares()
    w = farthest_wrench(contacts, pressure, i, load, -guess)
    corner[0] = as_row(w)
    product[0, 0] = wp.length_sq(w)
    share[0] = 1.0
    kept = int(1)
    bound = float(0.0)
    for _ in range(steps):
        size = wp.length(w)
        if size <= tolerance:
            break
        v = farthest_wrench(contacts, pressure, i, load, -w)
        bound = wp.max(bound, wp.dot(v, w) / size)
        if bound >= (1.0 - GAP) * size:
            break
        slot = int(kept)
        if kept < ROOM:
            kept += 1
        else:
            slot = 0
            for k in range(ROOM):
                if share[k] < share[slot]:
                    slot = k
        w += share[slot] * (v - from_row(corner[slot]))
        corner[slot] = as_row(v)
        row = as_row(w)
        for k in range(kept):
            product[slot, k] = wp.dot(corner[slot], corner[k])
            product[k, slot] = product[slot, k]
            along[k] = wp.dot(corner[k], row)
        exchanges = int(0)
        while exchanges < EXCHANGES:
            exchanges += 1
            near = int(slot)
            far = int(slot)
            most = float(-1.0e30)
            for k in range(kept):
                if share[k] > 0.0 and along[k] < along[near]:
                    near = k
                if share[k] > 0.0 and along[k] > most:
                    most = along[k]
                    far = k
            distance = product[near, near] + product[far, far] - 2.0 * product[near, far]
            moved = wp.clamp((most - along[near]) / wp.max(distance, 1.0e-12), 0.0, share[far])
            share[near] += moved
            share[far] -= moved
            for k in range(kept):
                along[k] += moved * (product[near, k] - product[far, k])
        w = wp.spatial_vector()
        for k in range(kept):
            w += share[k] * from_row(corner[k])
    if bound <= tolerance:
        w = wp.spatial_vector()
    return w


@wp.func
def margin_of(
    contacts: Contacts,
    pressure: Pressure,
    i: int,
    load: wp.spatial_vector,
    directions: wp.array(dtype=wp.spatial_vector),
    steps: int,
) -> float:
    """Least support of the set of wrenches: the least over some directions, then down from the two best."""
    best = float(1.0e30)
    second = float(1.0e30)
    d_best = wp.spatial_vector()
    d_second = wp.spatial_vector()
    for k in range(directions.shape[0]):
        d = directions[k]
        h = wp.dot(farthest_wrench(contacts, pressure, i, load, d), d)
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
            w = farthest_wrench(contacts, pressure, i, load, d)
            h = wp.dot(w, d)
            margin = wp.min(margin, h)
            slope_on_sphere = w - h * d
            d = wp.normalize(d - rate / (1.0 + wp.length(slope_on_sphere)) * slope_on_sphere)
            rate = 0.85 * rate
        margin = wp.min(margin, wp.dot(farthest_wrench(contacts, pressure, i, load, d), d))
    return margin


@wp.kernel
def wrench_margin(
    queue: Queue,
    contacts: Contacts,
    pressure: Pressure,
    directions: wp.array(dtype=wp.spatial_vector),
    steps: int,
    load_in: wp.array(dtype=wp.vec3),
    margin_out: wp.array(dtype=wp.float32),
):
    """Smallest wrench that the grasp cannot resist besides the load (Ferrari and Canny 1992, with given finger forces).
    Below zero, the smallest that is missing to hold the object still."""
    i = take(queue, wp.tid())
    if i < 0:
        return
    load = wp.spatial_vector(load_in[i], wp.vec3(0.0, 0.0, 0.0))
    lay_out(contacts, pressure, i)
    margin_out[i] = margin_of(contacts, pressure, i, load, directions, steps)
