"""What can be wrong with a card that reads well: fingers that run into each other, joints that move nothing."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.se3 import apply
from graspmatch.gripper.card import postures
from graspmatch.gripper.kinematics import HandModel, pose_links
from graspmatch.gripper.propose.touching import Touching

Array = np.ndarray

DEEP = 0.003
"""Overlap of two links in a preshape that is told [m]: descriptions are not made more exactly."""
STILL = 1e-3
"""A joint whose way moves no link farther moves nothing [m]."""
ROOM = 0.01
"""Beyond the closed fingers, within which the tool centre point counts as enclosed [m]."""


def check_hand(hand: HandModel, touching: Touching) -> list[str]:
    """What a person should look at, one sentence each; empty where all is well. `touching` is of the same links."""
    return [*_overlaps(hand, touching), *_idle_joints(hand), *_open_centre(hand)]


def _overlaps(hand: HandModel, touching: Touching) -> list[str]:
    """Preshapes in which one finger is inside another or inside the palm."""
    card, found = hand.card, []
    parts = {finger.name: _links(hand, finger.links) for finger in card.fingers} | {"the palm": _links(hand, card.palm)}
    names = list(parts)
    for posture in postures(card, hand.joint_names):
        T = pose_links(hand, posture.joints)
        for i, first in enumerate(names):
            for second in names[i + 1 :]:
                depth = -touching.clearance(parts[first], parts[second], T)
                if depth > DEEP:
                    found.append(
                        f"In the preshape '{posture.name}' {first} and {second} overlap by {1000 * depth:.0f} mm."
                    )
    return found


def _idle_joints(hand: HandModel) -> list[str]:
    """Driven joints that move no link."""
    card, found = hand.card, []
    for j, name in enumerate(hand.joint_names):
        reach = [p.joints[j] for p in postures(card, hand.joint_names)]
        ends = sorted({card.open_joints[j], card.closed_joints[j], *reach, *_limits(hand, j)})
        low, high = card.open_joints.copy(), card.open_joints.copy()
        low[j], high[j] = ends[0], ends[-1]
        before, after = _corners(hand, pose_links(hand, low)), _corners(hand, pose_links(hand, high))
        if max(float(np.abs(a - b).max()) for a, b in zip(before, after, strict=True)) < STILL:
            found.append(f"The driven joint '{name}' moves no link: remove it from the card, or give it a range.")
    return found


def _open_centre(hand: HandModel) -> list[str]:
    """Whether the tool centre point lies between the closed fingers."""
    card = hand.card
    T = pose_links(hand, card.closed_joints)
    sides = np.concatenate([_corners(hand, T)[i] for finger in card.fingers for i in _links(hand, finger.links)])
    along = sides @ card.closing
    value = float(card.tool_centre_point @ card.closing)
    if along.min() - ROOM <= value <= along.max() + ROOM:
        return []
    return ["The closed fingers do not enclose the tool centre point: check tool_centre_point and closing."]


def _limits(hand: HandModel, joint: int) -> list[float]:
    return [float(v) for v in (hand.lower[joint], hand.upper[joint]) if np.isfinite(v)]


def _links(hand: HandModel, names: tuple[str, ...]) -> list[int]:
    return [i for i, link in enumerate(hand.links) if link.name in names]


def _corners(hand: HandModel, T_base_link: Float[Array, "l 4 4"]) -> list[Float[Array, "_ 3"]]:
    return [apply(T, link.collision.vertices) for link, T in zip(hand.links, T_base_link, strict=True)]
