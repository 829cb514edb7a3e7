"""Grasp planning by parallel shape matching: a point cloud and a gripper in, ranked collision-free grasps out."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from graspmatch.errors import GraspmatchError as GraspmatchError

if TYPE_CHECKING:
    from graspmatch.config import PlannerConfig as PlannerConfig
    from graspmatch.formats.registry import read_grasps as read_grasps
    from graspmatch.formats.registry import write_grasps as write_grasps
    from graspmatch.gripper.load import load_gripper as load_gripper
    from graspmatch.gripper.zoo import known_grippers as known_grippers
    from graspmatch.planner.arm import Arm as Arm
    from graspmatch.planner.many import plan_many as plan_many
    from graspmatch.planner.order import plan_all as plan_all
    from graspmatch.planner.plan import plan as plan
    from graspmatch.planner.waypoints import waypoints as waypoints
    from graspmatch.scene.camera import Camera as Camera
    from graspmatch.scene.every import scenes_of_depth as scenes_of_depth
    from graspmatch.scene.every import scenes_of_view as scenes_of_view
    from graspmatch.scene.scene import Scene as Scene
    from graspmatch.types import GraspSet as GraspSet
    from graspmatch.types import Gripper as Gripper
    from graspmatch.types import Plane as Plane
    from graspmatch.types import PointCloud as PointCloud

# Where the public names live: each arrives with its first use, so that the import itself loads NumPy only.
_HOMES = {
    "Arm": "graspmatch.planner.arm",
    "Camera": "graspmatch.scene.camera",
    "GraspSet": "graspmatch.types",
    "Gripper": "graspmatch.types",
    "Plane": "graspmatch.types",
    "PlannerConfig": "graspmatch.config",
    "PointCloud": "graspmatch.types",
    "Scene": "graspmatch.scene.scene",
    "known_grippers": "graspmatch.gripper.zoo",
    "load_gripper": "graspmatch.gripper.load",
    "plan": "graspmatch.planner.plan",
    "plan_all": "graspmatch.planner.order",
    "plan_many": "graspmatch.planner.many",
    "read_grasps": "graspmatch.formats.registry",
    "scenes_of_depth": "graspmatch.scene.every",
    "scenes_of_view": "graspmatch.scene.every",
    "waypoints": "graspmatch.planner.waypoints",
    "write_grasps": "graspmatch.formats.registry",
}


def __getattr__(name: str) -> object:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("graspmatch")
    if name not in _HOMES:
        raise AttributeError(f"module 'graspmatch' has no attribute '{name}'. Public: {', '.join(sorted(_HOMES))}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
