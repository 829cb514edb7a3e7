"""Keeping what is free: the hand at the grasp, and on its straight way there, clear of target, obstacles and table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from jaxtyping import Float

from graspmatch.config import CollisionConfig
from graspmatch.kernels.fields import stack_fields
from graspmatch.kernels.launch import launch
from graspmatch.kernels.warp_avoid import back_off, least_distance
from graspmatch.planner.candidates import Candidates, Free, Matched
from graspmatch.planner.surroundings import solid_points
from graspmatch.planner.tally import Tally
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper, Plane

RETREAT_STEP = 0.001
"""[m]"""


def keep_free(
    matched: Matched, scene: Scene, gripper: Gripper, config: CollisionConfig, device: str, tally: Tally
) -> Free:
    """Matches backed off along their approach until hand and way in are clear, less those that never are.

    Matching leaves the inner surface on the object, scan noise and all: a few millimetres back make room for the
    clearance, and a match that went in too deep becomes a shallower one.
    """
    corridor = stack_fields([preshape.corridor for preshape in gripper.preshapes], device)
    points = wp.array(solid_points(scene) - scene.centre_of_mass, dtype=wp.vec3, device=device)
    approach_world = matched.T_world_gripper[:, :3, :3] @ gripper.approach

    retreat = np.zeros(len(matched))
    if scene.table is not None:
        retreat = table_retreat(matched, approach_world, scene.table, gripper, config)
        keep = tally.keep(retreat <= config.largest_retreat, "in collision with the table")
        matched, retreat, approach_world = matched.select(keep), retreat[keep], approach_world[keep]

    retreat = np.maximum(retreat, point_retreat(matched, corridor, points, scene, gripper, config, device))
    keep = tally.keep(retreat <= config.largest_retreat, "in collision with the object on the way in")
    matched, retreat, approach_world = matched.select(keep), retreat[keep], approach_world[keep]

    T_world_gripper = matched.T_world_gripper.copy()
    T_world_gripper[:, :3, 3] -= retreat[:, None] * approach_world
    backed = replace(matched, T_world_gripper=T_world_gripper)
    clearance = point_clearance(backed, corridor, points, scene, device)
    if scene.table is not None:
        clearance = np.minimum(clearance, table_clearance(backed, scene.table, gripper))
    return Free(**vars(backed), clearance=clearance, retreat=retreat)


def point_retreat(
    candidates: Candidates, corridor, points: wp.array, scene: Scene, gripper: Gripper, config: CollisionConfig, device
) -> Float[np.ndarray, "n"]:
    """How far each candidate must back off to clear all points [m]; more than `largest_retreat` if it cannot."""
    retreat = wp.empty(len(candidates), dtype=wp.float32, device=device)
    limits = [wp.vec3(*gripper.approach), config.clearance, RETREAT_STEP, config.largest_retreat]
    launch(
        back_off,
        len(candidates),
        [corridor, *limits, points, *pose_arrays(candidates, scene, device)],
        [retreat],
        device,
    )
    return retreat.numpy().astype(float)


def point_clearance(candidates: Candidates, corridor, points: wp.array, scene: Scene, device) -> Float[np.ndarray, "n"]:
    """Smallest distance of hand and way in to any point [m]."""
    clearance = wp.empty(len(candidates), dtype=wp.float32, device=device)
    inputs = [corridor, points, *pose_arrays(candidates, scene, device)]
    launch(least_distance, len(candidates), inputs, [clearance], device)
    return clearance.numpy().astype(float)


def pose_arrays(candidates: Candidates, scene: Scene, device: str) -> list[wp.array]:
    """Preshape, position and rotation of each candidate as the kernels take them, object frame."""
    return [
        wp.array(candidates.preshape, dtype=wp.int32, device=device),
        wp.array(candidates.T_world_gripper[:, :3, 3] - scene.centre_of_mass, dtype=wp.vec3, device=device),
        wp.array(candidates.quaternions_xyzw(), dtype=wp.quat, device=device),
    ]


def table_retreat(
    candidates: Candidates,
    approach_world: Float[np.ndarray, "n 3"],
    table: Plane,
    gripper: Gripper,
    config: CollisionConfig,
) -> Float[np.ndarray, "n"]:
    """How far each candidate must back off to clear the table [m]; infinite where that leads into it."""
    missing = config.clearance - table_clearance(candidates, table, gripper)
    rise = -approach_world @ table.normal  # height gained per way back
    retreat = np.where(missing > 0, missing / np.where(rise > 1e-3, rise, np.nan), 0.0)
    start_is_clear = missing - gripper.approach_distance * rise <= 0
    return np.where(np.isnan(retreat) | ~start_is_clear, np.inf, retreat)


def table_clearance(candidates: Candidates, table: Plane, gripper: Gripper) -> Float[np.ndarray, "n"]:
    """Height of the hand's lowest corner above the table [m]; exact, since a plane meets the hull first at a corner."""
    heights = np.empty(len(candidates))
    for index, preshape in enumerate(gripper.preshapes):
        chosen = candidates.preshape == index
        T = candidates.T_world_gripper[chosen]
        lowest = (table.normal @ T[:, :3, :3] @ preshape.outline.T).min(axis=-1, initial=np.inf)
        heights[chosen] = lowest + T[:, :3, 3] @ table.normal - table.offset
    return heights
