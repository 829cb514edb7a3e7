"""Grasps of another tool as a `GraspSet`: what its file does not say is unknown, or follows from the hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from graspmatch.errors import GraspmatchError
from graspmatch.formats.jaw import fitting_preshape, openings
from graspmatch.types import GraspSet, Gripper, Provenance

UNKNOWN = "unknown"
"""Name of the preshape where no hand is given."""


MOST_JOINTS = 100
"""Of one hand; a file that names more, one in each grasp, would make a table that fills the memory."""


def joint_names_of(blocks: list[dict[str, float]], path: Path) -> tuple[str, ...]:
    """All names that blocks of joint values have, in the order in which they appear."""
    names = tuple(dict.fromkeys(name for block in blocks for name in block))
    if len(names) > MOST_JOINTS:
        raise GraspmatchError(f"{path} names {len(names)} joints; a hand has at most {MOST_JOINTS}.")
    return names


def joint_table(blocks: list[dict[str, float]], names: tuple[str, ...]) -> Float[np.ndarray, "n d"]:
    """Values of the named joints, NaN where a block does not say."""
    values = [[block.get(name, np.nan) for name in names] for block in blocks]
    return np.array(values, dtype=float).reshape(len(blocks), len(names))


@dataclass(frozen=True)
class Found:
    """What a file says of n grasps, in its order; NaN where it does not."""

    T_world_gripper: Float[np.ndarray, "n 4 4"]
    score: Float[np.ndarray, "n"]
    joint_names: tuple[str, ...] = ()
    """Of the joints that the file has values of."""
    pregrasp_joints: Float[np.ndarray, "n d"] | None = None
    grasp_joints: Float[np.ndarray, "n d"] | None = None
    T_world_pregrasp: Float[np.ndarray, "n 4 4"] | None = None
    preshape: Int[np.ndarray, "n"] | None = None
    """Of the gripper, where the format tells which."""
    hand: str = ""
    """How the file calls the hand or its frame."""


def foreign_grasps(found: Found, path: Path, gripper: Gripper | None) -> GraspSet:
    """The grasps of a file, best first.

    With a gripper, what the file leaves out follows from it: grasps arrive in the widest preshape, after a straight
    approach as long as the gripper's. Joint values at the grasp stay unknown.
    """
    n = len(found.score)
    joints, pregrasp_joints, grasp_joints = _joints(found, gripper)
    preshape, pregrasp_joints = _preshape(found, joints, pregrasp_joints, gripper)
    T_world_pregrasp = np.full((n, 4, 4), np.nan) if found.T_world_pregrasp is None else found.T_world_pregrasp
    if gripper is not None:
        straight = found.T_world_gripper @ gripper.T_gripper_pregrasp
        T_world_pregrasp = np.where(np.isnan(T_world_pregrasp), straight, T_world_pregrasp)
    order = np.argsort(-found.score, kind="stable")  # unknown scores come last
    unknown = np.full(n, np.nan)
    return GraspSet(
        joint_names=joints,
        preshape_names=(UNKNOWN,) if gripper is None else tuple(shape.name for shape in gripper.preshapes),
        T_world_gripper=found.T_world_gripper[order],
        T_world_pregrasp=T_world_pregrasp[order],
        preshape=preshape[order],
        pregrasp_joints=pregrasp_joints[order],
        grasp_joints=grasp_joints[order],
        score=found.score[order],
        clearance=unknown,
        matching_error=unknown,
        loss=unknown,
        quality=unknown,
        fingers_touching=np.full(n, -1),
        tally={"candidates": n},
        provenance=Provenance(
            gripper=found.hand or (gripper.name if gripper else ""),
            gripper_hash=gripper.content_hash if gripper else "",
            config="",
            seed=0,
            device="",
            version="",
            source=str(path),
        ),
    )


def _joints(
    found: Found, gripper: Gripper | None
) -> tuple[tuple[str, ...], Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]]:
    """Names and values: those of the hand where the file has them all, or none at all; else those of the file."""
    shape = (len(found.score), len(found.joint_names))
    names = found.joint_names
    before = np.full(shape, np.nan) if found.pregrasp_joints is None else found.pregrasp_joints
    after = np.full(shape, np.nan) if found.grasp_joints is None else found.grasp_joints
    if gripper is None:
        return names, before, after
    if not names:
        blank = np.full((shape[0], len(gripper.joint_names)), np.nan)
        return gripper.joint_names, blank, blank
    if set(gripper.joint_names) <= set(names):  # what is more are followers
        columns = [names.index(name) for name in gripper.joint_names]
        return gripper.joint_names, before[:, columns], after[:, columns]
    return names, before, after


def _preshape(
    found: Found, joint_names: tuple[str, ...], joints: Float[np.ndarray, "n d"], gripper: Gripper | None
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n d"]]:
    """The preshape that each grasp arrives with, and its joint values where the file has none.

    It is the one that the format tells, else the nearest to the file's joint values, else the widest.
    """
    n = len(joints)
    if gripper is None:
        return np.zeros(n, dtype=int), joints
    preshape = found.preshape
    if preshape is None:
        preshape = fitting_preshape(np.full(n, np.inf), openings(gripper))
    if joint_names != gripper.joint_names:
        return preshape, joints
    shapes = np.array([shape.joints for shape in gripper.preshapes])
    far = np.linalg.norm(joints[:, None] - shapes, axis=-1)
    known = np.isfinite(joints).all(axis=-1)
    preshape = np.where(known, np.argmin(far, axis=-1), preshape)
    return preshape, np.where(np.isnan(joints), shapes[preshape], joints)
