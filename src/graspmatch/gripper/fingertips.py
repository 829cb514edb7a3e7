"""Fingertip preshapes: postures that hold thin, flat and small things between the tips, derived from those of a card.

The inner surface of such a posture counts near the tips only: not the palm, not the lower fingers. A tip is what is
farthest from the root of its finger when the hand is open, so it is found on any hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from graspmatch.geometry import se3
from graspmatch.geometry.grid import Grid, interpolate
from graspmatch.gripper.card import Posture, postures
from graspmatch.gripper.kinematics import HandModel, pose_links

Array = np.ndarray

TIP = 0.25
"""Share of a finger's reach that is its tip."""
TIP_SAMPLES = 5
"""So many samples, at least, along a tip."""
EVENNESS = 0.3
"""What it costs to leave the work to a few fingers, beside a cost of one for a force that is not balanced."""
CLOSING_STEPS = 33
"""Postures in which a gap between the tips is looked for."""


@dataclass(frozen=True)
class Tips:
    """The fingers of a hand from root to tip."""

    links: tuple[tuple[int, ...], ...]
    """Of each finger, as indices into the links of the hand."""
    T_gripper_open: Float[Array, "l 4 4"]
    """All links of the open hand."""
    root: Float[Array, "f 3"]
    """Where each finger begins in the open hand [m]."""
    reach: Float[Array, "f"]
    """How far the farthest point of each finger is from there [m]."""
    tip: Float[Array, "f 3"]
    """That point, in the frame of the link `tip_link` [m]."""
    tip_link: tuple[int, ...]

    @property
    def length(self) -> float:
        """Of the shortest tip [m]."""
        return TIP * float(self.reach.min())


def with_fingertips(hand: HandModel, fields: Sequence[Grid]) -> list[Posture]:
    """All preshapes of a hand: those that its card asks for, then those of the fingertips for each spread; `fields` are
    the signed distances of its links. A card with precision postures of its own needs no others."""
    whole = postures(hand.card, hand.joint_names)
    groups = by_spread(whole, hand)
    if len(hand.card.fingers) < 2 or any(np.isfinite(posture.reach) for posture in whole):
        return whole
    tips = find_tips(hand)
    return whole + [tip for group in groups for tip in _pinching(group, tips, hand, fields, is_only=len(groups) == 1)]


def by_spread(whole: Sequence[Posture], hand: HandModel) -> list[list[Posture]]:
    """The postures, those that differ in closing only together."""
    groups: dict[tuple[float, ...], list[Posture]] = {}
    for posture in whole:
        groups.setdefault(tuple(posture.joints[~_closes(hand)]), []).append(posture)
    return list(groups.values())


def find_tips(hand: HandModel) -> Tips:
    """The tips of all fingers."""
    T_gripper_open = pose_links(hand, hand.card.open_joints)
    names = [link.name for link in hand.links]
    links = tuple(tuple(i for i, name in enumerate(names) if name in finger.links) for finger in hand.card.fingers)
    root, reach, tip, tip_link = [], [], [], []
    for own in links:
        start = T_gripper_open[own[0], :3, 3]  # parents come first
        corners = [(i, corner) for i in own for corner in hand.links[i].collision.vertices]
        points = np.array([se3.apply(T_gripper_open[i], corner[None])[0] for i, corner in corners])
        distance = np.linalg.norm(points - start, axis=-1)
        farthest = int(np.argmax(distance))
        root.append(start)
        reach.append(distance[farthest])
        tip.append(corners[farthest][1])
        tip_link.append(corners[farthest][0])
    return Tips(links, T_gripper_open, np.array(root), np.array(reach), np.array(tip), tuple(tip_link))


def tip_weights(
    points: Float[Array, "n 3"],
    finger_shares: Float[Array, "f"],
    T_gripper_link: Float[Array, "l 4 4"],
    fields: Sequence[Grid],
    tips: Tips,
) -> Float[Array, "n"]:
    """Weights of samples of a posture, mean one: alike on one tip, all of a tip together as its finger's share, zero
    elsewhere. All zero where one of these tips has no sample."""
    distance = np.stack(
        [np.abs(interpolate(f, se3.apply(se3.inverse(T), points))) for f, T in zip(fields, T_gripper_link, strict=True)]
    )
    link = np.argmin(distance, axis=0)  # that each lies on
    weights = np.zeros(len(points))
    for f in np.flatnonzero(finger_shares):
        along = np.zeros(len(points))
        for i in tips.links[f]:
            open_points = se3.apply(tips.T_gripper_open[i] @ se3.inverse(T_gripper_link[i]), points[link == i])
            along[link == i] = np.linalg.norm(open_points - tips.root[f], axis=-1)
        is_tip = along > (1 - TIP) * tips.reach[f]
        if not is_tip.any():
            return np.zeros(len(points))
        weights[is_tip] = finger_shares[f] / is_tip.sum()
    return weights / weights.mean()


def _pinching(
    group: Sequence[Posture], tips: Tips, hand: HandModel, fields: Sequence[Grid], *, is_only: bool
) -> list[Posture]:
    """The widest posture of a group, and others on the way to tips that meet: the gap between the tips halves from one
    to the next, since the less fingers have to close, the less their tips leave the place where they are wanted."""
    count = hand.card.preshapes.fingertips
    widest = group[int(np.argmax([_spread(tip_places(posture.joints, tips, hand)) for posture in group]))]
    closed = widest.closed
    way = [widest.joints + u * (closed - widest.joints) for u in np.linspace(0, 1, CLOSING_STEPS)]
    places = np.array([tip_places(joints, tips, hand) for joints in way])
    nearest = int(np.argmin([_spread(place) for place in places]))
    meeting = next((k for k in range(nearest) if _tips_touch(way[k], tips, hand, fields)), nearest)
    if meeting == 0:
        return []
    open_by = places[: meeting + 1] - places[meeting]
    gap = 2 * np.linalg.norm(open_by, axis=-1).mean(axis=-1)
    wanted = gap[0] / 2.0 ** np.arange(count)
    fractions = np.interp(-wanted, -gap, np.linspace(0, 1, CLOSING_STEPS)[: meeting + 1])
    prefix = "" if is_only else f"{widest.name}_"
    shares = balanced_shares(open_by[0])
    return [
        replace(
            widest,
            name=f"{prefix}fingertips_{1000 * width:.0f}mm",
            joints=widest.joints + u * (closed - widest.joints),
            finger_shares=shares,
        )
        for width, u in zip(wanted, fractions, strict=True)
    ]


def balanced_shares(open_by: Float[Array, "f 3"]) -> Float[Array, "f"]:
    """How hard each finger presses where all balance; their sum is one. `open_by` is where each tip comes from [m]."""
    from scipy.optimize import nnls

    f = len(open_by)
    pushes = open_by / np.maximum(np.linalg.norm(open_by, axis=-1, keepdims=True), 1e-9)
    even = EVENNESS * np.eye(f)
    shares, _ = nnls(np.vstack([pushes.T, np.ones(f), even]), np.r_[0.0, 0.0, 0.0, 1.0, np.zeros(f)])
    return shares / shares.sum()


def tip_places(joints: Float[Array, "d"], tips: Tips, hand: HandModel) -> Float[Array, "f 3"]:
    """Where the tips of a posture are [m]."""
    T_gripper_link = pose_links(hand, joints)
    return np.stack(
        [se3.apply(T_gripper_link[i], tip[None])[0] for i, tip in zip(tips.tip_link, tips.tip, strict=True)]
    )


def _tips_touch(joints: Float[Array, "d"], tips: Tips, hand: HandModel, fields: Sequence[Grid]) -> bool:
    """Whether a corner of the last link of a finger is inside another finger."""
    T_gripper_link = pose_links(hand, joints)
    for f, tip_link in enumerate(tips.tip_link):
        corners = se3.apply(T_gripper_link[tip_link], hand.links[tip_link].collision.vertices)
        for i in (i for g, own in enumerate(tips.links) if g != f for i in own):
            if np.any(interpolate(fields[i], se3.apply(se3.inverse(T_gripper_link[i]), corners)) < 0):
                return True
    return False


def _spread(places: Float[Array, "f 3"]) -> float:
    """Root mean square distance of the tips from their middle [m]."""
    return float(np.sqrt(np.mean(np.sum((places - places.mean(axis=0)) ** 2, axis=-1))))


def _closes(hand: HandModel) -> Array:
    """Which driven joints close fingers."""
    return np.array([hand.card.joints[name].closed is not None for name in hand.joint_names])
