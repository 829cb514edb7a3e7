"""Keeping what is free: the hand at the grasp, and on its straight way there, clear of target, obstacles and table."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from graspmatch.config import CollisionConfig
from graspmatch.kernels import warp_avoid
from graspmatch.kernels.fields import BlockCloud, in_block_order, upload_blocks
from graspmatch.kernels.launch import download, launch, upload
from graspmatch.kernels.warp_blocks import LANES
from graspmatch.planner.candidates import Candidates, Free, Matched
from graspmatch.planner.tally import Tally
from graspmatch.planner.upload import DISTANCE_STEP, DeviceHand, lowest, pose_arrays, upload_gripper
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper, Plane

RETREAT_STEP = 0.001
"""[m]"""
ROWS = 256
"""Candidates whose corners are looked at together, so that they fit a core's cache."""
COARSE_POINTS = 2000
"""Points that a posture is chosen with, before the whole cloud has its say."""


def keep_free(matched: Matched, space: Space, config: CollisionConfig, tally: Tally) -> Free:
    """Matches opened and backed off along their approach until hand and way in are clear, less those that never are.

    Matching leaves the inner surface on the object, scan noise and all. A wider preshape at the same pose makes room
    between the fingers, a few millimetres back make room for the palm, and a match that went too deep gets shallower.
    """
    wider = np.where(config.may_open, wider_preshapes(space.gripper), -1)
    table = table_retreats(matched, space, config)
    posture, from_table, needed = shortest_retreats(matched, wider, table, space.coarse, space, config)
    is_above = tally.keep(from_table <= config.largest_retreat, "in collision with the table", of=matched)
    matched, posture, needed = matched.select(is_above), posture[is_above], needed[is_above]
    opened = Candidates(posture, matched.T_world_gripper)
    least = np.repeat(needed[:, None], len(wider), axis=1)
    _, _, retreat = shortest_retreats(opened, np.full_like(wider, -1), least, space.points, space, config)
    reachable = retreat <= config.largest_retreat
    is_clear = tally.keep(reachable, "in collision with object or obstacles on the way in", of=opened)
    free = backed_off(matched.select(is_clear), posture[is_clear], retreat[is_clear], space)
    # Backing off also moves the start of the way in, which was not looked at before.
    starts_clear = free.clearance > 0.99 * config.clearance
    return free.select(tally.keep(starts_clear, "in collision where their way in begins", of=free))


def shortest_retreats(
    candidates: Candidates,
    wider: Int[np.ndarray, "p"],
    least: Float[np.ndarray, "n p"],
    points: BlockCloud,
    space: Space,
    config: CollisionConfig,
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Of each candidate's preshape and the `wider` ones (for each preshape the next, or -1) that with the shortest way
    back to clear all points; the least that any of them needs in any case (given as `least`), and that way [m],
    infinite where it is too long."""
    posture, smallest, retreat = (
        wp.empty(len(candidates), dtype=dtype, device=space.device) for dtype in (wp.int32, wp.float32, wp.float32)
    )
    inputs = [*corridor_inputs(space, points), wp.vec3(*space.gripper.approach), config.clearance, RETREAT_STEP]
    inputs += [*pose_arrays(candidates, space.centre_of_mass, space.device)]
    inputs += [upload(wider, wp.int32, space.device), upload(least, wp.float32, space.device), config.largest_retreat]
    outputs = [posture, smallest, retreat]
    launch(warp_avoid.back_off, len(candidates), inputs, outputs, space.device, lanes=LANES)
    return download(posture).astype(int), download(smallest).astype(float), download(retreat).astype(float)


@dataclass(frozen=True)
class Space:
    """What must be kept clear, and the hand's corridors, on the device."""

    gripper: Gripper
    table: Plane | None
    points: BlockCloud
    """Target and obstacles, object frame."""
    coarse: BlockCloud
    """Every so manieth of them."""
    suspected: BlockCloud
    """The same, and the places of which nobody knows whether the target is there."""
    centre_of_mass: Float[np.ndarray, "3"]
    hand: DeviceHand
    device: str


def upload_space(scene: Scene, gripper: Gripper, device: str) -> Space:
    """The whole cloud: with points every 2.5 mm and 2 mm of clearance hardly anything slips between them."""
    clouds = [in_block_order(cloud.points - scene.centre_of_mass) for cloud in (scene.target, scene.obstacles)]
    every = max(sum(len(cloud) for cloud in clouds) // COARSE_POINTS, 1)
    coarse = [cloud[::every] for cloud in clouds]
    doubtful = in_block_order(scene.doubtful - scene.centre_of_mass)
    return Space(
        gripper=gripper,
        table=scene.table,
        points=upload_blocks(clouds, device, scattered=True),
        coarse=upload_blocks(coarse, device, scattered=True),
        suspected=upload_blocks([*coarse, doubtful], device, scattered=True),
        centre_of_mass=scene.centre_of_mass,
        hand=upload_gripper(gripper, device),
        device=device,
    )


@lru_cache(maxsize=4)
def wider_preshapes(gripper: Gripper) -> Int[np.ndarray, "p"]:
    """For each preshape the next wider one that differs in closing only; -1 where there is none. Fingertips may open to
    any, the others to none of the fingertips'."""
    is_fingertips = np.array([preshape.is_fingertips for preshape in gripper.preshapes])
    joints = np.array([preshape.joints for preshape in gripper.preshapes])
    closes = np.isin(np.arange(joints.shape[1]), [j for finger in gripper.fingers for j in finger.joints])
    stroke = np.where(closes, gripper.closed_joints - gripper.open_joints, 1.0)
    closed = (joints - gripper.open_joints) / np.where(stroke == 0, 1.0, stroke)  # 0 open, 1 closed
    wider = np.full(len(joints), -1)
    for i, own in enumerate(closed):
        same_spread = np.all(np.abs(joints - joints[i])[:, ~closes] < 1e-6, axis=-1)
        opener = np.all(closed[:, closes] <= own[closes] + 1e-6, axis=-1) & (np.arange(len(joints)) != i)
        is_wider = opener & (closed[:, closes].sum(axis=-1) < own[closes].sum() - 1e-6)
        options = np.flatnonzero(same_spread & is_wider & (is_fingertips <= is_fingertips[i]))
        if len(options):
            wider[i] = options[np.argmax(closed[options][:, closes].sum(axis=-1))]
    return wider


def backed_off(matched: Matched, posture: Int[np.ndarray, "n"], retreat: Float[np.ndarray, "n"], space: Space) -> Free:
    """The candidates in their opened posture, moved back, and their clearance."""
    T_world_gripper = matched.T_world_gripper.copy()
    T_world_gripper[:, :3, 3] -= retreat[:, None] * (T_world_gripper[:, :3, :3] @ space.gripper.approach)
    opened = Candidates(posture, T_world_gripper)
    clearance = np.minimum(point_clearance(opened, space), table_clearance_of_way(opened, space))
    moved = vars(matched) | {"preshape": posture, "T_world_gripper": T_world_gripper}
    return Free(**moved, matched_preshape=matched.preshape, clearance=clearance, retreat=retreat)


def table_clearance_of_way(candidates: Candidates, space: Space) -> Float[np.ndarray, "n"]:
    """Height of hand and way in above the table [m]: the way is straight, so lowest at one of its ends."""
    clearance = table_clearance(candidates, space)
    if space.table is not None:
        back = candidates.T_world_gripper[:, :3, :3] @ space.gripper.T_gripper_pregrasp[:3, 3]
        clearance += np.minimum(back @ space.table.normal, 0.0)
    return clearance


def point_clearance(candidates: Candidates, space: Space) -> Float[np.ndarray, "n"]:
    """Smallest distance of hand and way in to any point of the scene [m]."""
    clearance = wp.empty(len(candidates), dtype=wp.float32, device=space.device)
    poses = pose_arrays(candidates, space.centre_of_mass, space.device)
    inputs = [*corridor_inputs(space, space.points), *poses]
    launch(warp_avoid.least_distance, len(candidates), inputs, [clearance], space.device, lanes=LANES)
    return download(clearance).astype(float)


def clear_ways(
    candidates: Candidates, errors: Float[np.ndarray, "k 4 4"], clearance: float, space: Space
) -> Int[np.ndarray, "n"]:
    """How many of the displacements (gripper frame) leave more than a clearance [m] between hand and table, and between
    its way in and every so manieth point, and what may be one."""
    up, table = np.zeros(3), -np.inf
    if space.table is not None:
        up, table = space.table.normal, float(space.table.offset - space.table.normal @ space.centre_of_mass)
    inputs = [*corridor_inputs(space, space.suspected), space.hand.hulls, wp.vec3(*up), table, clearance]
    inputs += [upload(errors, wp.mat44, space.device)]
    inputs += pose_arrays(candidates, space.centre_of_mass, space.device)
    count = wp.empty(len(candidates), dtype=wp.int32, device=space.device)
    launch(warp_avoid.clear_ways, len(candidates), inputs, [count], space.device, lanes=LANES)
    return download(count).astype(int)


def corridor_inputs(space: Space, points: BlockCloud) -> list:
    """Hand, way in and points as the kernels take them."""
    return [
        space.hand.corridor,
        points.points,
        points.balls,
        space.hand.corridor_levels,
        DISTANCE_STEP,
        points.blocks,
    ]


def table_retreats(candidates: Candidates, space: Space, config: CollisionConfig) -> Float[np.ndarray, "n p"]:
    """How far candidates, in each preshape of the hand, must back off to clear the table [m]; infinite where backing
    off leads into it."""
    if space.table is None:
        return np.zeros((len(candidates), len(space.gripper.preshapes)))
    missing = config.clearance - _heights(candidates.T_world_gripper, space.hand.corners, space.table)
    approach_world = candidates.T_world_gripper[:, :3, :3] @ space.gripper.approach
    rise = (-approach_world @ space.table.normal)[:, None]  # height gained per way back
    retreat = np.where(missing > 0, missing / np.where(rise > 1e-3, rise, np.nan), 0.0)
    # An approach from below begins lower still, and lower by what clearing the points will take.
    farthest = space.gripper.approach_distance + config.largest_retreat
    start_is_clear = (rise >= 0) | (missing <= farthest * rise)
    return np.where(np.isnan(retreat) | ~start_is_clear, np.inf, retreat)


def table_clearance(candidates: Candidates, space: Space) -> Float[np.ndarray, "n"]:
    """Height of the hand's lowest corner above the table [m]; exact, since a plane meets a hull first at a corner."""
    if space.table is None:
        return np.full(len(candidates), np.inf)
    up_gripper = np.einsum("j,njk->nk", space.table.normal, candidates.T_world_gripper[:, :3, :3])
    least = lowest(space.hand.corners, candidates.preshape, up_gripper)
    return least + candidates.T_world_gripper[:, :3, 3] @ space.table.normal - space.table.offset


def _heights(
    T_world_gripper: Float[np.ndarray, "n 4 4"], corners: Float[np.ndarray, "p v 3"], table: Plane
) -> Float[np.ndarray, "n p"]:
    """Of the lowest corner above the table [m]."""
    up_gripper = np.einsum("j,njk->nk", table.normal, T_world_gripper[:, :3, :3])
    least = np.empty((len(T_world_gripper), len(corners)))
    for some in (slice(n, n + ROWS) for n in range(0, len(least), ROWS)):
        along = up_gripper[some] @ corners.reshape(-1, 3).T
        least[some] = along.reshape(-1, *corners.shape[:2]).min(axis=-1)
    return least + (T_world_gripper[:, :3, 3] @ table.normal - table.offset)[:, None]
