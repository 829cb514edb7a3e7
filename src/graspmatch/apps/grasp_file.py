"""A file of grasps and the hand that it is for."""

from __future__ import annotations

from pathlib import Path

from graspmatch.apps.hand import Hand, load_hand
from graspmatch.apps.speech import Speech
from graspmatch.config import PlannerConfig
from graspmatch.errors import GraspmatchError
from graspmatch.formats.registry import NO_HAND, read_grasps, suffix_of
from graspmatch.gripper.card import read_card
from graspmatch.gripper.zoo import card_path, known_grippers
from graspmatch.types import GraspSet


def hand_and_grasps(
    path: Path, gripper: str | None, description: Path | None, config: PlannerConfig, say: Speech
) -> tuple[Hand, GraspSet]:
    """The grasps of a file, and the hand that is given or else named by the file; refused where they do not fit."""
    if gripper is not None and suffix_of(path) in NO_HAND:
        hand = load_hand(gripper, description, config, say)
        return hand, read_grasps(path, hand.gripper)
    grasps = read_grasps(path)
    hand = load_hand(gripper or named_hand(grasps, path), description, config, say)
    if grasps.joint_names != hand.gripper.joint_names:
        raise GraspmatchError(
            f"{path} has the joints {', '.join(grasps.joint_names)}; {hand.gripper.name} has "
            f"{', '.join(hand.gripper.joint_names)}."
        )
    return hand, grasps


def named_hand(grasps: GraspSet, path: Path) -> str:
    """Name of the built-in hand that a file is for; `GraspmatchError` where it is for another or for none."""
    named = grasps.provenance.gripper
    known = {read_card(card_path(name)).name: name for name in known_grippers()}
    if named not in known:
        raise GraspmatchError(f"{path} is for '{named or 'no hand'}', which is not built in: give --gripper.")
    return known[named]
