"""Building blocks of objects made by code: closed solids in metres, each with the convex parts that it is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from graspmatch.geometry.mesh import TriangleMesh, concatenate, transformed
from graspmatch.scene.outline import convex_pieces, distance_to_segment, fan

Array = np.ndarray

TOLERANCE = 0.0012
"""How far the convex parts of a solid may bridge a notch or a curve of it [m]."""


@dataclass(frozen=True)
class Solid:
    """A surface, and the same volume as convex parts, which a simulation needs."""

    mesh: TriangleMesh
    """One or more closed surfaces, faces outwards; they may reach into each other."""
    parts: tuple[TriangleMesh, ...]
    """Closed convex meshes in the frame of `mesh`, whose union it is, give or take 2 mm."""


def joined(solids: Sequence[Solid]) -> Solid:
    """One solid of several that touch or reach into each other."""
    return Solid(concatenate([s.mesh for s in solids]), tuple(part for s in solids for part in s.parts))


def moved(solid: Solid, T_a_b: Float[Array, "4 4"]) -> Solid:
    """The solid of frame b, expressed in frame a."""
    return Solid(transformed(solid.mesh, T_a_b), tuple(transformed(part, T_a_b) for part in solid.parts))


def mug(diameter: float = 0.07, height: float = 0.09, wall: float = 0.004) -> TriangleMesh:
    """The surface of `mug_solid`."""
    return mug_solid(diameter, height, wall).mesh


def mug_solid(diameter: float = 0.07, height: float = 0.09, wall: float = 0.004) -> Solid:
    """A mug around the z axis, its handle towards +x: two closed surfaces, the handle's ends inside the wall [m]."""
    body = revolved(_cup_profile(diameter / 2, height, wall))
    reach, rise, thickness = 0.35 * diameter, 0.3 * height, 0.065 * diameter
    angle = np.linspace(-np.pi / 2, np.pi / 2, 33)
    # An upright half ellipse that begins and ends level, in the middle of the wall.
    sine, cosine, none = np.sin(angle), np.cos(angle), np.zeros(len(angle))
    path = np.stack([diameter / 2 - wall / 2 + reach * cosine, none, rise * sine + height / 2], axis=-1)
    tangent = np.stack([-reach * sine, none, rise * cosine], axis=-1)
    handle = swept(path, tangent, np.full(len(path), thickness), axis=np.array([0.0, 1.0, 0.0]))
    return joined([body, handle])


def convex(points: Float[Array, "n 3"]) -> Solid:
    """The convex hull of points."""
    hull = convex_hull(points)
    return Solid(hull, (hull,))


def revolved(profile: Float[Array, "k 2"], segments: int = 64) -> Solid:
    """The solid of a profile (radius, z) [m] turned about z, from axis to axis, the outside to the right of its way."""
    rings = _turned(profile[1:-1], segments).transpose(1, 0, 2)
    poles = np.array([[0.0, 0.0, profile[0, 1]], [0.0, 0.0, profile[-1, 1]]])
    return Solid(_closed_tube(rings, poles), revolved_parts(profile, segments))


def revolved_parts(profile: Float[Array, "k 2"], segments: int = 64) -> tuple[TriangleMesh, ...]:
    """Convex parts of a turned profile: a disc for each piece of its section at the axis, a ring of sectors for others.

    On the outside they are the surface itself; hollows they bridge by at most `TOLERANCE` a sector and notch.
    """
    levels = np.unique(profile[:, 1])[::-1]
    levels = levels[(levels < profile[-1, 1]) & (levels > profile[0, 1])]
    # Corners on the axis, so that a piece can end level with any corner of the profile.
    section = np.concatenate([profile, np.stack([np.zeros(len(levels)), levels], axis=-1)])
    parts = []
    for ring in convex_pieces(section, TOLERANCE):
        piece = section[ring]
        turned = _turned(piece, segments)
        if np.count_nonzero(piece[:, 0] == 0) > 1:
            parts.append(convex_hull(turned.reshape(-1, 3)))
            continue
        step = segments // _sectors(float(piece[:, 0].max()), segments)
        stations = np.concatenate([turned, turned[:1]])
        parts += [convex_hull(stations[i : i + step + 1].reshape(-1, 3)) for i in range(0, segments, step)]
    return tuple(parts)


def swept(
    path: Float[Array, "k 3"],
    tangent: Float[Array, "k 3"],
    radius: Float[Array, "k"],
    *,
    axis: Float[Array, "3"],
    sides: int = 24,
) -> Solid:
    """A round bar with flat ends along a path [m]: circles of the radii, perpendicular to the tangents.

    `axis` is a unit vector perpendicular to all tangents.
    """
    across = np.cross(axis, tangent / np.linalg.norm(tangent, axis=-1, keepdims=True))
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * axis
    rings = path[:, None] + radius[:, None, None] * circle
    stops = _straight_stretches(np.concatenate([path, radius[:, None]], axis=-1))
    parts = tuple(convex_hull(rings[i : j + 1].reshape(-1, 3)) for i, j in pairwise(stops))
    return Solid(_closed_tube(rings, path[[0, -1]]), parts)


def extruded(outline: Float[Array, "k 2"], height: float) -> Solid:
    """The prism over an outline (x, y), from z = 0 to a height [m]. A hole is reached by a slit."""
    corners, which = np.unique(outline, axis=0, return_inverse=True)  # the two sides of a slit become one
    which = which.ravel()
    lid = np.concatenate([which[ring[fan(outline[ring])]] for ring in convex_pieces(outline)])
    here, there = which, np.roll(which, -1)
    wall = ~_is_slit(here, there)
    here, there = here[wall], there[wall]
    n = len(corners)
    sides = [np.stack([here, there, there + n], axis=-1), np.stack([here, there + n, here + n], axis=-1)]
    faces = np.concatenate([lid[:, ::-1], lid + n, *sides])
    parts = tuple(convex_hull(_prism(outline[ring], height)) for ring in convex_pieces(outline, TOLERANCE))
    return Solid(TriangleMesh(_prism(corners, height), faces), parts)


def convex_hull(points: Float[Array, "n 3"]) -> TriangleMesh:
    """Closed, faces outwards."""
    hull = ConvexHull(points)
    a, b, c = np.moveaxis(points[hull.simplices], 1, 0)
    inwards = np.sum(np.cross(b - a, c - a) * hull.equations[:, :3], axis=-1) < 0
    faces = np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, index = np.unique(faces, return_inverse=True)
    return TriangleMesh(points[used], index.reshape(-1, 3))


def _turned(profile: Float[Array, "k 2"], segments: int) -> Float[Array, "s k 3"]:
    """A profile (radius, z) at each of the angles around z."""
    angle = 2 * np.pi * np.arange(segments) / segments
    x, y = (radial[:, None] * profile[:, 0] for radial in (np.cos(angle), np.sin(angle)))
    return np.stack([x, y, np.broadcast_to(profile[:, 1], x.shape)], axis=-1)


def _sectors(radius: float, segments: int) -> int:
    """The fewest sectors whose chords stay near the circle [m], as the segments can be dealt out to them."""
    fewest = max(np.pi / np.arccos(max(1 - TOLERANCE / radius, 0.0)), 3)
    return next((n for n in range(3, segments) if n >= fewest and segments % n == 0), segments)


def _straight_stretches(stations: Float[Array, "k c"]) -> list[int]:
    """Where to cut a bar: the longest stretches along which place and radius are within `TOLERANCE` of straight."""
    stops = [0]
    for end in range(2, len(stations)):
        begin = stops[-1]
        stretch = stations[begin : end + 1]
        if distance_to_segment(stretch, stretch[:1], stretch[-1:]).max() > TOLERANCE:
            stops.append(end - 1)
    return [*stops, len(stations) - 1]


def _is_slit(here: Int[Array, "e"], there: Int[Array, "e"]) -> Array:
    """Is the edge run in both directions?"""
    size = max(int(here.max()), int(there.max())) + 1
    return np.isin(here * size + there, there * size + here)


def _prism(corners: Float[Array, "k 2"], height: float) -> Float[Array, "2*k 3"]:
    """Corners at z = 0, then at a height."""
    low = np.column_stack([corners, np.zeros(len(corners))])
    return np.concatenate([low, low + np.array([0.0, 0.0, height])])


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
