"""Grasps as a table for people and as one JSON object for programs."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from rich import box
from rich.table import Table

from graspmatch.types import GraspSet, Gripper

if TYPE_CHECKING:
    from graspmatch.planner.arm import Arm
    from graspmatch.planner.waypoints import Waypoints

ROWS = 10
"""The table shows so many of the best grasps."""


def table_of_grasps(grasps: GraspSet, gripper: Gripper) -> Table:
    """The best grasps, one a row: root of the loss, position and approach of the gripper frame in the world frame."""
    shown = min(len(grasps), ROWS)
    title = f"{len(grasps)} grasps for {gripper.name}" + (f", the best {shown}" if shown < len(grasps) else "")
    # Narrow enough for a terminal of 80 columns.
    table = Table(
        title=f"{title}; lengths in mm", title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    for name in ("#", "preshape", "score", "loss", "clear", "touch", "position", "approach"):
        justify = "left" if name == "preshape" else "right"
        table.add_column(name, justify=justify, no_wrap=name != "preshape", overflow="fold")
    approach_world = grasps.T_world_gripper[:, :3, :3] @ gripper.approach
    for i in range(shown):
        table.add_row(
            str(i + 1),
            grasps.preshape_names[grasps.preshape[i]],
            f"{grasps.score[i]:.2f}",
            f"{1000 * math.sqrt(max(grasps.loss[i], 0.0)):.1f}",
            f"{1000 * grasps.clearance[i]:.1f}",
            f"{grasps.fingers_touching[i]}/{len(gripper.fingers)}",
            _numbers(1000 * grasps.T_world_gripper[i, :3, 3], 4, 0),
            _numbers(approach_world[i], 5, 2),
        )
    return table


def timing(seconds: dict[str, float]) -> str:
    """One line with the wall time of each stage."""
    return ", ".join(f"{stage} {time:.2f} s" for stage, time in seconds.items())


def record_of_grasps(grasps: GraspSet, gripper: Gripper, ways: Waypoints, arm: Arm | None = None) -> dict[str, Any]:
    """Everything about a grasp set in types that JSON has; unknown numbers are null."""
    provenance = dataclasses.asdict(grasps.provenance)
    provenance["config"] = json.loads(grasps.provenance.config)
    record = {
        "gripper": gripper.name,
        "gripper_frame": gripper.base_link,
        "joint_names": list(grasps.joint_names),
        "grasps": [
            _record_of_grasp(grasps, i) | {"way": _record_of_way(ways, i, grasps, arm)} for i in range(len(grasps))
        ],
        "tally": dict(grasps.tally),
        "explanation": grasps.explain(),
        "seconds": provenance.pop("seconds"),
        "provenance": provenance,
    }
    return finite_or_null(record)


def _record_of_grasp(grasps: GraspSet, i: int) -> dict[str, Any]:
    """One grasp, metres and radians."""
    return {
        "preshape": grasps.preshape_names[grasps.preshape[i]],
        "T_world_gripper": grasps.T_world_gripper[i].tolist(),
        "T_world_pregrasp": grasps.T_world_pregrasp[i].tolist(),
        "pregrasp_joints": dict(zip(grasps.joint_names, grasps.pregrasp_joints[i].tolist(), strict=True)),
        "grasp_joints": dict(zip(grasps.joint_names, grasps.grasp_joints[i].tolist(), strict=True)),
        "score": float(grasps.score[i]),
        "clearance": float(grasps.clearance[i]),
        "matching_error": float(grasps.matching_error[i]),
        "loss": float(grasps.loss[i]),
        "fingers_touching": int(grasps.fingers_touching[i]),
    }


def _record_of_way(ways: Waypoints, i: int, grasps: GraspSet, arm: Arm | None) -> list[dict[str, Any]]:
    """The poses that the hand goes through, one after the other."""
    steps = []
    for k, name in enumerate(ways.names):
        joints = dict(zip(grasps.joint_names, ways.joints[i, k].tolist(), strict=True))
        step = {"name": name, "T_world_gripper": ways.T_world_gripper[i, k].tolist(), "joints": joints}
        if arm is not None:
            step["arm_joints"] = dict(zip(arm.joint_names, ways.arm_joints[i, k].tolist(), strict=True))
        steps.append(step)
    return steps


def _numbers(values: Float[np.ndarray, "n"], width: int, decimals: int) -> str:
    """Numbers of equal width; the zero has no sign."""
    return " ".join(f"{value + 0.0:{width}.{decimals}f}" for value in np.round(values, decimals))


def finite_or_null(value: Any) -> Any:
    """The same with null for every number that JSON cannot say."""
    if isinstance(value, dict):
        return {key: finite_or_null(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [finite_or_null(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
