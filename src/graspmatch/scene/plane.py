"""The plane that things stand on, found among points (RANSAC by one point and its normal)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from graspmatch.geometry import cloud
from graspmatch.types import GraspmatchError, Plane

Array = np.ndarray

SAMPLE = 8_000
"""So many points stand for all."""
REACH, NEAR_SHARE = 2.0, 0.15
"""If this share of the points is nearer than this [m], the table is among them."""
CELL = 0.01
"""Edge of the cells [m] by which a plane is measured, so that near things, seen by many pixels, count no more."""
HYPOTHESES = 120
SMALLEST_AREA = 0.008
"""A plane smaller than this [m2] is no table: 9 x 9 cm."""
MOST_PLANES = 3
TILT = np.radians(25)
"""How far from level a table may be, where up is known."""
STOREY = 0.25
"""A level surface so far above another [m] is the table, and the other the floor."""
STOREY_AREA = 0.02
"""At least so large [m2], or else it is the top of a box."""


@dataclass(frozen=True)
class SupportPlane:
    """The plane found, and how well the points agree with it."""

    plane: Plane
    noise: float
    """Standard deviation of its points from it [m], robustly."""
    area: float
    """Of what was seen of it [m2]."""


def find_plane(
    points: Float[Array, "n 3"], *, origin: Float[Array, "3"] | None = None, up: Float[Array, "3"] | None = None
) -> SupportPlane:
    """The largest plane, its normal towards the camera at `origin`; level where `up` is known. All points are finite.

    A table above a floor is preferred to the floor. Without a camera and up, the normal points to where things are.
    """
    return next(find_planes(points, origin=origin, up=up))


def find_planes(
    points: Float[Array, "n 3"], *, origin: Float[Array, "3"] | None = None, up: Float[Array, "3"] | None = None
) -> Iterator[SupportPlane]:
    """That plane, and then the largest ones of the other points, since the first may be a wall; at least one."""
    cells, spacing, cell_of_pixel = _evenly_spaced(points if origin is None else _within_reach(points, origin))
    # As many by area as by pixels: the floor is large, and a small table near.
    chosen = np.unique(np.concatenate([_spread(np.arange(len(cells))), _spread(cell_of_pixel)]))
    normals, offsets = _hypotheses(cells, chosen, spacing, up)
    tolerance = _tolerance(cells, origin, spacing)
    is_left = np.ones(len(cells), dtype=bool)
    for number in range(MOST_PLANES):
        areas = spacing**2 * _support(cells[is_left], tolerance[is_left], normals, offsets)
        if areas.max(initial=0) < SMALLEST_AREA:
            if number == 0:
                raise _no_plane(float(areas.max(initial=0)), is_level=up is not None)
            return
        best = int(np.argmax(areas))
        plane = Plane(normals[best].astype(np.float64), float(offsets[best]))
        plane = _refined(plane, cells[is_left], tolerance[is_left])
        plane = _towards(plane, cells, tolerance, origin, up)
        plane = _upper_storey(plane, cells, normals, offsets, areas, tolerance)
        near = _near(plane, cells, tolerance)
        yield measured_plane(plane, points, area=float(np.count_nonzero(near) * spacing**2))
        is_left &= ~_near(plane, cells, 2 * tolerance)


def _support(
    cells: Float[Array, "m 3"], tolerance: Float[Array, "m"], normals: Float[Array, "h 3"], offsets: Float[Array, "h"]
) -> Float[Array, "h"]:
    """How many cells lie on each hypothesis."""
    counts = np.zeros(len(normals))
    for part in np.array_split(np.arange(len(normals)), 16):  # each fits the cache
        away = normals[part] @ cells.T - offsets[part, None]
        counts[part] = (np.abs(away, out=away) < tolerance).sum(axis=1)
    return counts


def _no_plane(area: float, *, is_level: bool) -> GraspmatchError:
    level = f" within {np.degrees(TILT):.0f} degrees of level" if is_level else ""
    return GraspmatchError(
        f"No support plane was found: the largest flat part{level} has {area * 1e4:.0f} cm2. "
        "Give the table (--table), or pass a cloud of the object alone without picking an object in it."
    )


def measured_plane(plane: Plane, points: Float[Array, "n 3"], area: float) -> SupportPlane:
    """The plane fitted to the points near it once more, and their noise."""
    sample = points[:: max(len(points) // SAMPLE, 1)].astype(np.float64)
    reach = 0.012
    for _ in range(3):
        heights = sample @ plane.normal - plane.offset
        near = np.abs(heights) < reach
        if np.count_nonzero(near) < 10:
            break
        plane = _fitted(sample[near], plane.normal)
        reach = float(np.clip(3 * 1.4826 * np.median(np.abs(sample[near] @ plane.normal - plane.offset)), 0.002, 0.012))
    heights = sample @ plane.normal - plane.offset
    near = np.abs(heights) < 2 * reach
    noise = 1.4826 * float(np.median(np.abs(heights[near]))) if near.any() else reach
    return SupportPlane(plane, noise, area)


def _within_reach(points: Float[Array, "n 3"], origin: Float[Array, "3"]) -> Float[Array, "m 3"]:
    """Some of the points, those near the camera if they are many enough: no arm reaches what is far."""
    sample = points[:: max(len(points) // (2 * SAMPLE), 1)]
    near = np.linalg.norm(sample - origin.astype(points.dtype), axis=1) < REACH
    return sample[near] if np.mean(near) > NEAR_SHARE else sample


def _evenly_spaced(points: Float[Array, "n 3"]) -> tuple[Float[Array, "m 3"], float, Int[Array, "_"]]:
    """Centroids of cells, their edge [m]: a centimetre, more where the scene is large; the cell of points all over."""
    sample = points[:: max(len(points) // SAMPLE, 1)]
    low, high = np.percentile(sample, [2, 98], axis=0)
    spacing = max(CELL, float(np.max(high - low)) / 120)
    cells, inverse = cloud.voxel_downsample(sample, spacing)
    return cells.astype(np.float32), spacing, inverse


def _spread(indices: Int[Array, "n"]) -> Int[Array, "_"]:
    return indices[:: max(len(indices) // HYPOTHESES, 1)]


def _hypotheses(
    cells: Float[Array, "m 3"], chosen: Int[Array, "c"], spacing: float, up: Float[Array, "3"] | None
) -> tuple[Float[Array, "h 3"], Float[Array, "h"]]:
    """Planes through the chosen cells, with the normals of their surroundings; the flat ones."""
    from scipy.spatial import KDTree

    if len(cells) < 8:
        return np.zeros((0, 3), dtype=np.float32), np.zeros(0, dtype=np.float32)
    _, found = KDTree(cells).query(cells[chosen], min(24, len(cells)), distance_upper_bound=6 * spacing)
    index = np.asarray(found)
    known = index < len(cells)
    local = cells[np.where(known, index, index[:, :1])].astype(np.float64)
    local -= local.mean(axis=1, keepdims=True)
    values, axes = np.linalg.eigh(np.swapaxes(local, 1, 2) @ local)
    normals = axes[:, :, 0]
    flat = (values[:, 0] < 0.1 * values[:, 1]) & (np.count_nonzero(known, axis=1) >= 6)
    if up is not None:
        flat &= np.abs(normals @ up) > np.cos(TILT)
    offsets = np.einsum("ni,ni->n", normals[flat], cells[chosen[flat]])
    return normals[flat].astype(np.float32), offsets.astype(np.float32)


def _tolerance(cells: Float[Array, "m 3"], origin: Float[Array, "3"] | None, spacing: float) -> Float[Array, "m"]:
    """How far from a plane a point of it may be [m]: sensors err with the square of the distance."""
    if origin is None:
        return np.full(len(cells), 0.4 * spacing + 0.004, dtype=np.float32)
    distance = np.linalg.norm(cells - origin, axis=1)
    return (0.006 + 0.004 * distance**2).astype(np.float32)


def _near(plane: Plane, cells: Float[Array, "m 3"], tolerance: Float[Array, "m"]) -> Bool[Array, "m"]:
    return np.abs(cells @ plane.normal - plane.offset) < tolerance


def _refined(plane: Plane, cells: Float[Array, "m 3"], tolerance: Float[Array, "m"]) -> Plane:
    """Fitted to its own inliers until they stay."""
    for shrink in (1.5, 1.0, 0.7, 0.7):
        near = _near(plane, cells, shrink * tolerance)
        if np.count_nonzero(near) >= 10:
            plane = _fitted(cells[near].astype(np.float64), plane.normal)
    return plane


def _fitted(points: Float[Array, "n 3"], like: Float[Array, "3"]) -> Plane:
    """Least squares; the normal on the side of `like`."""
    centre = points.mean(axis=0)
    normal = np.linalg.eigh((points - centre).T @ (points - centre))[1][:, 0]
    normal = normal if normal @ like >= 0 else -normal
    return Plane(normal, float(normal @ centre))


def _towards(
    plane: Plane,
    cells: Float[Array, "m 3"],
    tolerance: Float[Array, "m"],
    origin: Float[Array, "3"] | None,
    up: Float[Array, "3"] | None,
) -> Plane:
    """The plane with its normal up, to the camera, or to the side where more points are."""
    if up is not None:
        side = float(plane.normal @ up)
    elif origin is not None:
        side = float(plane.normal @ origin - plane.offset)
    else:
        heights = cells @ plane.normal - plane.offset
        side = float(np.count_nonzero(heights > 2 * tolerance) - np.count_nonzero(heights < -2 * tolerance))
    return plane if side >= 0 else Plane(-plane.normal, -plane.offset)


def _upper_storey(
    plane: Plane,
    cells: Float[Array, "m 3"],
    normals: Float[Array, "h 3"],
    offsets: Float[Array, "h"],
    areas: Float[Array, "h"],
    tolerance: Float[Array, "m"],
) -> Plane:
    """The largest surface that is parallel and a storey above, if there is one; else the plane itself."""
    signs = np.where(normals @ plane.normal < 0, -1.0, 1.0)
    parallel = np.abs(normals @ plane.normal) > np.cos(np.radians(8))
    near = _near(plane, cells, tolerance)
    middle = cells[near].mean(axis=0) if near.any() else plane.offset * plane.normal
    climbs = signs * offsets - (signs[:, None] * normals) @ middle
    above = np.flatnonzero(parallel & (climbs > STOREY) & (areas > STOREY_AREA))
    if len(above) == 0:
        return plane
    best = _largest(above, areas)
    return _refined(
        Plane(signs[best] * normals[best].astype(np.float64), float(signs[best] * offsets[best])), cells, tolerance
    )


def _largest(candidates: Int[Array, "k"], areas: Float[Array, "h"]) -> int:
    return int(candidates[np.argmax(areas[candidates])])
