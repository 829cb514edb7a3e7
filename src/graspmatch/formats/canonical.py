"""Lists of poses of a hand's base, turned so that z is the approach and x the closing: ACRONYM and GraspGen.

Both store (n,4,4) transforms of the canonical frame in the frame of the object's mesh, and for each whether the object
was in the hand at the end of a simulation. Neither has joint values nor names for what else we know of a grasp. That
goes along as a block of our own, and counts as long as the transforms are the ones that it was written with.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspmatch.errors import GraspmatchError
from graspmatch.formats.foreign import Found, foreign_grasps
from graspmatch.formats.native import check_poses, grasp_set
from graspmatch.geometry import se3
from graspmatch.types import GraspSet, Gripper

HOLDS = 0.5
"""A grasp of at least this confidence is written as one that holds."""
SAME = 1e-6
"""Transforms within this of those that our block was written with are the same [1, m]."""

Block = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Our own block: texts, among them the canonical frame, and arrays."""


def canonical_poses(grasps: GraspSet, gripper: Gripper) -> Float[np.ndarray, "n 4 4"]:
    """T_world_canonical of each grasp."""
    return grasps.T_world_gripper @ gripper.T_gripper_canonical


def in_gripper(grasps: GraspSet, path: Path) -> np.ndarray:
    """1 for each grasp that is more likely to hold than not, else 0: what these formats have in place of a score."""
    if np.isnan(grasps.score).any():
        raise GraspmatchError(
            f"Cannot write {path}: the format says of each grasp whether it holds, and grasp "
            f"{int(np.argmax(np.isnan(grasps.score)))} has no score. Possible: .npz, .yaml."
        )
    return (grasps.score >= HOLDS).astype(np.int64)


def canonical_grasps(
    transforms: np.ndarray, held: np.ndarray, block: Block | None, path: Path, gripper: Gripper | None, hand: str = ""
) -> GraspSet:
    """The grasps of (n,4,4) transforms and (n) verdicts; raises a ValueError where they are none."""
    transforms, score = _checked(transforms, held)
    if block is not None:
        texts, arrays = block
        T_gripper_canonical = np.array(texts["T_gripper_canonical"], dtype=float)
        check_poses("T_gripper_canonical", T_gripper_canonical.reshape(1, 4, 4))
        own = grasp_set(texts, arrays)
        written = own.T_world_gripper @ T_gripper_canonical
        if written.shape == transforms.shape and np.abs(written - transforms).max(initial=0) <= SAME:
            return own
    if gripper is None:
        raise GraspmatchError(f"{path} says nothing about the hand's frame: give it, read_grasps(path, gripper).")
    T_world_gripper = transforms @ se3.inverse(gripper.T_gripper_canonical)
    return foreign_grasps(Found(T_world_gripper=T_world_gripper, score=score, hand=hand), path, gripper)


def _checked(transforms: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses and scores of what a file has."""
    if transforms.size == 0:
        transforms = np.zeros((0, 4, 4))
    if held.size == 0:
        held = np.zeros(0)
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or transforms.dtype.kind not in "fiu":
        raise ValueError(
            f"'transforms' holds {transforms.dtype} of the shape {transforms.shape}, expected numbers of (n, 4, 4)"
        )
    if held.shape != (len(transforms),) or held.dtype.kind not in "biuf":
        raise ValueError(
            f"'object_in_gripper' holds {held.dtype} of the shape {held.shape}, expected 0 or 1 for each of "
            f"{len(transforms)} grasps"
        )
    if not np.isin(held, (0, 1)).all():
        raise ValueError("'object_in_gripper' has values other than 0 and 1")
    transforms = transforms.astype(float)
    check_poses("transforms", transforms)
    return transforms, held.astype(float)
