"""The wrenches that pressing fingers exert on an object, for CPU and CUDA.

Legend: i grasp, g what presses (the fingers, then palm, then table), c its contacts; n direction in which a contact
pushes the object; d, w direction and point in the space of wrenches: force and torque, torques about the centre of mass
and divided by a length. Forces are in units of one finger's force.
"""

import warp as wp

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
def unit_wrench(contacts: Contacts, pressure: Pressure, i: int, g: int, d: wp.spatial_vector) -> wp.spatial_vector:
    """The wrench of unit normal force that goes farthest along d, of all contacts of g and of their friction cones:
    |t|^2 / friction^2 + m^2 / torsion^2 <= 1 for the force t across, the torque m about the normal."""
    force = wp.spatial_top(d)
    torque = wp.spatial_bottom(d)
    friction = pressure.friction[i] * pressure.friction[i]
    torsion = pressure.torsion / pressure.length * pressure.torsion / pressure.length
    best = float(-1.0e30)
    wrench = wp.spatial_vector()
    for c in range(contacts.count[i, g]):
        n = contacts.push[i, g, c]
        r = (contacts.point[i, g, c] - contacts.centre[i]) / pressure.length
        v = force + wp.cross(torque, r)  # d . (f, r x f) = f . v
        along = wp.dot(v, n)
        slide = v - along * n
        twist = wp.dot(torque, n)
        gain = wp.sqrt(friction * wp.length_sq(slide) + torsion * twist * twist)
        if along + gain > best:
            best = along + gain
            scale = wp.where(gain > 1.0e-9, 1.0 / wp.max(gain, 1.0e-9), 0.0)
            total = n + scale * friction * slide
            wrench = wp.spatial_vector(total, wp.cross(r, total) + scale * torsion * twist * n)
    return wrench


@wp.func
def farthest_wrench(
    contacts: Contacts, pressure: Pressure, i: int, load: wp.spatial_vector, d: wp.spatial_vector
) -> wp.spatial_vector:
    """Of all wrenches on the object, the load included, one that goes farthest along d.

    A drive of several fingers shares out its force among them as the object pushes back; palm and table only react.
    """
    total = load
    fingers = pressure.drive.shape[0]
    for drive in range(fingers):
        farthest = float(-1.0e30)
        of_drive = wp.spatial_vector()
        for f in range(drive, fingers):
            if pressure.drive[f] == drive and contacts.count[i, f] > 0:
                w = unit_wrench(contacts, pressure, i, f, d)
                h = wp.dot(w, d)
                if h > farthest:
                    farthest = h
                    of_drive = pressure.share[f] * w
                    if pressure.share[f] == 1.0 and h > 0.0:
                        of_drive = pressure.most * w
        total += of_drive
    for g in range(fingers, fingers + 2):
        if contacts.count[i, g] > 0:
            w = unit_wrench(contacts, pressure, i, g, d)
            total += wp.where(wp.dot(w, d) > 0.0, REACTION, 0.0) * w
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
    share = Shares()
    w = farthest_wrench(contacts, pressure, i, load, -guess)
    corner[0] = as_row(w)
    share[0] = 1.0
    bound = float(0.0)
    for _ in range(steps):
        size = wp.length(w)
        if size <= tolerance:
            break
        v = farthest_wrench(contacts, pressure, i, load, -w)
        bound = wp.max(bound, wp.dot(v, w) / size)
        if bound >= (1.0 - GAP) * size:
            break
        slot = int(0)
        for k in range(ROOM):
            if share[k] < share[slot]:
                slot = k
        w += share[slot] * (v - from_row(corner[slot]))
        corner[slot] = as_row(v)
        for _ in range(EXCHANGES):
            row = as_row(w)
            near = int(slot)
            far = int(slot)
            least = wp.dot(corner[slot], row)
            most = float(-1.0e30)
            for k in range(ROOM):
                along = wp.dot(corner[k], row)
                if share[k] > 0.0 and along < least:
                    least = along
                    near = k
                if share[k] > 0.0 and along > most:
                    most = along
                    far = k
            way = from_row(corner[near] - corner[far])
            moved = wp.clamp((most - least) / wp.max(wp.length_sq(way), 1.0e-12), 0.0, share[far])
            w += moved * way
            share[near] += moved
            share[far] -= moved
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
    first: int,
    contacts: Contacts,
    pressure: Pressure,
    directions: wp.array(dtype=wp.spatial_vector),
    steps: int,
    load_in: wp.array(dtype=wp.vec3),
    margin_out: wp.array(dtype=wp.float32),
):
    """Smallest wrench that the grasp cannot resist besides the load (Ferrari and Canny 1992, with given finger forces).
    Below zero, the smallest that is missing to hold the object still."""
    i = first + wp.tid()
    load = wp.spatial_vector(load_in[i], wp.vec3(0.0, 0.0, 0.0))
    margin_out[i] = margin_of(contacts, pressure, i, load, directions, steps)
