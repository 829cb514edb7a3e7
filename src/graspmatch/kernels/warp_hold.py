"""An object between closing fingers: it gives way until friction balances them, then it is lifted, on CPU and CUDA.

Quasi-static: speeds are so low that only the order of events matters. All fingers close at one pace, and the object
moves along the shortest of all wrenches that contacts within their friction cones can add up to, as if in honey.

Legend, as in `warp_contacts` and `warp_wrench`: i grasp, f finger, g what touches, p preshape, q, c turn and place of
the object's centre of mass in the gripper frame; w wrench.
"""

import warp as wp

from graspmatch.kernels.warp_contacts import touch_finger, touch_palm, touch_table
from graspmatch.kernels.warp_fields import NEVER, place_of, turn_of
from graspmatch.kernels.warp_queue import Queue, take
from graspmatch.kernels.warp_reach import Body, Hand, Reached, gather
from graspmatch.kernels.warp_wrench import Contacts, Pressure, lay_out, least_wrench, margin_of

wp.set_module_options({"enable_backward": False, "fast_math": False})

CLOSING = 0
LIFTED = 1
HELD = 2
LOST = 3
LOST_MARGIN = -1.0
"""Of what is lost: as if a whole finger's force were missing."""
SLACK = 0.01
"""Closing fraction within which fingers count as touching together."""
SHORTEST = 0.2
"""Share of the first step at which the object is said to be jammed: steps are halved where they turn back."""
FIGURES = 8
"""Way and turn until the lift, then from it: [m], [rad]; then these four:"""
BEYOND = 4
"""How far from what was seen a finger touches, at most [m]."""
MARGIN = 5
"""Of the grasp, see `wrench_margin`."""
STATE = 6
"""`HELD` or `LOST`."""
TOUCHES = 7
"""Number of contacts of fingers and palm."""


@wp.struct
class Course:
    """How the object is followed."""

    step: wp.float32
    """[m]; turns are measured by the object's length."""
    closing_steps: wp.int32
    lifting_steps: wp.int32
    tolerance: wp.float32
    """Wrenches that are shorter count as none, in units of one finger's force."""
    searches: wp.int32
    """Steps of the search for the shortest wrench ..."""
    descents: wp.int32
    """... and for the weakest direction."""
    weight: wp.float32
    """Of the object, in units of one finger's force."""
    patch: wp.float32
    """Depth of a contact patch [m]."""
    turns: wp.float32
    """One; zero for an object that fingers can push but not turn."""


@wp.func
def press(i: int, state: int, closed: float, pressure: Pressure, fraction: wp.array2d(dtype=wp.float32)) -> int:
    """Fingers that press on the object, as bits: those that it meets by the fraction to which all have closed. Once it
    is lifted, drives of one finger have closed fully."""
    bits = int(0)
    for f in range(fraction.shape[1]):
        limit = closed + SLACK
        if state == LIFTED and pressure.share[f] == 1.0:
            limit = 1.0
        if fraction[i, f] <= wp.min(limit, 1.0):
            bits = bits | (1 << f)
    return bits


@wp.func
def next_to_touch(i: int, pressing: int, pressure: Pressure, fraction: wp.array2d(dtype=wp.float32)) -> float:
    """Fraction at which the next finger meets the object, of those whose drive nothing stops."""
    fingers = fraction.shape[1]
    least = float(NEVER)
    for f in range(fingers):
        stopped = int(0)
        for other in range(fingers):
            if pressure.drive[other] == pressure.drive[f] and (pressing >> other) & 1 == 1:
                stopped = 1
        if stopped == 0:
            least = wp.min(least, fraction[i, f])
    return least


@wp.kernel
def hold(
    queue: Queue,
    body: Body,
    hand: Hand,
    pressure: Pressure,
    course: Course,
    directions: wp.array(dtype=wp.spatial_vector),
    preshape_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.mat44),
    reached: Reached,
    contacts: Contacts,
    fraction: wp.array2d(dtype=wp.float32),
    figures_out: wp.array2d(dtype=wp.float32),
):
    """Whether the object is held in the end, its contacts then, and the margin of the grasp: see `wrench_margin`.

    `contacts` and `fraction` come out as they are in the end, those of what does not press left out.
    """
    i = take(queue, wp.tid())
    if i < 0:
        return
    p = preshape_in[i]
    fingers = fraction.shape[1]
    R = wp.transpose(turn_of(pose_in[i]))
    q = wp.normalize(wp.quat_from_matrix(R))
    c = -(R * place_of(pose_in[i]))
    up = -(R * body.down)
    floor = body.table + wp.dot(body.down, place_of(pose_in[i]))
    gather(i, p, R, c, body, hand, reached)
    weight = wp.spatial_vector(-course.weight * up, wp.vec3(0.0, 0.0, 0.0))
    load = wp.where(body.table > -1.0e3, weight, wp.spatial_vector())  # what lies on nothing floats until it is held
    for k in range(FIGURES):
        figures_out[i, k] = 0.0
    state = int(CLOSING)
    closed = float(-1.0)
    pressing = int(0)
    step = float(course.step)
    steps = int(0)
    last = weight
    has_moved = int(1)
    while state < HELD:
        if has_moved == 1:
            R = wp.quat_to_matrix(q)
            contacts.centre[i] = c
            for f in range(fingers):
                grid = p * fingers + f
                touch_finger(i, f, grid, R, c, course.patch, body, hand, reached, fraction, contacts)
                contacts.touching[i, f] = contacts.count[i, f]
            touch_palm(i, fingers, p, R, c, course.patch, body, hand, reached, contacts)
            if state == CLOSING:
                touch_table(i, fingers + 1, R, c, floor, up, body, contacts)
            has_moved = 0
        for f in range(fingers):
            contacts.count[i, f] = contacts.touching[i, f]
        if state == LIFTED:
            contacts.count[i, fingers + 1] = 0
        followed = float(NEVER)  # the fingers that pressed have followed the object
        earliest = float(NEVER)
        for f in range(fingers):
            earliest = wp.min(earliest, fraction[i, f])
            if (pressing >> f) & 1 == 1:
                followed = wp.min(followed, fraction[i, f])
        if followed <= 1.0:
            closed = wp.max(closed, followed)
        closed = wp.max(closed, earliest)
        pressing = press(i, state, closed, pressure, fraction)
        for f in range(fingers):
            if (pressing >> f) & 1 == 0:
                contacts.count[i, f] = 0
        if earliest > 1.0:
            state = LOST
        else:
            lay_out(contacts, pressure, i)
            w = least_wrench(contacts, pressure, i, load, last, course.tolerance, course.searches)
            size = wp.length(w)
            if steps > 0 and wp.dot(w, last) < 0.0:
                step = 0.5 * step
            at_rest = size == 0.0 or step < SHORTEST * course.step
            following = next_to_touch(i, pressing, pressure, fraction)
            if at_rest and state == CLOSING and following <= 1.0:
                closed = following
                step = course.step
            elif state == CLOSING and (at_rest or steps >= course.closing_steps):
                state = int(LIFTED)
                load = weight
                step = course.step
                steps = 0
            elif at_rest:
                state = int(HELD)
            elif state == LIFTED and steps >= course.lifting_steps:
                state = int(LOST)
            else:
                move = step / size * wp.spatial_top(w)
                turn = course.turns * step / size / pressure.length * wp.spatial_bottom(w)
                angle = wp.length(turn)
                c += move
                if angle > 1.0e-9:
                    q = wp.normalize(wp.quat_from_axis_angle(turn / angle, angle) * q)
                figures_out[i, 2 * state] += wp.length(move)
                figures_out[i, 2 * state + 1] += angle
                steps += 1
                last = w
                has_moved = 1
    contacts.count[i, fingers + 1] = 0
    for f in range(fingers):
        if contacts.count[i, f] > 0:
            figures_out[i, BEYOND] = wp.max(figures_out[i, BEYOND], contacts.beyond[i, f])
    margin = float(LOST_MARGIN)
    if state == HELD or course.turns == 0.0:
        lay_out(contacts, pressure, i)
        margin = margin_of(contacts, pressure, i, weight, directions, course.descents)
        if margin < -course.tolerance:
            state = int(LOST)  # the search for the least wrench did not find what the one for the margin does
    figures_out[i, STATE] = float(state)
    figures_out[i, MARGIN] = margin
    for g in range(fingers + 1):
        figures_out[i, TOUCHES] += float(contacts.count[i, g])
