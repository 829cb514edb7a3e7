"""The way of the hand: to the grasp, and out again with the object. What cannot go it is no grasp.

The straight way in is looked at in `avoid`. Here is the rest: the directions and the box that it must keep to, the way
out, and whether the robot can follow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import warp as wp
from jaxtyping import Bool, Float

from graspmatch.config import PathConfig, PlannerConfig
from graspmatch.geometry import se3
from graspmatch.geometry.thin import thinned
from graspmatch.kernels.launch import download, launch, upload
from graspmatch.kernels.warp_blocks import LANES
from graspmatch.kernels.warp_path import way_clearance
from graspmatch.planner.avoid import Space
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.tally import Tally
from graspmatch.planner.upload import pose_arrays
from graspmatch.scene.scene import Scene
from graspmatch.scene.stacked import covered_share
from graspmatch.types import GraspmatchError

Array = np.ndarray
C = TypeVar("C", bound=Candidates)

Reach = Callable[[Float[Array, "n k 4 4"]], Bool[Array, "n"]]
"""Whether the robot can take the gripper frame through the k poses (world) of each of n ways, straight from one to the
next: where the approach begins, the grasp, and the end of the way out."""

CLEAR_ENOUGH = 0.9
"""Share of the clearance that counts as it: the fields of the hand and of its way in differ by a tenth of a millimetre.
"""
COVERED = 0.02
"""An object cannot go where at least this share of it has something before it."""
SWEPT_POINTS = 1000
"""Of the object and of the obstacles, about so many are looked at for the way out of the object."""
LOADED = "something stands on the object"
BLOCKED = "no free way out with the object"
OUTSIDE_CONE = "approach from a direction that is not allowed"
OUTSIDE_BOX = "hand outside of the workspace"
OUT_OF_REACH = "out of the robot's reach"


@dataclass(frozen=True)
class Way:
    """All that is needed to say whether a hand can go its way."""

    space: Space
    config: PathConfig
    clearance: float
    """That the hand keeps [m]."""
    target: Float[Array, "n 3"]
    """Of the object, a few points [m], world frame ..."""
    obstacles: Float[Array, "m 3"]
    """... and of all else."""
    is_loaded: bool
    """Whether something stands on the object."""
    is_covered: bool
    """Whether something is in the object's way up."""
    reach: Reach | None = None


def way_of(scene: Scene, space: Space, config: PlannerConfig, reach: Reach | None = None) -> Way:
    """What is asked of a way, made once for a plan. Raises `GraspmatchError` for a box or direction that is none."""
    _check(config.path)
    target, obstacles = (thinned(cloud.points, SWEPT_POINTS) for cloud in (scene.target, scene.obstacles))
    is_loaded, is_covered = False, True
    if scene.table is not None and config.path.lift_height > 0:
        is_loaded = scene.is_loaded
        is_covered = meets(target, obstacles, config.path.lift_height * scene.table.normal)
    return Way(space, config.path, config.collision.clearance, target, obstacles, is_loaded, is_covered, reach)


def keep_executable(candidates: C, way: Way, tally: Tally) -> C:
    """The candidates whose hand can go all of its way."""
    for reason, can_go in CHECKS.items():
        candidates = candidates.select(tally.keep(can_go(candidates, way), reason, of=candidates))
    return candidates


def is_executable(candidates: Candidates, way: Way) -> Bool[Array, "n"]:
    """Which of the candidates those are."""
    left = np.ones(len(candidates), dtype=bool)
    for can_go in CHECKS.values():
        left[left] = can_go(candidates.select(left), way)
    return left


def keeps_direction(candidates: Candidates, way: Way) -> Bool[Array, "n"]:
    """Whether each approach is in the cone."""
    if way.config.approach_angle >= np.pi:
        return np.ones(len(candidates), dtype=bool)
    return _off_middle(candidates, way)[1] <= way.config.approach_angle + 1e-9


def stays_in_box(candidates: Candidates, way: Way) -> Bool[Array, "n"]:
    """Whether the open hand is in the workspace at both ends of its straight way in; then it is all the way."""
    if way.config.workspace is None:
        return np.ones(len(candidates), dtype=bool)
    least, largest = np.array(way.config.workspace[:3]), np.array(way.config.workspace[3:])
    corners = way.space.hand.corners[candidates.preshape]
    start = candidates.T_world_gripper @ way.space.gripper.T_gripper_pregrasp
    at = np.concatenate([se3.apply(T, corners) for T in (candidates.T_world_gripper, start)], axis=1)
    return np.all((at >= least) & (at <= largest), axis=(1, 2))


def is_unloaded(candidates: Candidates, way: Way) -> Bool[Array, "n"]:
    """Whether nothing would fall off the object."""
    return np.full(len(candidates), not way.is_loaded)


def gets_out(candidates: Candidates, way: Way) -> Bool[Array, "n"]:
    """Whether the hand can leave with the object: straight up, or else back along its approach."""
    if way.config.lift_height == 0 or len(way.obstacles) == 0:
        return np.ones(len(candidates), dtype=bool)
    out = lifts(candidates, way)
    for i in np.flatnonzero(~out):
        back = -way.space.gripper.approach_distance * candidates.T_world_gripper[i, :3, :3] @ way.space.gripper.approach
        out[i] = not _goes_into_table(back, way) and not meets(way.target, way.obstacles, back)
    return out


def lifts(candidates: Candidates, way: Way) -> Bool[Array, "n"]:
    """Whether hand and object can go straight up. The hand counts as open as it came: closed it is no wider."""
    if way.is_covered:
        return np.zeros(len(candidates), dtype=bool)
    return lift_clearance(candidates, way) >= CLEAR_ENOUGH * way.clearance


def lift_clearance(candidates: Candidates, way: Way) -> Float[Array, "n"]:
    """Smallest distance of the open hand to an obstacle as it goes up [m], at most the clearance that is asked for."""
    space = way.space
    first, end = space.points.ends[0], space.points.ends[1]
    if space.table is None or first == end:
        return np.full(len(candidates), way.clearance)
    up = np.tile(way.config.lift_height * space.table.normal, (len(candidates), 1))
    poses = pose_arrays(candidates, space.centre_of_mass, space.device, space.hand.pivots)
    inputs = [space.hand.matching.distance, space.points.points, first, end, way.clearance]
    inputs += [upload(up, wp.vec3, space.device), *poses]
    clearance = wp.empty(len(candidates), dtype=wp.float32, device=space.device)
    launch(way_clearance, len(candidates), inputs, [clearance], space.device, lanes=LANES)
    return download(clearance).astype(float)


def meets(target: Float[Array, "n 3"], obstacles: Float[Array, "m 3"], way: Float[Array, "3"]) -> bool:
    """Whether the object meets obstacles when it moves by `way` [m]."""
    return covered_share(target, obstacles, way) >= COVERED


def is_reached(candidates: Candidates, way: Way) -> Bool[Array, "n"]:
    """Whether the robot can follow."""
    if way.reach is None or len(candidates) == 0:
        return np.ones(len(candidates), dtype=bool)
    reached = np.asarray(way.reach(poses_of_way(candidates, way)))
    if reached.shape != (len(candidates),) or reached.dtype != bool:
        raise GraspmatchError(
            f"reach must return one bool for each of {len(candidates)} ways, not {reached.dtype} of shape "
            f"{reached.shape}."
        )
    return reached


CHECKS: dict[str, Callable[[Candidates, Way], Bool[Array, "n"]]] = {
    OUTSIDE_CONE: keeps_direction,
    OUTSIDE_BOX: stays_in_box,
    LOADED: is_unloaded,
    BLOCKED: gets_out,
    OUT_OF_REACH: is_reached,
}
"""What is looked at, in this order, and what is said of those that fail."""


def poses_of_way(candidates: Candidates, way: Way) -> Float[Array, "n 3 4 4"]:
    """T_world_gripper where the approach begins, at the grasp, and at the end of the way out."""
    start = candidates.T_world_gripper @ way.space.gripper.T_gripper_pregrasp
    out = start.copy()
    if way.space.table is not None and way.config.lift_height > 0:
        up = se3.translation(way.config.lift_height * way.space.table.normal)
        goes_up = lifts(candidates, way)
        out[goes_up] = up @ candidates.T_world_gripper[goes_up]
    return np.stack([start, candidates.T_world_gripper, out], axis=1)


def aimed(starts: Candidates, way: Way, centre: Float[Array, "3"]) -> Candidates:
    """Starts of other directions turned about the object's centre to the edge of the cone, by the shortest way."""
    if way.config.approach_angle >= np.pi:
        return starts
    axis, angle = _off_middle(starts, way)
    excess = np.maximum(angle - way.config.approach_angle, 0.0)
    turn = se3.from_parts(se3.rotation_exp(axis * excess[:, None]), np.zeros(3))
    return Candidates(starts.preshape, se3.about(centre, turn) @ starts.T_world_gripper)


def _off_middle(candidates: Candidates, way: Way) -> tuple[Float[Array, "n 3"], Float[Array, "n"]]:
    """Axis and angle [rad] of the shortest turn of each approach to the middle of the cone."""
    middle = np.array(way.config.approach_along) / np.linalg.norm(way.config.approach_along)
    approach = candidates.T_world_gripper[:, :3, :3] @ way.space.gripper.approach
    axis = np.cross(approach, middle)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    across = np.cross(middle, np.eye(3)[np.argmin(np.abs(middle))])  # any will do for what looks straight away from it
    axis = np.where(sine > 1e-6, axis, across)
    return axis / np.linalg.norm(axis, axis=-1, keepdims=True), np.arccos(np.clip(approach @ middle, -1, 1))


def _goes_into_table(back: Float[Array, "3"], way: Way) -> bool:
    return way.space.table is not None and float(back @ way.space.table.normal) < 0


def _check(config: PathConfig) -> None:
    """Refuse a box without room and a direction without length."""
    if config.workspace is not None and not np.all(np.array(config.workspace[:3]) < np.array(config.workspace[3:])):
        raise GraspmatchError(
            f"path.workspace is {config.workspace}; it must be the least x, y, z and then the largest, in metres."
        )
    length = np.linalg.norm(config.approach_along)
    if not (np.isfinite(length) and length > 0):
        raise GraspmatchError(f"path.approach_along is {config.approach_along}; it must be a direction.")
