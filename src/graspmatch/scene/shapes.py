"""Objects made by code, for the demo and for tests: watertight, in metres, standing on z = 0."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.mesh import TriangleMesh, concatenate

Array = np.ndarray


def mug(diameter: float = 0.07, height: float = 0.09, wall: float = 0.004) -> TriangleMesh:
    """A mug around the z axis, its handle towards +x: two closed parts, the handle's ends inside the wall [m]."""
    body = revolved(_cup_profile(diameter / 2, height, wall))
    reach, rise, thickness = 0.35 * diameter, 0.3 * height, 0.065 * diameter
    angle = np.linspace(-np.pi / 2, np.pi / 2, 33)
    # An upright half ellipse that begins and ends level, in the middle of the wall.
    path = np.stack([diameter / 2 - wall / 2 + reach * np.cos(angle), rise * np.sin(angle) + height / 2], axis=-1)
    tangent = np.stack([-reach * np.sin(angle), rise * np.cos(angle)], axis=-1)
    return concatenate([body, swept_tube(path, tangent, thickness)])


def revolved(profile: Float[Array, "k 2"], segments: int = 64) -> TriangleMesh:
    """The solid of a profile (radius, z) [m] turned about z, from axis to axis, the outside to the right of its way."""
    angle = 2 * np.pi * np.arange(segments) / segments
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    radius, z = profile[1:-1].T
    rings = np.concatenate(
        [radius[:, None, None] * ring, np.broadcast_to(z[:, None, None], (len(z), segments, 1))], axis=-1
    )
    poles = np.array([[0.0, 0.0, profile[0, 1]], [0.0, 0.0, profile[-1, 1]]])
    return _closed_tube(rings, poles)


def swept_tube(path: Float[Array, "k 2"], tangent: Float[Array, "k 2"], radius: float, sides: int = 24) -> TriangleMesh:
    """A round bar of a radius [m] along a path (x, z) in the plane y = 0, with flat ends."""
    t = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
    centre = np.stack([path[:, 0], np.zeros(len(path)), path[:, 1]], axis=-1)
    across = np.stack([t[:, 1], np.zeros(len(path)), -t[:, 0]], axis=-1)
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * np.array([0.0, 1.0, 0.0])
    return _closed_tube(centre[:, None] + radius * circle, centre[[0, -1]])


def _cup_profile(radius: float, height: float, wall: float) -> Float[Array, "k 2"]:
    """Half a section through a cup with rounded edges [m], from the underside up the outside and down the inside."""
    quarter = np.linspace(0, np.pi / 2, 5)
    arc = np.stack([np.sin(quarter), 1 - np.cos(quarter)], axis=-1)  # from level to upright
    foot = np.array([radius - wall, 0.0]) + wall * arc
    half = np.linspace(0, np.pi, 9)
    rim = np.array([radius - wall / 2, height - wall / 2]) + wall / 2 * np.stack([np.cos(half), np.sin(half)], axis=-1)
    corner = np.array([radius - 2 * wall, wall]) + wall * arc[::-1]
    outside = np.linspace(foot[-1], rim[0], 8)[1:-1]
    inside = np.linspace(rim[-1], corner[0], 8)[1:-1]
    return np.concatenate([[[0.0, 0.0]], foot, outside, rim, inside, corner, [[0.0, wall]]])


def _closed_tube(rings: Float[Array, "k m 3"], poles: Float[Array, "2 3"]) -> TriangleMesh:
    """Rings of points joined by triangles, closed by one fan at either end."""
    k, m = rings.shape[:2]
    here = np.arange(m)
    beside = (here + 1) % m
    faces = [np.stack([np.full(m, k * m), beside, here], axis=-1)]
    for i in range(k - 1):
        a, b, c, d = i * m + here, i * m + beside, (i + 1) * m + here, (i + 1) * m + beside
        faces += [np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)]
    faces.append(np.stack([np.full(m, k * m + 1), (k - 1) * m + here, (k - 1) * m + beside], axis=-1))
    return TriangleMesh(np.concatenate([rings.reshape(-1, 3), poles]), np.concatenate(faces))
