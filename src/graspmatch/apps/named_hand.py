"""The hand that a file of grasps names."""

from __future__ import annotations

from pathlib import Path

from graspmatch.errors import GraspmatchError
from graspmatch.gripper.card import read_card
from graspmatch.gripper.zoo import card_path, known_grippers
from graspmatch.types import GraspSet


def named_hand(grasps: GraspSet, path: Path) -> str:
    """Name of the built-in hand that a file is for; `GraspmatchError` where it is for another or for none."""
    named = grasps.provenance.gripper
    known = {read_card(card_path(name)).name: name for name in known_grippers()}
    if named not in known:
        raise GraspmatchError(f"{path} is for '{named or 'no hand'}', which is not built in: give --gripper.")
    return known[named]
