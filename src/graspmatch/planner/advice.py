"""Why there is no grasp: the stage at which the last candidates fell, and what would help."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from graspmatch.config import CollisionConfig, PathConfig
from graspmatch.geometry.cloud import narrowest_width
from graspmatch.geometry.thin import thinned
from graspmatch.planner.path import BLOCKED, LOADED, OUT_OF_REACH, OUTSIDE_BOX, OUTSIDE_CONE
from graspmatch.planner.tally import Tally
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper

UNSURE = "unlikely to hold"
INTO_TABLE = "in collision with the table"
INTO_THINGS = "in collision with object or obstacles on the way in"
AT_THE_START = "in collision where their way in begins"
FINGERS_STOPPED = "fingers stopped by the table or an obstacle"
FINGERS_EMPTY = "fingers that close on nothing"

ABOUT_WIDTH = (INTO_TABLE, INTO_THINGS, FINGERS_STOPPED, FINGERS_EMPTY, UNSURE)
"""Stages at which candidates fall where an object is too wide."""
FLAT = 0.02
"""Objects lower than this [m] leave fingers little room above the table."""
NEAR = 0.03
"""Obstacles nearer than this [m] leave fingers little room beside the object."""
POINTS = 1000


def advice(tally: Tally, scene: Scene, gripper: Gripper, path: PathConfig | None = None) -> str:
    """Which stage the last candidates fell at, and what would help; empty where none fell."""
    fallen = [(reason, count) for reason, count in tally.counts.items() if reason != "candidates" and count]
    reason, count = fallen[-1] if fallen else ("", 0)  # reasons are in the order of the stages
    width = narrowest_width(scene.target.points)
    helps = _too_wide(width, gripper) if is_too_wide(width, gripper) and reason in ("", *ABOUT_WIDTH) else ""
    helps = helps or _hint(reason, scene, gripper, path or PathConfig())
    if not fallen:
        return helps
    last = "The last candidate fell" if count == 1 else f"The last {count} candidates fell"
    return f"{last} at this stage: {reason}. {helps}".rstrip()


def is_too_wide(width: float, gripper: Gripper) -> bool:
    """Whether a width leaves no room beside it between the open fingers [m]."""
    return width > gripper.opening - 2 * CollisionConfig().clearance


def _too_wide(width: float, gripper: Gripper) -> str:
    return (
        f"The object is at least {1000 * width:.0f} mm wide in every direction; {gripper.name} opens "
        f"{1000 * gripper.opening:.0f} mm wide and finds no part of it to hold."
    )


def _hint(reason: str, scene: Scene, gripper: Gripper, path: PathConfig) -> str:
    """What would help against a reason."""
    size = " x ".join(f"{1000 * side:.0f}" for side in np.ptp(scene.target.points, axis=0))
    way = f"{1000 * gripper.approach_distance:.0f} mm"
    beside = _obstacles_beside(scene)
    hints = {
        INTO_TABLE: f"{_height(scene)} Is the table's height right (--table)?",
        INTO_THINGS: beside
        or f"The hand does not fit around the object: {gripper.name} opens {1000 * gripper.opening:.0f} mm wide.",
        AT_THE_START: f"Something stands where the way in of {way} begins; a shorter one may be free "
        "(--approach-distance).",
        FINGERS_STOPPED: beside or f"The fingers meet the table before the object. {_height(scene)}",
        FINGERS_EMPTY: f"The fingers do not reach the object, which measures {size} mm: is its unit right (--unit)?",
        OUTSIDE_CONE: f"Only approaches within {math.degrees(path.approach_angle):.0f} degrees of "
        f"{_listed(path.approach_along)} are allowed; widen path.approach_angle.",
        OUTSIDE_BOX: f"The whole hand must be in path.workspace, {way} before the object too, which is at "
        f"{_listed(scene.centre_of_mass)} m.",
        LOADED: "Pick that first (--all says in which order); path.lift_height = 0 does not look at the way out.",
        BLOCKED: "Neither straight up nor back along the approach is free for hand and object: pick what is above it "
        "first, or lift less (path.lift_height).",
        OUT_OF_REACH: f"Is the robot's base where it should be (--robot-base)? The object is at "
        f"{_listed(scene.centre_of_mass)} m. Other approaches: --seeding.pattern sphere.",
        UNSURE: "The object slips out of the fingers; ranking.least_confidence = 0 gives the grasps all the same.",
    }
    return hints.get(reason, "")


def _height(scene: Scene) -> str:
    """How high the object is, where it is flat."""
    if scene.table is None:
        return ""
    height = float((scene.target.points @ scene.table.normal).max() - scene.table.offset)
    return f"The object rises only {1000 * height:.0f} mm above the table." if height < FLAT else ""


def _obstacles_beside(scene: Scene) -> str:
    """How near the next obstacle is, where it is near."""
    from scipy.spatial import KDTree

    if len(scene.obstacles.points) == 0:
        return ""
    away = float(KDTree(scene.obstacles.points).query(thinned(scene.target.points, POINTS))[0].min())
    if away > NEAR:
        return ""
    return f"Another thing is {1000 * away:.0f} mm from the object: pick that first (--all says in which order)."


def _listed(values: tuple[float, ...] | Float[np.ndarray, "n"]) -> str:
    return "(" + ", ".join(f"{round(float(value), 3) + 0.0:g}" for value in values) + ")"
