"""The preshapes to propose: steps of one closing motion, or poses in which tips oppose each other."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from graspmatch.gripper.propose.closing import Roles, at_share
from graspmatch.gripper.propose.meeting import Meeting, Pads
from graspmatch.gripper.propose.posing import Mechanism

Array = np.ndarray

JAW_STEPS, JAW_END = 10, 0.9
"""Postures of a hand with one drive, and the last of them as a share of the way from open to closed."""
HAND_STEPS = 4
"""Postures of a hand with several drives, ..."""
SPREAD_STEPS = 3
"""... at each spread, if there are two."""
RISEN = 0.8
"""Share of their greatest depth that fingertips must be in front of the palm to hold something."""
NARROW = 0.2
"""Share of the widest gap below which a posture is of no use."""
PRECISE = (0.03, 0.06)
"""Gaps between the tips of precision preshapes [m]."""
POWERFUL = (0.05, 0.08, 0.11)
"""And of power preshapes [m]."""
BEYOND = 0.12
"""Tips that pinch close past where they meet by this share of the way, so that they press on what is thin."""
MORE = 0.01
"""By which the widest power preshape is wider than the next [m]."""
WHOLE = 1.3
"""What counts in a power preshape is not farther from the tool centre point than so many times the palm's centre."""
AROUND = 0.02
"""What counts of the hand in a precision preshape reaches so far beyond half the gap [m]."""


@dataclass(frozen=True)
class Pose:
    """One preshape of its own."""

    name: str
    joints: Float[Array, "d"]
    closed: Float[Array, "d"] | None = None
    """Where its closing ends, if not where the card's does."""
    tool_centre_point: Float[Array, "3"] | None = None
    reach: float | None = None
    """Only what is so near to the tool centre point counts as inner surface [m]."""


@dataclass(frozen=True)
class Postures:
    """Either steps of the way from open to closed, at some spreads, or poses."""

    steps: int = 0
    closing: tuple[float, float] = (0.0, 0.9)
    spread: dict[str, tuple[float, ...]] = field(default_factory=dict)
    poses: tuple[Pose, ...] = ()


def jaw_postures() -> Postures:
    """Of fingers that share one drive."""
    return Postures(JAW_STEPS, (0.0, JAW_END))


def hand_postures(
    mechanism: Mechanism,
    roles: Roles,
    spreads: list[Float[Array, "d"]],
    closed: Float[Array, "d"],
    approach: Float[Array, "3"],
    gaps: list[float],
) -> Postures:
    """Of fingers that each curl by one drive: from where they have risen in front of the palm to nearly closed.

    `gaps` are the widths between the two sides at even shares of the way from open to closed [m].
    """
    shares = np.linspace(0, 1, len(gaps))
    opened = spreads[0]
    end = np.where(roles.closes != 0, closed, opened)
    deep = [
        float(
            (
                (mechanism.tip_positions(mechanism.pose(opened + s * (end - opened))) - mechanism.palm_centre)
                @ approach
            ).mean()
        )
        for s in shares
    ]
    is_open = np.array(gaps) > NARROW * max(gaps)
    useful = (np.array(deep) > RISEN * max(deep)) & is_open
    chosen = next(shares[which] for which in (useful, is_open, shares < 1) if which.any())
    first, last = float(chosen[0]), float(min(chosen[-1], JAW_END))
    steps = HAND_STEPS if len(spreads) == 1 else SPREAD_STEPS
    changed = [j for j in range(len(opened)) if any(s[j] != opened[j] for s in spreads)]
    if len(changed) <= 1:
        spread = {mechanism.joint_names[j]: tuple(float(s[j]) for s in spreads) for j in changed}
        return Postures(steps, (round(first, 2), round(last, 2)), spread)
    poses = []
    for i, spread_posture in enumerate(spreads):
        stop = np.where(roles.closes != 0, closed, spread_posture)
        for share in np.linspace(first, last, steps):
            name = f"{('parallel', 'round')[min(i, 1)]}_{100 * share:.0f}"
            poses.append(Pose(name, spread_posture + share * (stop - spread_posture)))
    return Postures(poses=tuple(poses))


def many_jointed_postures(
    mechanism: Mechanism,
    roles: Roles,
    pads: Pads,
    opened: Float[Array, "d"],
    meetings: dict[str, Meeting],
    wrapped: dict[str, Float[Array, "d"]],
    tool_centre_point: Float[Array, "3"],
) -> Postures:
    """Precision poses, which open from where tips meet, and power poses, which close until the fingers wrap.

    `wrapped` gives for a power pose where its closing ends; the others are precision poses.
    """
    poses, whole = [], WHOLE * float(np.linalg.norm(tool_centre_point - mechanism.palm_centre))
    for name, meeting in meetings.items():
        fingers = list(meeting.fingers)
        takes_part = roles.closers[fingers].any(axis=0)
        most = widest_gap(mechanism, roles, pads, opened, meeting)
        for gap in power_gaps(most) if name in wrapped else [gap for gap in PRECISE if gap < most]:
            joints = open_to(mechanism, roles, pads, opened, meeting, gap)
            label = f"{name}_{1000 * gap:.0f}"
            if name in wrapped:
                poses.append(Pose(label, joints, np.where(takes_part, wrapped[name], joints), reach=whole))
                continue
            beyond = meeting.joints + BEYOND * (meeting.joints - joints)
            closed = np.where(takes_part, np.clip(beyond, mechanism.lower, mechanism.upper), joints)
            centre = _centre(pads, mechanism.pose(joints), meeting)
            poses.append(Pose(label, joints, closed, centre, gap / 2 + AROUND))
    return Postures(poses=tuple(poses))


def power_gaps(most: float) -> list[float]:
    """The gaps of the power preshapes of a hand that opens to `most` [m]: that too where it is not enough for all."""
    most = min(most, POWERFUL[-1])
    found = [gap for gap in POWERFUL if gap <= most]
    return [*found, most] if most > max(found, default=0.0) + MORE else found


def widest_gap(mechanism: Mechanism, roles: Roles, pads: Pads, opened: Float[Array, "d"], meeting: Meeting) -> float:
    """Between the tips of a meeting's fingers when they are open [m]."""
    return tip_gap(pads, mechanism.pose(_opened_by(roles, opened, meeting, 1.0)), meeting.fingers)


def open_to(
    mechanism: Mechanism,
    roles: Roles,
    pads: Pads,
    opened: Float[Array, "d"],
    meeting: Meeting,
    gap: float,
) -> Float[Array, "d"]:
    """The meeting's posture, its fingers opened until their tips are `gap` apart [m], or as far as they go."""
    low, high = 0.0, 1.0
    for _ in range(20):
        middle = (low + high) / 2
        if tip_gap(pads, mechanism.pose(_opened_by(roles, opened, meeting, middle)), meeting.fingers) < gap:
            low = middle
        else:
            high = middle
    return _opened_by(roles, opened, meeting, high)


def _opened_by(roles: Roles, opened: Float[Array, "d"], meeting: Meeting, share: float) -> Float[Array, "d"]:
    """The meeting's posture, its fingers a share of the way to open."""
    shares = np.zeros(len(roles.moves))
    shares[list(meeting.fingers)] = share
    return at_share(roles, meeting.joints, opened, shares)


def tip_gap(pads: Pads, T_base_link: Float[Array, "l 4 4"], fingers: tuple[int, ...]) -> float:
    """Clear distance between the first fingertip and the middle of the others [m]."""
    centres, _ = pads.posed(T_base_link)
    others = list(fingers[1:])
    apart = float(np.linalg.norm(centres[others].mean(axis=0) - centres[fingers[0]]))
    return apart - float(pads.depths[others].mean()) - float(pads.depths[fingers[0]])


def _centre(pads: Pads, T_base_link: Float[Array, "l 4 4"], meeting: Meeting) -> Float[Array, "3"]:
    """Half way between the first fingertip and the others [m]."""
    centres, _ = pads.posed(T_base_link)
    return (centres[meeting.fingers[0]] + centres[list(meeting.fingers[1:])].mean(axis=0)) / 2
