"""From a name or a card to a `Gripper`: read, checked, baked once, cached by content."""

from __future__ import annotations

import hashlib
import re
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from graspmatch.config import BakingConfig
from graspmatch.gripper.bake import bake_links, bake_preshape, corridor
from graspmatch.gripper.cache import read_gripper, write_gripper
from graspmatch.gripper.description import content_hash
from graspmatch.gripper.fingertips import with_fingertips
from graspmatch.gripper.kinematics import HandModel, load_hand
from graspmatch.gripper.zoo import card_path
from graspmatch.types import Finger, Gripper, Preshape

BAKING_VERSION = 6
"""Raised whenever baking gives another result for the same input."""


def load_gripper(
    name: str | Path, *, description: str | Path | None = None, baking: BakingConfig | None = None
) -> Gripper:
    """A built-in hand by name, or any hand by the path of its card (TOML); `description` takes another file of it.

    The first load of a hand bakes its preshapes, which takes seconds; later ones read the cache. Raises
    `GraspmatchError` for an unknown name, and for a card that does not fit its description.
    """
    baking = baking or BakingConfig()
    hand = load_hand(card_path(name), description)
    content = content_hash(hand.card, hand.description)
    key = _cache_key(hand.card.name, content, baking)
    cached = read_gripper(key)
    if cached is not None:
        return replace(cached, description=hand.description.path)
    usual = BakingConfig.approach_distance
    if baking.approach_distance == usual:
        gripper = bake_gripper(hand, content, baking)
    else:  # only the fields of the way in are others
        gripper = with_way_in(
            load_gripper(name, description=description, baking=replace(baking, approach_distance=usual)), baking
        )
    write_gripper(key, gripper)
    return gripper


def with_way_in(gripper: Gripper, baking: BakingConfig) -> Gripper:
    """The same hand with another length of the straight way in."""
    preshapes = tuple(replace(p, corridor=corridor(p.hand, gripper.approach, baking)) for p in gripper.preshapes)
    return replace(gripper, preshapes=preshapes, approach_distance=baking.approach_distance)


def bake_gripper(hand: HandModel, content: str, baking: BakingConfig) -> Gripper:
    """All preshapes of a hand, from its card and description."""
    card = hand.card
    fingers = tuple(
        Finger(finger.name, finger.links, tuple(hand.joint_names.index(joint) for joint in finger.joints))
        for finger in card.fingers
    )
    open_joints, closed_joints = (np.array(values, dtype=float) for values in (card.open_joints, card.closed_joints))
    links = bake_links(hand.links, baking)
    preshapes: list[Preshape] = []
    for posture in with_fingertips(hand, links.fields):
        preshape = bake_preshape(hand, links, fingers, posture, baking, others=preshapes)
        preshapes += [] if preshape is None else [preshape]
    return Gripper(
        name=card.name,
        description=hand.description.path,
        base_link=card.base_link,
        joint_names=hand.joint_names,
        lower=hand.lower,
        upper=hand.upper,
        open_joints=open_joints,
        closed_joints=closed_joints,
        links=hand.links,
        fingers=fingers,
        approach=card.approach,
        closing=card.closing,
        tool_centre_point=card.tool_centre_point,
        finger_force=card.finger_force,
        opening=card.opening,
        approach_distance=baking.approach_distance,
        preshapes=tuple(preshapes),
        content_hash=content,
    )


def _cache_key(name: str, content: str, baking: BakingConfig) -> str:
    recipe = f"{content} {BAKING_VERSION} {version('graspmatch')} {sorted(asdict(baking).items())}"
    return f"{re.sub(r'[^A-Za-z0-9_-]', '_', name)}-{hashlib.sha256(recipe.encode()).hexdigest()[:20]}"
