"""Slices through what was seen of an object, level ones and upright ones along the view: the front that was seen, and
the back that it suggests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

Array = np.ndarray

THICKNESS = 0.012
"""Of a slice [m]."""
FEWEST = 8
"""Points of a slice."""
GAP = 3
"""Columns without a point that part two pieces of a slice."""
SKIN = 0.012
"""Points so far behind the front [m] are still of it."""
STEEPEST = 0.8
"""Of the normals of a wall, up."""
ROUND, ROUND_FROM = 0.05, 0.0012
"""A front that is this near to a circle, in its radii or in metres, is one ..."""
WIDEST_CIRCLE = 1.25
"""... unless its radius is more than so many halves of the width: then it is nearly flat."""
ON_A_LINE = 1e-9
"""Share of the greatest possible determinant of a scatter matrix, below which its points have no circle."""
FALLING = 0.2
"""Of the normals behind a ridge, away from the sensor, at least: the slice is seen to fall there ..."""
FEWEST_BEHIND, AGREES = 5, 0.005
"""... by so many points, half of which say where the mirror is to this [m]."""
LEVELS, OFFSET = 3, 0.01
"""Circles of slices so near above and below [voxels], and so near across the view [m], stand for one another."""


@dataclass(frozen=True)
class Slice:
    """One connected piece of a slice: x runs across the view, y away from the sensor [m]."""

    level: int
    first: int
    """Column of its first place across the view."""
    across: Float[Array, "k"]
    """Middle of each column."""
    front: Float[Array, "k"]
    """Where it begins there."""
    ends: float
    """Depth of the middle between its two ends."""
    circle: tuple[float, float] | None
    """Middle of the circle that the front is of."""


@dataclass(frozen=True)
class Ridge:
    """An upright slice along the view, whose top was seen from before and behind."""

    column: int
    top: float
    """[m]"""
    depth: float
    """Of the ridge [m]."""
    heights: Float[Array, "k"]
    """Those at which the front was seen, upwards [m] ..."""
    front: Float[Array, "k"]
    """... and its depth there [m]."""

    def front_at(self, heights: Float[Array, "h"]) -> Float[Array, "h"]:
        """The front at any height."""
        return np.interp(heights, self.heights, self.front)


def ridge_of(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], column: int, across: float, spacing: float
) -> Ridge | None:
    """The upright slice at a place across the view, if it is seen to fall behind its ridge as it rises before it, the
    other way round: so it is with what is round and lies."""
    near = np.abs(points[:, 0] - across) < THICKNESS / 2
    if np.count_nonzero(near) < FEWEST:
        return None
    at, away = points[near], normals[near, 1]
    before = at[away < 0]
    levels, level = np.unique(np.floor(before[:, 2] / spacing), return_inverse=True)
    if len(levels) < 2:
        return None
    front = np.bincount(level, weights=before[:, 1]) / np.bincount(level)
    heights = (levels + 0.5) * spacing
    # What is seen behind and the front at the same height have the mirror half way between them.
    halfway = (at[:, 1] + np.interp(at[:, 2], heights, front))[away > FALLING] / 2
    if len(halfway) < FEWEST_BEHIND:
        return None
    depth = float(np.median(halfway))
    if np.median(np.abs(halfway - depth)) > AGREES:
        return None
    return Ridge(column, float(np.percentile(at[:, 2], 98)), depth, heights, front)


def slice_of(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], level: int, height: float, low: float, spacing: float
) -> list[Slice]:
    """The pieces of a slice at a height, in columns of a spacing from `low` on."""
    near = np.abs(points[:, 2] - height) < THICKNESS / 2
    if np.count_nonzero(near) < FEWEST:
        return []
    at, is_wall = points[near], np.abs(normals[near, 2]) < STEEPEST
    column = np.floor((at[:, 0] - low) / spacing).astype(int)
    front = np.full(column.max() + 1, np.inf)
    np.minimum.at(front, column, at[:, 1])
    filled = np.flatnonzero(np.isfinite(front))
    pieces = np.split(filled, np.flatnonzero(np.diff(filled) > GAP) + 1)
    return [_piece(piece, front, at, column, is_wall, level, low, spacing) for piece in pieces if len(piece) > 1]


def back_of(of: Slice, slices: Sequence[Slice]) -> Float[Array, "k"]:
    """How deep the piece is at each of its columns: turned by half a turn about its middle, as boxes and bottles are
    the same. That middle is the circle's where it is round, else half way between its two ends."""
    if of.circle is None:
        return 2 * of.ends - of.front[::-1]
    x, _ = of.circle
    alike = [
        other.circle[1]
        for other in slices
        if other.circle is not None and abs(other.level - of.level) <= LEVELS and abs(other.circle[0] - x) < OFFSET
    ]
    return 2 * float(np.median(alike)) - np.interp(2 * x - of.across, of.across, of.front)


def _piece(
    filled: Int[Array, "m"],
    front: Float[Array, "c"],
    at: Float[Array, "n 3"],
    column: Int[Array, "n"],
    is_wall: Array,
    level: int,
    low: float,
    spacing: float,
) -> Slice:
    columns = np.arange(filled[0], filled[-1] + 1)
    along = np.interp(columns, filled, front[filled])
    edge = max(min(2, len(along) // 2), 1)
    ends = float(along[:edge].mean() + along[-edge:].mean()) / 2
    of_front = is_wall & (column >= columns[0]) & (column <= columns[-1]) & (at[:, 1] < front[column] + SKIN)
    circle = _circle(at[of_front], len(columns) * spacing / 2, ends)
    return Slice(level, int(columns[0]), low + (columns + 0.5) * spacing, along, ends, circle)


def _circle(points: Float[Array, "n 3"], half_width: float, ends: float) -> tuple[float, float] | None:
    """Middle of the circle that fits the points (Kasa 1976), if they are of one whose front is what is seen."""
    if len(points) < FEWEST:
        return None
    middle = points[:, :2].mean(axis=0)
    x, y = (points[:, :2] - middle).T
    square = x**2 + y**2
    xx, xy, yy, xs, ys = x @ x, x @ y, y @ y, x @ square, y @ square
    determinant = xx * yy - xy**2
    if determinant <= ON_A_LINE * (xx + yy) ** 2:
        return None
    centre = np.array([xs * yy - ys * xy, ys * xx - xs * xy]) / (2 * determinant)
    radius = np.sqrt(centre @ centre + square.mean())
    a, b = middle + centre
    error = np.sqrt(np.mean((np.hypot(x - centre[0], y - centre[1]) - radius) ** 2))
    is_round = error < max(ROUND * radius, ROUND_FROM) and radius < WIDEST_CIRCLE * half_width
    return (float(a), float(b)) if is_round and b > ends - SKIN / 3 else None
