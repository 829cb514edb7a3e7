"""What a baseline returns: its grasps as a `GraspSet`, so that every method goes through the same trials."""

from __future__ import annotations

import json
from importlib.metadata import version

import numpy as np
from jaxtyping import Float, Int

from graspmatch.types import GraspSet, Gripper, Provenance


def grasp_set(
    name: str,
    T_world_gripper: Float[np.ndarray, "n 4 4"],
    preshape: Int[np.ndarray, "n"],
    pregrasp_joints: Float[np.ndarray, "n d"],
    grasp_joints: Float[np.ndarray, "n d"],
    score: Float[np.ndarray, "n"],
    gripper: Gripper,
    tally: dict[str, int],
    seed: int,
    *,
    fingers_touching: Int[np.ndarray, "n"] | None = None,
    advice: str = "",
    source: str = "",
    device: str = "cpu",
    seconds: dict[str, float] | None = None,
) -> GraspSet:
    """The grasps of the baseline `name`, sorted by falling score; what a baseline does not know is NaN, or -1 fingers.

    The straight way in begins `gripper.approach_distance` back along the approach. `tally` says under "candidates" how
    many there were, then how many were dropped for which reason.
    """
    n = len(T_world_gripper)
    order = np.argsort(-score, kind="stable")
    T_world_gripper = T_world_gripper[order]
    touching = np.full(n, -1) if fingers_touching is None else fingers_touching
    return GraspSet(
        joint_names=gripper.joint_names,
        preshape_names=tuple(shape.name for shape in gripper.preshapes),
        T_world_gripper=T_world_gripper,
        T_world_pregrasp=T_world_gripper @ gripper.T_gripper_pregrasp,
        preshape=preshape[order],
        pregrasp_joints=pregrasp_joints[order],
        grasp_joints=grasp_joints[order],
        score=score[order],
        clearance=np.full(n, np.nan),
        matching_error=np.full(n, np.nan),
        loss=np.full(n, np.nan),
        quality=np.full(n, np.nan),
        fingers_touching=touching[order],
        tally=dict(tally),
        provenance=Provenance(
            gripper=gripper.name,
            gripper_hash=gripper.content_hash,
            config=json.dumps({"baseline": name}),
            seed=seed,
            device=device,
            version=version("graspmatch"),
            source=source,
            seconds=seconds or {},
        ),
        advice=advice,
    )
