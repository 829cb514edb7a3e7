"""What keeps an object from being moved: things that stand on it, and things in the way of its own body."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from graspmatch.geometry import se3
from graspmatch.geometry.thin import thinned
from graspmatch.scene.pieces import linked_parts
from graspmatch.types import Plane

Array = np.ndarray

FLOATING = 0.01
"""What reaches less far down to the table than this [m] stands on something else, or its foot is hidden."""
FOOT = 0.015
"""The foot of a thing is what is seen of it within so much of its lowest point [m]."""
NEAR = 0.02
"""A foot stands on what is nearer than this [m]."""
INSIDE = 0.005
"""Feet are over an object if they are so far inside of its outline [m]: what is behind it is not."""
SHARE = 0.3
"""Of a foot, at least, must be near and inside."""
POINTS = 1000
"""Of each cloud, about so many are looked at."""
SPACING = 0.006
"""About as far are the points of thinned clouds apart [m]: those of one thing are linked to each other."""
FEWEST = 12
"""Parts of fewer points, of 4 cm2, are specks of noise."""
CELL = 0.008
"""Width of a column [m]: a little more than the points of thinned clouds are apart."""


def stands_on(upper: Float[Array, "n 3"], lower: Float[Array, "m 3"], table: Plane) -> bool:
    """Whether one thing stands on another: its foot is off the table, near the other and inside of its outline."""
    from scipy.spatial import KDTree

    if len(upper) == 0 or len(lower) == 0:
        return False
    heights = upper @ table.normal - table.offset
    if heights.min() < FLOATING:
        return False
    foot = upper[heights < heights.min() + FOOT]
    near = KDTree(lower).query(foot, distance_upper_bound=NEAR)[0] < NEAR
    return float(np.mean(near & is_over(foot, lower, table))) >= SHARE


def is_over(points: Float[Array, "n 3"], thing: Float[Array, "m 3"], table: Plane) -> Bool[Array, "n"]:
    """Which points are inside of the convex outline of a thing as it is seen from above."""
    from scipy.spatial import ConvexHull, QhullError

    frame = se3.rotation_facing(table.normal, np.eye(3)[np.argmin(np.abs(table.normal))])[:, :2]
    try:
        sides = ConvexHull(thing @ frame).equations
    except QhullError:  # a thing without width
        return np.zeros(len(points), dtype=bool)
    return np.all(points @ frame @ sides[:, :2].T + sides[:, 2] < -INSIDE, axis=1)


def is_stood_on(thing: Float[Array, "n 3"], others: Float[Array, "m 3"], table: Plane) -> bool:
    """Whether one of the parts that other points hang together in stands on a thing."""
    if len(others) == 0:
        return False
    thing, others = thinned(thing, POINTS), thinned(others, POINTS)
    part = linked_parts(others, SPACING)
    things = np.flatnonzero(np.bincount(part) >= FEWEST)
    return any(stands_on(others[part == i], thing, table) for i in things)


def covered_share(points: Float[Array, "n 3"], others: Float[Array, "m 3"], way: Float[Array, "3"]) -> float:
    """Share of an object's columns along a way [m] in which it would meet other points, if it moved by that way.

    Columns at the edge of the object do not count: things beside it are in them.
    """
    length = float(np.linalg.norm(way))
    if length == 0 or len(points) == 0 or len(others) == 0:
        return 0.0
    frame = se3.rotation_facing(way / length, np.eye(3)[np.argmin(np.abs(way))])
    own, theirs = points @ frame, others @ frame
    low = np.floor(own[:, :2].min(axis=0) / CELL).astype(int)
    shape = np.floor(own[:, :2].max(axis=0) / CELL).astype(int) - low + 1
    foremost = np.full(tuple(shape), -np.inf)
    np.maximum.at(foremost, tuple(_columns(own, low).T), own[:, 2])
    inner = _eroded(np.isfinite(foremost))
    at = _columns(theirs, low)
    near = np.all((at >= 0) & (at < shape), axis=1)
    i, j = at[near].T
    along = theirs[near, 2]
    meets = inner[i, j] & (along > foremost[i, j]) & (along < foremost[i, j] + length)
    return len(np.unique(np.ravel_multi_index((i[meets], j[meets]), tuple(shape)))) / max(int(inner.sum()), 1)


def _columns(points: Float[Array, "n 3"], low: Int[Array, "2"]) -> Int[Array, "n 2"]:
    return np.floor(points[:, :2] / CELL).astype(int) - low


def _eroded(cells: Bool[Array, "a b"]) -> Bool[Array, "a b"]:
    """The cells whose four neighbours are filled too."""
    padded = np.pad(cells, 1)
    return cells & padded[2:, 1:-1] & padded[:-2, 1:-1] & padded[1:-1, 2:] & padded[1:-1, :-2]
