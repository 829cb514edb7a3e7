"""The arm of a command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from graspmatch.apps.numbers import read_pose_text
from graspmatch.apps.options import Robot
from graspmatch.errors import GraspmatchError
from graspmatch.types import Gripper

if TYPE_CHECKING:
    from graspmatch.planner.arm import Arm


def arm_of(options: Robot, gripper: Gripper) -> Arm | None:
    """The arm that the options name; None where they name none."""
    if options.robot is None:
        if options != Robot():
            raise GraspmatchError("--robot-tip, --robot-base and --robot-mount need the robot itself: --robot FILE.")
        return None
    from graspmatch.planner.arm import Arm

    poses = (options.robot_base, options.robot_mount)
    base, mount = (None if text is None else read_pose_text(text) for text in poses)
    return Arm.read(options.robot, gripper, tip=options.robot_tip, T_world_base=base, T_tip_gripper=mount)
