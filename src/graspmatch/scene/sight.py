"""What a sensor says of any place around a target: that it is free, or hidden, or that nobody knows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from graspmatch.geometry.cloud import bounds
from graspmatch.geometry.se3 import rotation_facing
from graspmatch.scene.view import View, seen_from, to_world

Array = np.ndarray

COARSENESS = 1.5
"""Pixels of the picture that is made here, in pixels of the sensor: few stay without a point."""
MOST_PIXELS = 1000
"""Along a side of that picture."""


@dataclass(frozen=True)
class SightLines:
    """The nearest point that was seen along each of many rays, as a picture of what surrounds a target."""

    depth: Float32[Array, "n n"]
    """Along the axis [m], NaN where nothing was seen."""
    R_world_axes: Float[Array, "3 3"]
    """Columns: right, down and the axis of the picture."""
    origin: Float[Array, "3"]
    """Of the sensor [m]."""
    focal: float
    """[pixels]"""

    def beyond(self, points_world: Float[Array, "n 3"]) -> Float32[Array, "n"]:
        """How much farther than each point the sensor saw along the axis [m]: what is positive lies in space that was
        seen to be free, what is negative is hidden; NaN where nobody knows."""
        x, y, z = self.R_world_axes.T.astype(np.float32) @ (points_world - self.origin).astype(np.float32).T
        half = len(self.depth) // 2
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = (half + np.rint(self.focal * side / z) for side in (x, y))
        inside = (z > 0) & (np.minimum(column, row) >= 0) & (np.maximum(column, row) < len(self.depth))
        seen = np.full(len(z), np.nan, dtype=np.float32)
        seen[inside] = self.depth[row[inside].astype(int), column[inside].astype(int)]
        return seen - z


def sight_lines(view: View, target_world: Float[Array, "n 3"], reach: float) -> SightLines | None:
    """Those that pass a target, or beside it by so much [m]; None where nobody knows where the sensor stands."""
    if view.origin is None:
        return None
    origin = to_world(view, view.origin[None])[0]
    low, high = bounds(target_world)
    middle = (low + high) / 2
    distance = float(np.linalg.norm(middle - origin))
    radius = float(np.linalg.norm(high - low)) / 2 + reach
    R = rotation_facing(middle - origin, np.eye(3)[np.argmin(np.abs(middle - origin))])
    slope = radius / max(distance - radius, distance / 2)
    half = int(np.clip(slope / (COARSENESS * _pixel_angle(view, target_world, distance)), 1, MOST_PIXELS // 2))
    focal = half / slope
    R_view_axes = (view.T_world_view[:3, :3].T @ R).astype(view.points.dtype)
    x, y, z = R_view_axes.T @ seen_from(view.origin, view.points).T
    with np.errstate(divide="ignore", invalid="ignore"):
        near = np.flatnonzero((np.abs(x) < slope * z) & (np.abs(y) < slope * z))  # false of what was not seen
    z = z[near]
    column, row = (half + np.rint(focal * side[near] / z).astype(int) for side in (x, y))
    depth = np.full((2 * half + 1, 2 * half + 1), np.nan, dtype=np.float32)
    if len(near):
        window = tuple(slice(max(side.min() - 1, 0), side.max() + 2) for side in (row, column))  # often a small part
        least = np.full_like(depth[window], np.inf)
        index = (row - window[0].start) * least.shape[1] + column - window[1].start
        np.minimum.at(least.reshape(-1), index, z)
        # Of rays between pixels, and of pixels that failed, those around them say what was seen.
        least = np.where(np.isfinite(least), least, _nearest_around(least))
        depth[window] = np.where(np.isfinite(least), least, np.nan)
    return SightLines(depth, R, origin, focal)


def _nearest_around(depth: Float32[Array, "h w"]) -> Float32[Array, "h w"]:
    """The least of the 3 x 3 pixels around each."""
    padded = np.pad(depth, 1, constant_values=np.inf)
    rows = np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
    return np.minimum(np.minimum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])


def _pixel_angle(view: View, target_world: Float[Array, "n 3"], distance: float) -> float:
    """Angle between neighbouring rays [rad]; for a cloud without rows, as its points lie on the target."""
    if view.pixel_angle is not None:
        return view.pixel_angle
    from scipy.spatial import KDTree

    some = target_world[:: max(len(target_world) // 500, 1)]
    apart = np.median(np.asarray(KDTree(target_world).query(some, 2)[0])[:, 1])
    return max(float(apart) / distance, 1e-4)
