"""What closed fingers hold: the wrench that they resist, and how sure the grasp is."""

from __future__ import annotations

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from graspmatch.config import GripConfig
from graspmatch.geometry import se3
from graspmatch.kernels import warp_grip
from graspmatch.kernels.launch import launch
from graspmatch.planner.candidates import Candidates, Closed, Graded
from graspmatch.planner.close import contact_joints
from graspmatch.planner.contacts import Touchable, contacts_of, find_contacts
from graspmatch.planner.slide import slide
from graspmatch.types import Gripper

Array = np.ndarray

GRAVITY = 9.81
"""[m/s2]"""
DESCENTS = 20
"""Steps of the search for the weakest direction."""


def margins(
    candidates: Candidates, target: Touchable, gripper: Gripper, config: GripConfig, device: str
) -> Float[Array, "n"]:
    """Smallest wrench that a grasp cannot resist besides the object's weight; below zero, what is missing to hold it.

    In units of one finger's force and, for torques, of that times the object's size.
    """
    fingers = len(gripper.fingers)
    _, count, point, push = find_contacts(candidates, target, gripper, config, device)
    R_gripper_world = np.swapaxes(candidates.T_world_gripper[:, :3, :3], -1, -2)
    offset = target.centre_of_mass - candidates.T_world_gripper[:, :3, 3]
    weight = config.mass * GRAVITY / gripper.finger_force * target.down
    grip = warp_grip.Grip()
    grip.count, grip.point, grip.push = count, point, push
    grip.centre = wp.array(np.einsum("nij,nj->ni", R_gripper_world, offset), dtype=wp.vec3, device=device)
    grip.length, grip.friction = target.length, config.friction
    grip.torsion, grip.most = config.torsional_friction / target.length, most_force(gripper)
    directions = wp.array(DIRECTIONS, dtype=wp.spatial_vector, device=device)
    load = wp.array(R_gripper_world @ weight, dtype=wp.vec3, device=device)
    margin = wp.empty(len(candidates), dtype=wp.float32, device=device)
    launch(warp_grip.wrench_margin, len(candidates), [fingers, grip, directions, DESCENTS, load], [margin], device)
    return margin.numpy().astype(float)


def robust_margins(
    candidates: Candidates,
    target: Touchable,
    gripper: Gripper,
    config: GripConfig,
    rng: np.random.Generator,
    device: str,
) -> Float[Array, "n"]:
    """Mean margin over small displacements of the hand, the same for all candidates."""
    total = np.zeros(len(candidates))
    for _ in range(config.errors):
        turn = se3.rotation_exp(config.angle_error * rng.normal(size=3))
        error = se3.from_parts(turn, config.position_error * rng.normal(size=3))
        about_tcp = se3.translation(gripper.tool_centre_point) @ error @ se3.translation(-gripper.tool_centre_point)
        moved = Candidates(candidates.preshape, candidates.T_world_gripper @ about_tcp)
        total += margins(moved, target, gripper, config, device)
    return total / max(config.errors, 1)


def grade(
    closed: Closed,
    error: Float[Array, "n"],
    loss: Float[Array, "n"],
    target: Touchable,
    coarse: Touchable,
    gripper: Gripper,
    config: GripConfig,
    rng: np.random.Generator,
    device: str,
) -> Graded:
    """What each candidate holds once the fingers have pushed the object to where they balance.

    `coarse` is the same object with fewer points, for the pushing.
    """
    pushed = slide(closed, coarse, gripper, config, device)
    at_rest = Candidates(closed.preshape, closed.T_world_gripper @ se3.translation(-pushed))
    contacts = contacts_of(at_rest, target, gripper, config, device)
    robust = robust_margins(at_rest, target, gripper, config, rng, device)
    touching = np.sum(contacts.fraction <= 1, axis=-1) > 0
    fraction = np.where(touching[:, None], contacts.fraction, closed.closing_fraction)
    grasp_joints = contact_joints(closed.preshape, fraction, gripper)
    return Graded(
        **vars(closed) | {"closing_fraction": fraction, "grasp_joints": grasp_joints},
        error=error,
        final_loss=loss,
        pushed=np.linalg.norm(pushed, axis=-1),
        robust_margin=robust,
        confidence=confidence(robust, loss, contacts.count.sum(axis=-1)),
    )


def confidence(
    robust_margin: Float[Array, "n"], loss: Float[Array, "n"], contacts: Int[Array, "n"]
) -> Float[Array, "n"]:
    """Share of grasps with these figures that hold: a logistic model, fitted by `bench/calibration.py`."""
    root_loss = np.sqrt(np.maximum(loss, 0.0)) / LOSS_SCALE
    offset, by_margin, by_loss, by_contact = CALIBRATION
    return 1 / (1 + np.exp(-(offset + by_margin * robust_margin + by_loss * root_loss + by_contact * contacts)))


LOSS_SCALE = 0.05
"""[m]"""
CALIBRATION = (0.58, 1.79, -0.79, 0.155)
"""Offset, and weights of the robust margin, of the root of the loss and of the number of contacts."""


def most_force(gripper: Gripper) -> float:
    """How much harder than rated a finger can press: with a drive of its own, as hard as all others against it."""
    drives = {finger.joints for finger in gripper.fingers}
    return float(max(len(gripper.fingers) - 1, 1)) if len(drives) == len(gripper.fingers) else 1.0


def _directions(random: int) -> Float[Array, "k 6"]:
    """Unit vectors in the space of wrenches: both ways along each axis, and some at random."""
    drawn = np.random.default_rng(0).normal(size=(random, 6))
    vectors = np.concatenate([np.eye(6), -np.eye(6), drawn])
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


DIRECTIONS = _directions(52)
