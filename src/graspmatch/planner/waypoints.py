"""Grasps as the poses and joint values that a robot goes through, one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from graspmatch.config import PlannerConfig
from graspmatch.kernels.launch import resolve_device
from graspmatch.planner.arm import Arm
from graspmatch.planner.avoid import upload_space
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.path import lifts, poses_of_way, way_of
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet, Gripper

Array = np.ndarray

NAMES = ("pregrasp", "grasp", "closed", "out")


@dataclass(frozen=True)
class Waypoints:
    """n ways of four poses: where the approach begins, at the grasp, the same with closed fingers, out with the object;
    straight lines between them."""

    names: tuple[str, ...]
    T_world_gripper: Float[Array, "n 4 4 4"]
    joints: Float[Array, "n 4 d"]
    """Of the hand; `closed` and `out` have those of the first contact, and the fingers go on squeezing."""
    goes_up: Bool[Array, "n"]
    """Whether the way out is straight up; else it is back along the approach."""
    arm_joints: Float[Array, "n 4 j"]
    """Of the robot's arm, where one is given; NaN where it cannot follow."""


def waypoints(
    grasps: GraspSet, scene: Scene, gripper: Gripper, config: PlannerConfig | None = None, *, arm: Arm | None = None
) -> Waypoints:
    """The ways of grasps that were planned for a scene with this configuration."""
    config = config or PlannerConfig()
    way = way_of(scene, upload_space(scene, gripper, resolve_device(config.device)), config)
    candidates = Candidates(grasps.preshape, grasps.T_world_gripper)
    start, grasp, out = np.moveaxis(poses_of_way(candidates, way), 1, 0)
    poses = np.stack([start, grasp, grasp, out], axis=1)
    opened, closed = grasps.pregrasp_joints, grasps.grasp_joints
    goes_up = lifts(candidates, way) if config.path.lift_height > 0 else np.zeros(len(grasps), dtype=bool)
    arm_joints = np.zeros((len(grasps), len(NAMES), 0)) if arm is None else arm.follow(poses)
    return Waypoints(NAMES, poses, np.stack([opened, opened, closed, closed], axis=1), goes_up, arm_joints)
