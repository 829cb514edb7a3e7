"""Where hands start, from a file of another planner: grasps in any format, or a mixture of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspmatch.apps.numbers import read_pose_text
from graspmatch.apps.options import Seeds
from graspmatch.config import PlannerConfig
from graspmatch.errors import GraspmatchError
from graspmatch.formats.mixture import moved, read_mixture
from graspmatch.formats.registry import NO_FRAME, read_grasps, suffix_of
from graspmatch.geometry import se3
from graspmatch.gripper.load import load_gripper
from graspmatch.gripper.zoo import known_grippers
from graspmatch.types import GraspSet, Gripper

Array = np.ndarray

MOST = 100
"""Of the grasps of a file, so many of the best are started from, in each preshape."""


@dataclass(frozen=True)
class Start:
    """What a file of seeds makes of a plan."""

    config: PlannerConfig
    T_world_gripper: Float[Array, "n 4 4"] | None = None
    """Poses to start from; None: those that the configuration says."""
    notes: tuple[str, ...] = ()


def start_of(options: Seeds, gripper: Gripper, config: PlannerConfig) -> Start:
    """The configuration with the mixture of a file, or the poses of its grasps, as those of this hand in the world."""
    path = options.seeds
    if path is None:
        return Start(config)
    T_world_file = np.eye(4) if options.seeds_pose is None else read_pose_text(options.seeds_pose)
    if suffix_of(path) == ".toml":
        other = _other_hand(options.seeds_gripper, gripper)
        T_other_file = np.linalg.inv(other.T_gripper_canonical) if options.seeds_frame == "canonical" else np.eye(4)
        gaussians = moved(read_mixture(path), T_world_file, T_other_file @ handover(other, gripper))
        seeding = replace(config.seeding, pattern="gaussians", gaussians=gaussians)
        return Start(replace(config, seeding=seeding), notes=(f"Hands start from the Gaussians of {path.name}.",))
    return _start_of_grasps(path, options, gripper, config, T_world_file)


def _start_of_grasps(
    path: Path, options: Seeds, gripper: Gripper, config: PlannerConfig, T_world_file: Float[Array, "4 4"]
) -> Start:
    grasps, other = _read(path, options, gripper)
    if len(grasps) == 0:
        raise GraspmatchError(f"{path.name} has no grasps to start from.")
    poses = T_world_file @ grasps.best(MOST).T_world_gripper @ handover(other, gripper)
    of = "" if other is gripper else f" of {other.name}"
    best = f"the best {MOST} of " if len(grasps) > MOST else ""
    return Start(
        config, poses, (f"Hands start from {best}{len(grasps)} grasp{'s' * (len(grasps) != 1)}{of} in {path.name}.",)
    )


def handover(other: Gripper, gripper: Gripper) -> Float[Array, "4 4"]:
    """T_other_gripper where both hands hold the same thing: approach, closing axis and tool centre point are one."""
    return _T_gripper_tool(other) @ se3.inverse(_T_gripper_tool(gripper))


def _T_gripper_tool(gripper: Gripper) -> Float[Array, "4 4"]:
    return se3.from_parts(gripper.T_gripper_canonical[:3, :3], gripper.tool_centre_point)


def _read(path: Path, options: Seeds, gripper: Gripper) -> tuple[GraspSet, Gripper]:
    """The grasps of a file, and the hand that they are of."""
    frame = options.seeds_frame if suffix_of(path) in NO_FRAME else "base"  # the other formats say which
    other = _other_hand(options.seeds_gripper, gripper)
    grasps = read_grasps(path, other, frame=frame)
    named = grasps.provenance.gripper
    if options.seeds_gripper is None and named != gripper.name and named in known_grippers():
        other = load_gripper(named)
        grasps = read_grasps(path, other, frame=frame)
    return grasps, other


def _other_hand(name: str | None, gripper: Gripper) -> Gripper:
    return gripper if name is None or name == gripper.name else load_gripper(name)
