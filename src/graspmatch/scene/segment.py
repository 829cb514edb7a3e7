"""A view of a scene -> its table and the things on it, without learning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from graspmatch.geometry import cloud
from graspmatch.scene.pieces import pieces
from graspmatch.scene.plane import SupportPlane, find_plane, find_planes, measured_plane
from graspmatch.scene.view import View
from graspmatch.types import GraspmatchError, Plane

Array = np.ndarray

TABLE, OTHER, NOTHING = -1, -2, -3
"""Labels of what is no object: the table and below, what is above it, and what was not seen or is a speck."""

LOWEST, HIGHEST = 0.003, 0.010
"""Bounds of the height [m] from which on a point is above the table; between them, three times the noise."""
SPACING = 0.004
"""Distance of the points [m] that are linked to each other, at least."""
PIXELS_PER_SPACING = 2.2
MOST_POINTS = 5_000
OUTLINE_POINTS = 10_000
"""By so many points of the view the outline of the table is known."""
SMALLEST = 0.0004
"""Area [m2] of what is seen of an object, at least: 2 x 2 cm."""
LOWEST_OBJECT = 0.006
"""Things that rise less above the table [m] are ripples of the depth."""
LARGEST = 0.7
"""Things longer than this [m] are walls, screens or people."""
LISTED = 10
"""A line of text names so many objects."""
BESIDE = 0.03
"""Things reach so far over the edge of the table [m]."""
ON_TABLE = 0.3
"""At least this share of an object lies over the table."""


@dataclass(frozen=True)
class Segmentation:
    """The table and the objects on it, in the view frame; objects in order of the area that was seen."""

    table: Plane | None
    noise: float
    """Standard deviation of the points of the table [m]."""
    labels: Int[Array, "n"]
    """For each point of the view the number of its object, or `TABLE`, `OTHER` or `NOTHING`."""
    centres: Float[Array, "k 3"]
    """Middle of each object's box [m]."""
    extents: Float[Array, "k 3"]
    """Sides of that box along the axes of the view frame [m]."""
    heights: Float[Array, "k"]
    """How far each object reaches above the table [m]."""
    counts: Int[Array, "k"]
    """How many points each has."""
    numbers: Int[Array, "k"]
    """What each is called: 0, 1, ..., or the value of the mask that marked it."""

    def __len__(self) -> int:
        return len(self.counts)

    def describe(self) -> str:
        """The objects in one line: number, middle and size."""
        sizes = [" x ".join(f"{1000 * side:.0f}" for side in extent) for extent in self.extents]
        places = [", ".join(f"{value:.3f}" for value in centre) for centre in self.centres]
        each = zip(self.numbers, sizes, places, strict=True)
        listed = [f"{number}: {size} mm at ({place})" for number, size, place in each]
        more = [f"and {len(listed) - LISTED} more"] if len(listed) > LISTED else []
        return "; ".join(listed[:LISTED] + more) or "none"


def segment(view: View, *, table: Plane | None = None) -> Segmentation:
    """The table, found if it is not given (view frame), and the things that stand on it.

    Of the planes that could be the table, the largest is tried first, and the next ones if nothing stands on it.
    """
    seen = np.flatnonzero(view.is_seen)
    points = view.points.take(seen, axis=0)
    supports = find_planes(points, origin=view.origin, up=view.up) if table is None else [_given(points, table)]
    first: SupportPlane | None = None
    for support in supports:
        first = first or support
        label = _labels(points, support, view)
        if (label >= 0).any():
            whole = np.full(len(view.points), NOTHING, dtype=np.int32)
            whole[seen] = label
            return described(view, support, whole)
    assert first is not None  # or else find_planes has raised
    raise GraspmatchError(
        f"Nothing stands on the support plane, which was seen over {first.area * 1e4:.0f} cm2 with a noise of "
        f"{1000 * first.noise:.1f} mm: things flatter than {1000 * LOWEST_OBJECT:.0f} mm cannot be told from it. "
        "If the table is another plane, give its height (--table) or the camera's pose."
    )


def _labels(points: Float[Array, "m 3"], support: SupportPlane, view: View) -> Int32[Array, "m"]:
    above = above_table(points, support, view)
    label = np.full(len(points), TABLE, dtype=np.int32)
    if above.any():
        sample = slice(None, None, max(len(points) // OUTLINE_POINTS, 1))
        table_points = points[sample][np.abs(_heights(points[sample], support.plane)) < HIGHEST]
        label[above] = _things(np.compress(above, points, axis=0), table_points, support.plane, view)
    return label


def support_plane(points: Float[Array, "m 3"], table: Plane | None, view: View) -> SupportPlane:
    """The table: found, or the given one with the noise of the points on it."""
    return find_plane(points, origin=view.origin, up=view.up) if table is None else _given(points, table)


def _given(points: Float[Array, "m 3"], table: Plane) -> SupportPlane:
    near = np.abs(_heights(points, table)) < 0.02
    if np.mean(near) < 0.005:
        raise GraspmatchError(
            "No point lies within 2 cm of the given table: are its height, the camera's pose and the unit right? "
            "With --table auto it is found in the points."
        )
    return SupportPlane(table, measured_plane(table, points, area=0.0).noise, area=0.0)


def above_table(points: Float[Array, "m 3"], support: SupportPlane, view: View) -> Bool[Array, "m"]:
    """Points higher than the noise of the table, which beyond the middle of the view grows as the distance squared."""
    heights = _heights(points, support.plane)
    threshold = np.clip(3 * support.noise, LOWEST, HIGHEST)
    above = heights > threshold
    if view.origin is not None:
        distance = np.linalg.norm(points[::50] - view.origin, axis=1)
        chosen = np.flatnonzero(above & (heights < 2 * HIGHEST))
        ratio = np.linalg.norm(points[chosen] - view.origin, axis=1) / np.median(distance)
        above[chosen] = heights[chosen] > np.minimum(threshold * np.maximum(ratio, 1) ** 2, 2 * HIGHEST)
    return above


def _heights(points: Float[Array, "m 3"], plane: Plane) -> Float[Array, "m"]:
    return points @ plane.normal.astype(points.dtype) - points.dtype.type(plane.offset)


def _things(
    points: Float[Array, "n 3"], table_points: Float[Array, "t 3"], plane: Plane, view: View
) -> Int[Array, "n"]:
    """Labels of the points above the table."""
    frame = _frame_of(plane)
    sides = _sides(table_points @ frame)
    over = _is_over(points, sides, frame, BESIDE + LARGEST / 4)
    label = np.full(len(points), OTHER, dtype=np.int32)
    chosen = np.flatnonzero(over)
    centroids, inverse, spacing = thinned(points[chosen], view)
    piece = pieces(centroids, plane, spacing, view.origin)
    piece = _objects_only(piece, centroids, spacing, plane, _is_over(centroids, sides, frame, BESIDE))
    label[chosen] = piece[inverse]
    return label


def thinned(points: Float[Array, "n 3"], view: View) -> tuple[Float[Array, "m 3"], Int[Array, "n"], float]:
    """Centroids of cells, the cell of each point, and the spacing [m], as fine as the pixels at that distance allow."""
    spacing = SPACING
    if view.pixel_angle is not None and view.origin is not None and len(points):
        distance = np.median(np.linalg.norm(points[::20] - view.origin, axis=1))
        spacing = max(spacing, PIXELS_PER_SPACING * view.pixel_angle * float(distance))
    centroids, inverse = cloud.voxel_downsample(points, spacing)
    while len(centroids) > MOST_POINTS:
        spacing *= 1.1 * np.sqrt(len(centroids) / MOST_POINTS)
        centroids, inverse = cloud.voxel_downsample(points, spacing)
    return centroids, inverse, float(spacing)


def _objects_only(
    piece: Int[Array, "m"], points: Float[Array, "m 3"], spacing: float, plane: Plane, over: Bool[Array, "m"]
) -> Int[Array, "m"]:
    """Numbers of objects from those of pieces, in the same order; `OTHER` for what is none, `NOTHING` for specks."""
    count = int(piece.max(initial=-1)) + 1
    number, result = 0, np.where(piece < 0, NOTHING, OTHER)
    for i in range(count):
        mine = piece == i
        own = points[mine]
        if np.count_nonzero(mine) * spacing**2 < SMALLEST or (own @ plane.normal).max() - plane.offset < LOWEST_OBJECT:
            result[mine] = NOTHING
        elif np.mean(over[mine]) > ON_TABLE and cloud.extent(own) < LARGEST:
            result[mine] = number
            number += 1
    return result


def _frame_of(plane: Plane) -> Float[Array, "3 2"]:
    """Two unit vectors along the plane."""
    normal = plane.normal
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(normal, first)])


def _sides(flat: Float[Array, "t 2"]) -> Float[Array, "s 3"]:
    """Of the convex outline of the table, as lines ax + by + c = 0, negative within; none where it is hardly seen."""
    from scipy.spatial import ConvexHull, QhullError

    if len(flat) < 50:
        return np.zeros((0, 3))
    try:
        return ConvexHull(flat).equations
    except QhullError:  # all on one line
        return np.zeros((0, 3))


def _is_over(
    points: Float[Array, "n 3"], sides: Float[Array, "s 3"], frame: Float[Array, "3 2"], margin: float
) -> Bool[Array, "n"]:
    """Which points lie over the convex outline of the table, or beside it by less than the margin [m]."""
    # A side after the other: one product with all of them takes more memory than time.
    at = points @ frame.astype(points.dtype)
    inside = np.ones(len(points), dtype=bool)
    for a, b, c in sides.astype(points.dtype):
        inside &= a * at[:, 0] + b * at[:, 1] + c < margin
    return inside


def described(view: View, support: SupportPlane | None, labels: Int[Array, "n"]) -> Segmentation:
    """The labels with what they say about each object."""
    boxes, heights, counts = [], [], []
    for i in range(int(labels.max()) + 1):
        own = np.compress(labels == i, view.points, axis=0).astype(np.float64)
        boxes.append(cloud.bounds(own))
        heights.append(float(_heights(own, support.plane).max()) if support else float(np.ptp(own[:, 2])))
        counts.append(len(own))
    low, high = np.moveaxis(np.array(boxes), 1, 0)
    return Segmentation(
        table=support.plane if support else None,
        noise=support.noise if support else 0.0,
        labels=labels,
        centres=(low + high) / 2,
        extents=high - low,
        heights=np.array(heights),
        counts=np.array(counts),
        numbers=np.arange(len(counts)),
    )
