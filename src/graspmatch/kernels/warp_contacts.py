"""Where closing fingers, palm and table touch an object between them, for CPU and CUDA.

Legend: i grasp, o index of a point of the object, k its place among those that a finger can reach, e among those near
to it; R, shift turn and place of the body in the gripper frame; x point there, n outward normal; p preshape, f finger,
g what touches (the fingers, then palm, then table), c contact of it.
"""

import warp as wp

from graspmatch.kernels.warp_arrival import arrivals
from graspmatch.kernels.warp_blocks import BLOCK, level_of, lowest_bit, points_below
from graspmatch.kernels.warp_fields import NEVER, FieldStack, interpolate
from graspmatch.kernels.warp_reach import PALM_TOUCHES, Body, Hand, Reached, blocks_of
from graspmatch.kernels.warp_wrench import Contacts

wp.set_module_options({"enable_backward": False, "fast_math": False})

LATE = 0.25
"""Closing fraction after a finger's first contact in which what is still touched belongs to its patch, at most; less
where nearly all of the finger's surface goes through the patch in less."""
FACING_FIRST = 0.2
"""Cosine between the way of a finger and its push on a point, at least, for a first contact ..."""
FACING = 0.5
"""... and for the rest of the patch: beside an edge of the object, the other face is not touched."""
LEAST_SLOWNESS = 1.0e-6
"""Closing fraction for each node of a finger's way, at least."""
PALM_FACING = 0.5
"""The same for the approach and what the palm touches."""
SAME_FACE = 0.8
"""Cosine between the normals of a face and of a point on its edge."""
PALM_WAY = 0.006
"""... if it comes nearer by half of this, so far straight back along the approach: else it is beside them [m]."""
TABLE_TOUCHES = 0.0015
"""Points lower above the table than this lie on it [m]."""


@wp.func
def is_before_palm(stack: FieldStack, g: int, x: wp.vec3, gap: float, approach: wp.vec3) -> bool:
    """Whether the hand is straight back along the approach, not beside the point."""
    return interpolate(stack, g, x - PALM_WAY * approach) < gap - 0.5 * PALM_WAY


@wp.func
def across(n: wp.vec3) -> wp.vec3:
    """A unit vector perpendicular to n."""
    hint = wp.where(wp.abs(n[0]) > 0.9, wp.vec3(0.0, 1.0, 0.0), wp.vec3(1.0, 0.0, 0.0))
    return wp.normalize(wp.cross(n, hint))


@wp.func
def push_of(n: wp.vec3, is_edge: int, face: wp.vec3, slowness: wp.vec3) -> wp.vec3:
    """Direction in which a finger pushes a point: against the normal; beside an edge, where it may be any between those
    of the faces, along the middle of that and the finger's way, unless the finger lies on a `face` with that normal
    (zero where it lies on none)."""
    push = -n
    if is_edge == 1 and wp.dot(n, face) <= SAME_FACE:
        push = wp.normalize(push + slowness / wp.max(wp.length(slowness), LEAST_SLOWNESS))
    return push


@wp.func
def slowness_at(i: int, g: int, e: int, reached: Reached) -> wp.vec3:
    if g == reached.slowness.shape[1]:
        return wp.vec3(0.0, 0.0, 0.0)  # the palm
    return wp.vec3(reached.slowness[i, g, 0, e], reached.slowness[i, g, 1, e], reached.slowness[i, g, 2, e])


@wp.func
def put_contact(
    i: int,
    g: int,
    c: int,
    e: int,
    face: wp.vec3,
    R: wp.mat33,
    shift: wp.vec3,
    body: Body,
    reached: Reached,
    contacts: Contacts,
):
    """One of the points near to g as a contact."""
    o = reached.index[i, g, reached.near[i, g, e]]
    contacts.point[i, g, c] = R * body.points[o] + shift
    contacts.push[i, g, c] = push_of(R * body.normals[o], body.is_edge[o], face, slowness_at(i, g, e, reached))


@wp.func
def spread_patch(
    i: int,
    g: int,
    start: int,
    face: wp.vec3,
    R: wp.mat33,
    shift: wp.vec3,
    tolerance: float,
    body: Body,
    reached: Reached,
    contacts: Contacts,
):
    """Contacts of g: `start`, and of the points near to it whose excess is within the tolerance those farthest along
    two axes; all by their places in the list."""
    put_contact(i, g, 0, start, face, R, shift, body, reached, contacts)
    x0 = contacts.point[i, g, 0]
    o = reached.index[i, g, reached.near[i, g, start]]
    beyond = body.beyond[o]
    n0 = R * body.normals[o]
    a = across(n0)
    b = wp.cross(n0, a)
    reach = wp.vec4(0.0, 0.0, 0.0, 0.0)
    corner = wp.vec4i(start, start, start, start)
    for e in range(reached.count[i, g]):
        if reached.excess[i, g, e] <= tolerance:
            x = R * body.points[reached.index[i, g, reached.near[i, g, e]]] + shift - x0
            along = wp.vec2(wp.dot(x, a), wp.dot(x, b))
            for s in range(4):
                value = along[s // 2] * wp.where(s % 2 == 0, 1.0, -1.0)
                if value > reach[s]:
                    reach[s] = value
                    corner[s] = e
    found = int(1)
    for s in range(4):
        e = corner[s]
        is_new = e != start
        for r in range(s):
            is_new = is_new and corner[r] != e
        if is_new:
            put_contact(i, g, found, e, face, R, shift, body, reached, contacts)
            beyond += body.beyond[reached.index[i, g, reached.near[i, g, e]]]
            found += 1
    contacts.count[i, g] = found
    contacts.beyond[i, g] = beyond / float(found)


@wp.func
def touch_table(i: int, g: int, R: wp.mat33, shift: wp.vec3, floor: float, up: wp.vec3, body: Body, contacts: Contacts):
    """Up to four corners that lie on the table: the lowest, and those farthest from it and from one another."""
    lowest = float(1.0e30)
    x0 = wp.vec3()
    for c in range(body.corners.shape[0]):
        x = R * body.corners[c] + shift
        height = wp.dot(up, x)
        if height < lowest:
            lowest = height
            x0 = x
    contacts.count[i, g] = 0
    if lowest - floor <= TABLE_TOUCHES:
        contacts.point[i, g, 0] = x0
        contacts.push[i, g, 0] = up
        a = across(up)
        b = wp.cross(up, a)
        reach = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for s in range(4):
            contacts.point[i, g, 1 + s] = x0
            contacts.push[i, g, 1 + s] = up
        for c in range(body.corners.shape[0]):
            x = R * body.corners[c] + shift
            if wp.dot(up, x) <= wp.max(lowest, floor) + TABLE_TOUCHES:
                along = wp.vec2(wp.dot(x - x0, a), wp.dot(x - x0, b))
                for s in range(4):
                    value = along[s // 2] * wp.where(s % 2 == 0, 1.0, -1.0)
                    if value > reach[s]:
                        reach[s] = value
                        contacts.point[i, g, 1 + s] = x
        contacts.count[i, g] = 5


@wp.func
def touch_finger(
    i: int,
    f: int,
    grid: int,
    R: wp.mat33,
    shift: wp.vec3,
    tolerance: float,
    body: Body,
    hand: Hand,
    reached: Reached,
    fraction: wp.array2d(dtype=wp.float32),
    contacts: Contacts,
):
    """The fraction at which a finger first touches, and the contacts of its patch: of the points within `tolerance` [m]
    of its surface by then, up to five."""
    spacing = hand.arrival.spacing
    A = R / spacing
    b = (shift - hand.arrival.origin[grid]) / spacing
    points = reached.blocks[i, f]
    blocks = blocks_of(i, f, reached)
    near = reached.near[i, f]
    excess = reached.excess[i, f]
    late = wp.min(LATE, tolerance * hand.slowest[grid])
    earliest = float(NEVER)
    start = int(-1)
    count = int(0)
    block = int(0)
    while block < blocks:
        begin = count
        end = wp.where(block == 0, 1, blocks)  # the first block, spread over all, tells how late the others may be
        limit = wp.min(level_of(earliest + late, hand.arrival_step), 255)  # the last level is that of cells never swept
        while block < end:
            mask = points_below(limit, hand.arrival, hand.arrival_levels, grid, A, b, points, block)
            while mask != wp.uint32(0):
                near[count] = block * BLOCK + lowest_bit(mask)
                mask = mask & (mask - wp.uint32(1))
                count += 1
            block += 1
        arrivals(hand.arrival, grid, A, b, points, near, begin, count, excess, reached.slowness[i, f])
        for e in range(begin, count):
            if excess[e] < earliest:
                way = slowness_at(i, f, e, reached)
                n = R * body.normals[reached.index[i, f, near[e]]]
                if -wp.dot(n, way) >= FACING_FIRST * wp.length(way):
                    earliest = excess[e]
                    start = e
    fraction[i, f] = earliest
    reached.count[i, f] = count
    contacts.count[i, f] = 0
    if earliest <= 1.0:
        on_face = int(-1)
        nearest = float(tolerance)
        for e in range(count):  # from fractions to distances
            after = excess[e] - earliest
            excess[e] = NEVER
            if after < late:
                distance = after * spacing / wp.max(reached.slowness[i, f, 3, e], LEAST_SLOWNESS)
                if distance <= tolerance:
                    way = slowness_at(i, f, e, reached)
                    o = reached.index[i, f, near[e]]
                    is_touched = e == start or -wp.dot(R * body.normals[o], way) >= FACING * wp.length(way)
                    if is_touched:
                        excess[e] = distance
                    if is_touched and distance <= nearest and body.is_edge[o] == 0:
                        nearest = distance
                        on_face = e
        face = wp.vec3(0.0, 0.0, 0.0)
        if on_face >= 0:
            start = on_face
            face = R * body.normals[reached.index[i, f, near[on_face]]]
        spread_patch(i, f, start, face, R, shift, tolerance, body, reached, contacts)


@wp.func
def touch_palm(
    i: int,
    g: int,
    p: int,
    R: wp.mat33,
    shift: wp.vec3,
    tolerance: float,
    body: Body,
    hand: Hand,
    reached: Reached,
    contacts: Contacts,
):
    """The contacts of the palm, if the object touches it."""
    points = reached.blocks[i, g]
    blocks = blocks_of(i, g, reached)
    A = R / hand.distance.spacing
    b = (shift - hand.pivot[p] - hand.distance.origin[p]) / hand.distance.spacing
    limit = level_of(PALM_TOUCHES + tolerance, hand.distance_step)
    start = int(-1)
    smallest = float(PALM_TOUCHES)
    count = int(0)
    block = int(0)
    while block < blocks:
        mask = points_below(limit, hand.distance, hand.distance_levels, p, A, b, points, block)
        while mask != wp.uint32(0):
            k = block * BLOCK + lowest_bit(mask)
            mask = mask & (mask - wp.uint32(1))
            o = reached.index[i, g, k]
            if wp.dot(R * body.normals[o], hand.approach) < -PALM_FACING:
                x = R * body.points[o] + shift - hand.pivot[p]
                gap = interpolate(hand.distance, p, x)
                if gap > PALM_TOUCHES or is_before_palm(hand.distance, p, x, gap, hand.approach):
                    reached.near[i, g, count] = k
                    reached.excess[i, g, count] = gap
                    if gap <= smallest:
                        smallest = gap
                        start = count
                    count += 1
        block += 1
    reached.count[i, g] = count
    contacts.count[i, g] = 0
    if start >= 0:
        spread_patch(i, g, start, hand.approach, R, shift, smallest + tolerance, body, reached, contacts)
