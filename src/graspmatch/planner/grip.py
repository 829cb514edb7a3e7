"""What happens when the fingers have closed: contacts, the wrench that they resist, and how sure the grasp is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from graspmatch.config import GripConfig
from graspmatch.geometry import se3
from graspmatch.geometry.cloud import normal_sector, voxel_downsample
from graspmatch.kernels import warp_grip
from graspmatch.kernels.launch import launch
from graspmatch.planner.candidates import Candidates, Closed, Graded
from graspmatch.planner.upload import pose_arrays, upload_gripper
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper

Array = np.ndarray

GRAVITY = 9.81
"""[m/s2]"""
FINEST = 0.0025
"""Spacing of the points that fingers can touch, finer than which clouds are not [m]."""
DESCENTS = 20
"""Steps of the search for the weakest direction."""


@dataclass(frozen=True)
class Contacts:
    """Where n candidates touch, gripper frame: up to c contacts of each of f fingers."""

    fraction: Float[Array, "n f"]
    """Closing fraction at the first contact; 2 where there is none."""
    count: Int[Array, "n f"]
    point: Float[Array, "n f c 3"]
    """[m]"""
    push: Float[Array, "n f c 3"]
    """Unit vectors along which the contacts push the object: against its normals."""


@dataclass(frozen=True)
class Touchable:
    """The object as closing fingers meet it, on the device, origin at the centre of mass."""

    points: wp.array
    normals: wp.array
    centre_of_mass: Float[Array, "3"]
    length: float
    """Root mean square distance of its surface from the centre of mass [m]: torques are measured by it."""
    down: Float[Array, "3"]
    """Where its weight pulls, world frame."""


def touchable(scene: Scene, config: GripConfig, device: str) -> Touchable:
    """The object thinned to evenly spread points, those of opposite sides kept apart."""
    points, normals = scene.target.points - scene.centre_of_mass, scene.target.normals
    assert normals is not None  # every scene estimates them
    spacing, sectors = FINEST, normal_sector(normals)
    index = _spread(points, spacing, sectors)
    if len(index) > config.points:
        index = _spread(points, spacing * np.sqrt(len(index) / config.points), sectors)
    return Touchable(
        points=wp.array(points[index], dtype=wp.vec3, device=device),
        normals=wp.array(normals[index], dtype=wp.vec3, device=device),
        centre_of_mass=scene.centre_of_mass,
        length=max(float(np.sqrt(np.mean(np.sum(points[index] ** 2, axis=-1)))), 1e-3),
        down=-scene.table.normal if scene.table is not None else np.array([0.0, 0.0, -1.0]),
    )


def contacts_of(
    candidates: Candidates, target: Touchable, gripper: Gripper, config: GripConfig, device: str
) -> Contacts:
    """Contacts of the closed fingers, each on its own, the object still where it was."""
    arrays = _find(candidates, target, gripper, config, device)
    fraction, count, point, push = (array.numpy() for array in arrays)
    return Contacts(fraction.astype(float), count.astype(int), point.astype(float), push.astype(float))


def margins(
    candidates: Candidates, target: Touchable, gripper: Gripper, config: GripConfig, device: str
) -> Float[Array, "n"]:
    """Smallest wrench that a grasp cannot resist besides the object's weight; below zero, what is missing to hold it.

    In units of one finger's force and, for torques, of that times the object's size.
    """
    fingers = len(gripper.fingers)
    _, count, point, push = _find(candidates, target, gripper, config, device)
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
    gripper: Gripper,
    config: GripConfig,
    rng: np.random.Generator,
    device: str,
) -> Graded:
    """Margins and confidence of all candidates; robust margins are computed for the most promising ones only."""
    margin = margins(closed, target, gripper, config, device)
    robust = margin.copy()
    promising = np.argsort(-confidence(margin, margin, loss), kind="stable")[: config.promising]
    robust[promising] = robust_margins(closed.select(promising), target, gripper, config, rng, device)
    others = np.setdiff1d(np.arange(len(closed)), promising)
    robust[others] -= LEFT_OUT
    return Graded(
        **vars(closed),
        error=error,
        final_loss=loss,
        margin=margin,
        robust_margin=robust,
        confidence=confidence(margin, robust, loss),
    )


def confidence(
    margin: Float[Array, "n"], robust_margin: Float[Array, "n"], loss: Float[Array, "n"]
) -> Float[Array, "n"]:
    """Share of grasps with these figures that hold: a logistic model, fitted by `bench/calibration.py`."""
    root_loss = np.sqrt(np.maximum(loss, 0.0)) / LOSS_SCALE
    offset, by_margin, by_robust, by_loss = CALIBRATION
    return 1 / (1 + np.exp(-(offset + by_margin * margin + by_robust * robust_margin + by_loss * root_loss)))


LOSS_SCALE = 0.05
"""[m]"""
CALIBRATION = (4.19, 2.03, 2.19, -1.45)
"""Offset, and weights of the margin, of the robust margin and of the root of the loss."""
LEFT_OUT = 0.2
"""What a grasp that is not looked at closely is taken to lose of its margin to errors."""


def most_force(gripper: Gripper) -> float:
    """How much harder than rated a finger can press: with a drive of its own, as hard as all others against it."""
    drives = {finger.joints for finger in gripper.fingers}
    return float(max(len(gripper.fingers) - 1, 1)) if len(drives) == len(gripper.fingers) else 1.0


def _find(
    candidates: Candidates, target: Touchable, gripper: Gripper, config: GripConfig, device: str
) -> list[wp.array]:
    """Fraction, count, point and push of the contacts, on the device."""
    n, f = len(candidates), len(gripper.fingers)
    reached = wp.empty((n, f, len(target.points)), dtype=wp.float32, device=device)
    outputs = [
        wp.empty((n, f), dtype=wp.float32, device=device),
        wp.empty((n, f), dtype=wp.int32, device=device),
        wp.zeros((n, f, warp_grip.CORNERS), dtype=wp.vec3, device=device),
        wp.zeros((n, f, warp_grip.CORNERS), dtype=wp.vec3, device=device),
    ]
    poses = pose_arrays(candidates, target.centre_of_mass, device)
    arrival = upload_gripper(gripper, device).arrival
    inputs = [f, arrival, target.points, target.normals, config.patch_depth, *poses, reached]
    launch(warp_grip.find_contacts, n, inputs, outputs, device)
    return outputs


def _spread(points: Float[Array, "n 3"], spacing: float, sectors: Int[Array, "n"]) -> Int[Array, "m"]:
    """One point of each voxel and side."""
    _, inverse = voxel_downsample(points, spacing, labels=sectors)
    return np.unique(inverse, return_index=True)[1]


def _directions(random: int) -> Float[Array, "k 6"]:
    """Unit vectors in the space of wrenches: both ways along each axis, and some at random."""
    drawn = np.random.default_rng(0).normal(size=(random, 6))
    vectors = np.concatenate([np.eye(6), -np.eye(6), drawn])
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


DIRECTIONS = _directions(52)
