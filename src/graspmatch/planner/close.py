"""Closing the fingers from each pregrasp until they meet something: first contacts and joint values."""

from __future__ import annotations

import itertools

import numpy as np
import warp as wp
from jaxtyping import Bool, Float, Int

from graspmatch.config import ClosingConfig
from graspmatch.kernels.launch import download, launch
from graspmatch.kernels.warp_avoid import first_contact
from graspmatch.kernels.warp_blocks import LANES
from graspmatch.kernels.warp_fields import NEVER
from graspmatch.planner.avoid import Space
from graspmatch.planner.candidates import Closed, Free
from graspmatch.planner.tally import Tally
from graspmatch.planner.upload import ARRIVAL_STEP, DISTANCE_STEP, DeviceHand, lowest, pose_arrays
from graspmatch.types import Gripper, Plane


def close_fingers(free: Free, space: Space, config: ClosingConfig, tally: Tally) -> Closed:
    """Candidates whose fingers meet the target before anything else, with the joint values at first contact."""
    keep, fraction = meet_object(free, space, config, tally)
    free, fraction = free.select(keep), fraction[keep]
    return Closed(
        **vars(free), closing_fraction=fraction, grasp_joints=contact_joints(free.preshape, fraction, space.gripper)
    )


def meet_object(
    free: Free, space: Space, config: ClosingConfig, tally: Tally
) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "n f"]]:
    """Whether the fingers meet the target before anything else, and the closing fraction at which each does."""
    fraction, blocked = contact_fractions(free, space)
    if space.table is not None:
        blocked = np.minimum(blocked, table_fractions(free, space.table, space.gripper, space.hand))
    reaches = tally.keep(
        ~np.any(blocked <= stop_fractions(fraction, space.gripper), axis=-1),
        "fingers stopped by the table or an obstacle",
        of=free,
    )
    touching = np.sum(fraction <= 1, axis=-1)
    fewest = min(config.fewest_fingers, len(space.gripper.fingers))  # a single jaw closes on a fixed one, the palm
    keep = reaches & tally.keep(touching >= fewest, "fingers that close on nothing", among=reaches, of=free)
    return keep, fraction


def contact_fractions(free: Free, space: Space) -> tuple[Float[np.ndarray, "n f"], Float[np.ndarray, "n f"]]:
    """Closing fractions at which each finger first meets the target, and an obstacle; 2 where it never does."""
    fingers, hand = len(space.gripper.fingers), space.hand
    field = [fingers, hand.arrival, space.points.points, space.points.balls, hand.arrival_levels, ARRIVAL_STEP]
    field += [hand.swept_levels, DISTANCE_STEP]
    poses = pose_arrays(free, space.centre_of_mass, space.device)
    found = []
    for blocks in itertools.pairwise((0, *space.points.ends)):
        fraction = wp.full(len(free) * fingers, NEVER, dtype=wp.float32, device=space.device)
        if blocks[1] > blocks[0]:
            inputs = [*field, *blocks, *poses]
            launch(first_contact, len(free), inputs, [fraction], space.device, lanes=LANES)
        found.append(download(fraction).reshape(-1, fingers).astype(float))
    return found[0], found[1]


def table_fractions(free: Free, table: Plane, gripper: Gripper, hand: DeviceHand) -> Float[np.ndarray, "n f"]:
    """Closing fraction at which each finger first meets the table; 2 where it never does."""
    fractions = np.full((len(free), len(gripper.fingers)), NEVER)
    direction = np.einsum("j,njk->nk", table.normal, free.T_world_gripper[:, :3, :3])  # the normal in the gripper frame
    height = free.T_world_gripper[:, :3, 3] @ table.normal - table.offset
    reaches = lowest(hand.swept_corners, free.preshape, direction) + height[:, None] < 0
    for f in np.flatnonzero(reaches.any(axis=0)):
        for index in np.unique(free.preshape[reaches[:, f]]):
            chosen = np.flatnonzero((free.preshape == index) & reaches[:, f])
            outline = gripper.preshapes[index].finger_outlines[f]
            heights = (direction[chosen] @ outline.reshape(-1, 3).T).reshape(len(chosen), *outline.shape[:2])
            fractions[chosen, f] = first_crossing(heights.min(axis=-1, initial=np.inf) + height[chosen, None])
    return fractions


def first_crossing(heights: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n"]:
    """Where, from 0 to 1 over the k steps, each row first goes below zero, between steps by a straight line."""
    hit = heights < 0
    k = np.argmax(hit, axis=-1)
    rows = np.arange(len(heights))
    before, after = heights[rows, np.maximum(k - 1, 0)], heights[rows, k]
    crossing = k - np.where(k > 0, after / np.where(before == after, -1.0, after - before), 0.0)
    return np.where(hit.any(axis=-1), crossing / (heights.shape[1] - 1), NEVER)


def stop_fractions(fraction: Float[np.ndarray, "n f"], gripper: Gripper) -> Float[np.ndarray, "n f"]:
    """How far each finger closes. Fingers that share a drive stop together: the object slides until all that meet it
    touch, at the mean of their fractions. A drive whose fingers meet nothing closes fully."""
    stop = np.empty_like(fraction)
    for f, finger in enumerate(gripper.fingers):
        together = [g for g, other in enumerate(gripper.fingers) if set(other.joints) & set(finger.joints)]
        touching = fraction[:, together] <= 1
        total = np.where(touching, fraction[:, together], 0.0).sum(axis=-1)
        count = touching.sum(axis=-1)
        stop[:, f] = np.where(count > 0, total / np.maximum(count, 1), 1.0)
    return stop


def contact_joints(
    preshape: Int[np.ndarray, "n"], fraction: Float[np.ndarray, "n f"], gripper: Gripper
) -> Float[np.ndarray, "n d"]:
    """Driven joint values where the fingers stop; a joint that several fingers move takes the mean of theirs."""
    joints, closed = (
        np.array([getattr(p, name) for p in gripper.preshapes])[preshape] for name in ("joints", "closed")
    )
    stop = stop_fractions(fraction, gripper)
    for j in range(len(gripper.joint_names)):
        moved = [f for f, finger in enumerate(gripper.fingers) if j in finger.joints]
        if moved:
            joints[:, j] += stop[:, moved].mean(axis=-1) * (closed[:, j] - joints[:, j])
    return joints
