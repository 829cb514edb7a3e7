"""Where closing fingers touch the object, and where it would lie against the palm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from graspmatch.config import GripConfig
from graspmatch.geometry.cloud import normal_sector, voxel_downsample
from graspmatch.kernels import warp_grip
from graspmatch.kernels.launch import launch
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.upload import pose_arrays, upload_gripper
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper

Array = np.ndarray

FINEST = 0.0025
"""Spacing of the points that fingers can touch, finer than which clouds are not [m]."""
PALM_FACING = 0.7
"""Cosine between the approach and the outward normals of what can lie against the palm, negated."""


@dataclass(frozen=True)
class Contacts:
    """Where n candidates touch, gripper frame: up to c contacts of each of f fingers, and last of the palm."""

    fraction: Float[Array, "n f"]
    """Closing fraction at the first contact; 2 where there is none."""
    count: Int[Array, "n g"]
    point: Float[Array, "n g c 3"]
    """[m]"""
    push: Float[Array, "n g c 3"]
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


def touchable(scene: Scene, most: int, device: str) -> Touchable:
    """The object thinned to at most so many evenly spread points, those of opposite sides kept apart."""
    points, normals = scene.target.points - scene.centre_of_mass, scene.target.normals
    assert normals is not None  # every scene estimates them
    spacing, sectors = FINEST, normal_sector(normals)
    index = _spread(points, spacing, sectors)
    if len(index) > most:
        index = _spread(points, spacing * np.sqrt(len(index) / most), sectors)
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
    arrays = find_contacts(candidates, target, gripper, config, device)
    fraction, count, point, push = (array.numpy() for array in arrays)
    return Contacts(fraction.astype(float), count.astype(int), point.astype(float), push.astype(float))


def find_contacts(
    candidates: Candidates, target: Touchable, gripper: Gripper, config: GripConfig, device: str
) -> list[wp.array]:
    """Fraction, count, point and push of the contacts, on the device."""
    n, f = len(candidates), len(gripper.fingers)
    excess = wp.empty((n, f + 1, len(target.points)), dtype=wp.float32, device=device)
    fraction = wp.empty((n, f), dtype=wp.float32, device=device)
    contacts = [
        wp.empty((n, f + 1), dtype=wp.int32, device=device),
        wp.zeros((n, f + 1, warp_grip.CORNERS), dtype=wp.vec3, device=device),
        wp.zeros((n, f + 1, warp_grip.CORNERS), dtype=wp.vec3, device=device),
    ]
    poses, hand = pose_arrays(candidates, target.centre_of_mass, device), upload_gripper(gripper, device)
    inputs = [f, hand.arrival, target.points, target.normals, config.patch_depth, *poses, excess]
    launch(warp_grip.find_contacts, n, inputs, [fraction, *contacts], device)
    pivots = wp.array(hand.pivots, dtype=wp.vec3, device=device)
    palm = [f, hand.matching.distance, pivots, wp.vec3(*gripper.approach), target.points, target.normals]
    inputs = [*palm, PALM_FACING, config.palm_reach, config.patch_depth, *poses, excess]
    launch(warp_grip.find_palm_contacts, n, inputs, contacts, device)
    return [fraction, *contacts]


def _spread(points: Float[Array, "n 3"], spacing: float, sectors: Int[Array, "n"]) -> Int[Array, "m"]:
    """One point of each voxel and side."""
    _, inverse = voxel_downsample(points, spacing, labels=sectors)
    return np.unique(inverse, return_index=True)[1]
