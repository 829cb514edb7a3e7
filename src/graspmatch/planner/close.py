"""Closing the fingers from each pregrasp until they meet something: first contacts and joint values."""

from __future__ import annotations

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from graspmatch.config import ClosingConfig
from graspmatch.kernels.launch import launch
from graspmatch.kernels.warp_avoid import first_contact
from graspmatch.planner.avoid import pose_arrays
from graspmatch.planner.candidates import Closed, Free
from graspmatch.planner.tally import Tally
from graspmatch.planner.upload import upload_gripper
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper, Plane, PointCloud

NEVER = 2.0


def close_fingers(
    free: Free, scene: Scene, gripper: Gripper, config: ClosingConfig, device: str, tally: Tally
) -> Closed:
    """Candidates whose fingers meet the target before anything else, with the joint values at first contact."""
    fraction = contact_fractions(free, scene.target, scene, gripper, device)
    blocked = contact_fractions(free, scene.obstacles, scene, gripper, device)
    if scene.table is not None:
        blocked = np.minimum(blocked, table_fractions(free, scene.table, gripper))
    touches = (fraction <= 1) & (fraction < blocked)
    is_blocked = np.any((blocked <= 1) & (blocked <= fraction), axis=-1)
    reaches = tally.keep(~is_blocked, "fingers stopped by the table or an obstacle")
    keep = reaches & tally.keep(
        touches.sum(axis=-1) >= config.fewest_fingers, "fingers that close on nothing", among=reaches
    )
    free, fraction = free.select(keep), fraction[keep]
    return Closed(
        **vars(free), closing_fraction=fraction, grasp_joints=contact_joints(free.preshape, fraction, gripper)
    )


def contact_fractions(
    free: Free, cloud: PointCloud, scene: Scene, gripper: Gripper, device: str
) -> Float[np.ndarray, "n f"]:
    """Closing fraction at which each finger first meets a cloud; 2 where it never does."""
    fingers = len(gripper.fingers)
    points = wp.array(cloud.points - scene.centre_of_mass, dtype=wp.vec3, device=device)
    fraction = wp.empty((len(free), fingers), dtype=wp.float32, device=device)
    poses = pose_arrays(free, scene.centre_of_mass, device)
    launch(
        first_contact, len(free), [fingers, upload_gripper(gripper, device).arrival, points, *poses], [fraction], device
    )
    return fraction.numpy().astype(float)


def table_fractions(free: Free, table: Plane, gripper: Gripper) -> Float[np.ndarray, "n f"]:
    """Closing fraction at which each finger first meets the table; 2 where it never does."""
    fractions = np.full((len(free), len(gripper.fingers)), NEVER)
    for index, preshape in enumerate(gripper.preshapes):
        chosen = np.flatnonzero(free.preshape == index)
        T = free.T_world_gripper[chosen]
        height = T[:, :3, 3] @ table.normal - table.offset
        for f, outline in enumerate(preshape.finger_outlines):
            direction = table.normal @ T[:, :3, :3]  # the normal in the gripper frame
            lowest = np.einsum("nj,kvj->nkv", direction, outline).min(axis=-1, initial=np.inf) + height[:, None]
            hit = lowest < 0
            first = np.argmax(hit, axis=-1) / (len(outline) - 1)
            fractions[chosen, f] = np.where(hit.any(axis=-1), first, NEVER)
    return fractions


def contact_joints(
    preshape: Int[np.ndarray, "n"], fraction: Float[np.ndarray, "n f"], gripper: Gripper
) -> Float[np.ndarray, "n d"]:
    """Driven joint values at first contact.

    Fingers that share a drive stop together: the object slides until both touch, at the mean of their fractions.
    A finger that meets nothing closes fully.
    """
    pregrasp = np.array([posture.joints for posture in gripper.preshapes])[preshape]
    joints = pregrasp.copy()
    for j in range(len(gripper.joint_names)):
        moved = [f for f, finger in enumerate(gripper.fingers) if j in finger.joints]
        if moved:
            closed = np.minimum(fraction[:, moved], 1.0).mean(axis=-1)
            joints[:, j] += closed * (gripper.closed_joints[j] - pregrasp[:, j])
    return joints
