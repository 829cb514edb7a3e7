"""How a stereo depth camera errs: an image of true depths becomes one as the camera would send it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt16

from graspmatch.config import SensorConfig
from graspmatch.geometry.se3 import from_parts, rotation_exp
from graspmatch.scene.camera import Camera, pixel_rays
from graspmatch.simulate.camera import Sight

Array = np.ndarray

MILLIMETRE = 0.001
"""One step of the image's values [m], as ROS has it."""
EDGE = 0.02
"""Neighbouring pixels whose depths differ by more [m] lie on either side of an edge."""


@dataclass(frozen=True)
class Shot:
    """What the sensor sends."""

    depth: UInt16[Array, "h w"]
    """[mm], 0 where it measured nothing."""
    camera: Camera
    """Intrinsics, and where the camera is said to stand: off by what its calibration is."""


def shoot(sight: Sight, camera: Camera, config: SensorConfig, rng: np.random.Generator) -> Shot:
    """A depth image with all errors of a sensor, each drawn from `rng` whatever its size."""
    said = camera.placed(_miscalibrated(camera.pose, config, rng))
    x, y = pixel_rays(camera, sight.depth.shape[1], sight.depth.shape[0])
    depth = sight.depth.astype(np.float64)
    edge = _beside_edge(depth)
    depth = _smeared(depth, edge, config, rng)
    factor = 1 + config.scale_error * rng.normal() + config.tilt_error * (rng.normal() * x + rng.normal() * y)
    noise = _smooth_noise(depth.shape, config.noise_width, rng)
    depth = factor * depth + config.axial_noise * depth**2 * noise
    lost = edge & (rng.random(depth.shape) < config.edge_dropout)
    lost |= rng.random(depth.shape) < config.dropout
    lost |= sight.facing < np.cos(config.grazing)
    step = config.disparity_step * depth**2
    quantised = np.where(step > 0, np.round(depth / np.where(step > 0, step, 1.0)) * step, depth)
    millimetres = np.round(quantised / MILLIMETRE)
    return Shot(np.where(lost | (sight.depth == 0), 0, millimetres.clip(0, 65535)).astype(np.uint16), said)


def _miscalibrated(T: Float[Array, "4 4"], config: SensorConfig, rng: np.random.Generator) -> Float[Array, "4 4"]:
    """The pose moved and turned by the configured amounts, in directions drawn at random."""
    axis, way = (direction / np.linalg.norm(direction) for direction in rng.normal(size=(2, 3)))
    turn = from_parts(rotation_exp(config.pose_error_angle * axis), np.zeros(3))
    moved = T @ turn
    moved[:3, 3] += config.pose_error_position * way
    return moved


def _beside_edge(depth: Float[Array, "h w"]) -> Bool[Array, "h w"]:
    """Pixels on either side of a step; so is what borders on nothing."""
    found = np.zeros(depth.shape, dtype=bool)
    for image, mark in ((depth, found), (depth.T, found.T)):
        step = np.abs(np.diff(image, axis=1)) > EDGE
        mark[:, 1:] |= step
        mark[:, :-1] |= step
    return found


def _smeared(
    depth: Float[Array, "h w"], edge: Bool[Array, "h w"], config: SensorConfig, rng: np.random.Generator
) -> Float[Array, "h w"]:
    """Some pixels beside an edge hang in the air between what is on either side of it."""
    share = rng.random(depth.shape)
    flies = edge & (rng.random(depth.shape) < config.flying)
    column = rng.integers(-1, 2, depth.shape)
    row = rng.integers(-1, 2, depth.shape)
    rows, columns = np.indices(depth.shape)
    other = depth[np.clip(rows + row, 0, depth.shape[0] - 1), np.clip(columns + column, 0, depth.shape[1] - 1)]
    return np.where(flies & (other > 0) & (depth > 0), depth + share * (other - depth), depth)


def _smooth_noise(shape: tuple[int, ...], width: float, rng: np.random.Generator) -> Float[Array, "h w"]:
    """Normal noise of unit variance that neighbours share: stereo matches windows, not pixels."""
    from scipy.ndimage import gaussian_filter

    noise = rng.normal(size=shape)
    if width == 0:
        return noise
    smooth = gaussian_filter(noise, width, mode="wrap")
    return smooth / smooth.std()
