"""Depth images made by code: boxes, cylinders and bowls on a table, seen by a camera whose every number is known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from graspmatch.geometry.se3 import from_parts, rotation_exp
from graspmatch.scene.camera import Camera, pixel_rays

Array = np.ndarray

K = np.array([[460.0, 0.0, 319.5], [0.0, 460.0, 239.5], [0.0, 0.0, 1.0]])
SHAPE = (480, 640)


@dataclass(frozen=True)
class Box:
    """A box on z = `z`, turned about the vertical."""

    x: float
    y: float
    size: tuple[float, float, float]
    yaw: float = 0.0
    z: float = 0.0

    def distances(self, origin: Array, rays: Array) -> Array:
        """How many rays away the surface is, infinite where it is missed."""
        R = rotation_exp(np.array([0.0, 0.0, self.yaw]))
        half = np.array(self.size) / 2
        centre = np.array([self.x, self.y, self.z + half[2]])
        with np.errstate(divide="ignore", invalid="ignore"):
            near, far = ((side * half - (origin - centre) @ R) / (rays @ R) for side in (-1, 1))
        entry, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
        return np.where((entry < leave) & (entry > 0), entry, np.inf)


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder on z = `z`; a cup with a thin wall if it is hollow."""

    x: float
    y: float
    radius: float
    height: float
    z: float = 0.0
    is_hollow: bool = False

    def distances(self, origin: Array, rays: Array) -> Array:
        """How many rays away the surface is, infinite where it is missed."""
        from_axis = origin[:2] - [self.x, self.y]
        a, b = (rays[..., :2] ** 2).sum(axis=-1), rays[..., :2] @ from_axis
        with np.errstate(invalid="ignore", divide="ignore"):
            root = np.sqrt(b * b - a * (from_axis @ from_axis - self.radius**2))
            walls = [self._within((-b + sign * root) / a, origin, rays) for sign in (-1, 1)]
            lid = (self.z + (0.006 if self.is_hollow else self.height) - origin[2]) / rays[..., 2]
            off = np.hypot(*(origin[i] + lid * rays[..., i] - (self.x, self.y)[i] for i in range(2)))
        return np.minimum.reduce([*walls, np.where((off < self.radius) & (lid > 0), lid, np.inf)])

    def _within(self, t: Array, origin: Array, rays: Array) -> Array:
        height = origin[2] + t * rays[..., 2] - self.z
        return np.where((t > 0) & (height > 0) & (height < self.height), t, np.inf)


@dataclass(frozen=True)
class Setting:
    """Things on a table that is the plane z = 0 with an edge, over a floor."""

    things: tuple[Box | Cylinder, ...]
    table: tuple[float, float] = (1.0, 0.8)
    """Sides along x and y [m]."""
    floor: float | None = -0.72
    wall: float | None = None
    """A wall at this y."""
    camera: Camera = field(default_factory=lambda: camera_at(45, 0.7))


def camera_at(elevation: float, distance: float, *, target: tuple[float, float, float] = (0.0, 0.0, 0.03)) -> Camera:
    """A camera in front of the table (at -y) that looks at the target from so many degrees above the horizon."""
    angle = np.radians(elevation)
    forward = np.array([0.0, np.cos(angle), -np.sin(angle)])
    right = np.array([1.0, 0.0, 0.0])
    R = np.stack([right, np.cross(forward, right), forward], axis=-1)
    return Camera(K, from_parts(R, np.array(target) - distance * forward))


def render(setting: Setting) -> tuple[Array, Array]:
    """True depth [m], 0 for nothing; and the index of the thing that each pixel sees, -1 for none of them."""
    of = setting.camera
    x, y = pixel_rays(of, SHAPE[1], SHAPE[0])
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float64) @ of.pose[:3, :3].T
    origin = of.pose[:3, 3]
    layers = [thing.distances(origin, rays) for thing in setting.things]
    layers.append(_level(0.0, origin, rays, setting.table))
    if setting.floor is not None:
        layers.append(_level(setting.floor, origin, rays, None))
    if setting.wall is not None:
        with np.errstate(divide="ignore"):
            away = (setting.wall - origin[1]) / rays[..., 1]
        layers.append(np.where(away > 0, away, np.inf))
    nearest = np.argmin(layers, axis=0)
    depth = np.min(layers, axis=0)
    seen = np.isfinite(depth) & (depth < 5)
    return np.where(seen, depth, 0.0), np.where(seen & (nearest < len(setting.things)), nearest, -1)


def noisy(depth: Array, rng: np.random.Generator, *, strength: float = 1.0) -> Array:
    """As a cheap stereo camera measures it: noise that grows as the square, averages at edges, millimetres."""
    smeared = depth.copy()
    step = np.abs(np.diff(depth, axis=1)) > 0.03
    for side in (0, 1):  # the pixel before or after the edge hangs between the two
        hit = np.zeros(depth.shape, dtype=bool)
        hit[:, side : depth.shape[1] - 1 + side] = step & (rng.random(step.shape) < 0.4)
        other = np.roll(depth, 1 if side else -1, axis=1)
        smeared[hit] = (depth + (other - depth) * rng.uniform(0.2, 0.8, depth.shape))[hit]
    smeared += strength * 0.0015 * depth**2 * rng.normal(size=depth.shape)
    smeared[rng.random(depth.shape) < 0.01] = 0
    return np.where(depth > 0, np.round(smeared, 3), 0)


def _level(z: float, origin: Array, rays: Array, sides: tuple[float, float] | None) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (z - origin[2]) / rays[..., 2]
        t = np.where(t > 0, t, np.inf)
        if sides is None:
            return t
        on = [np.abs(origin[i] + t * rays[..., i]) < sides[i] / 2 for i in range(2)]
    return np.where(on[0] & on[1], t, np.inf)
