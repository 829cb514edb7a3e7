"""Plane outlines, and the convex pieces that they are made of.

An outline is a closed polygon, counter-clockwise. A hole is reached by a slit: an edge in and the same edge out.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull

from graspmatch.types import GraspmatchError

Array = np.ndarray

FLAT = 1e-9
"""A notch this deep, or a point this far from a line, is rounding [m]."""
COST_OF_LENGTH = 0.05
"""What a metre of cut costs, in metres of notch left."""


def convex_pieces(outline: Float[Array, "k 2"], tolerance: float = 0.0) -> list[Int[Array, "_"]]:
    """Pieces between cuts from corner to corner, as indices of their corners, counter-clockwise.

    The deepest notch is cut first (Lien and Amato 2006, approximate convex decomposition) until no corner of a piece
    lies deeper than `tolerance` [m] below the hull of the piece.
    """
    _check(outline)
    pieces, waiting = [], [np.arange(len(outline))]
    while waiting:
        ring = waiting.pop()
        depths = notch_depths(outline[ring])
        if depths.max() <= tolerance + FLAT:
            pieces.append(ring)
        else:
            waiting += [ring[half] for half in _best_cut(outline[ring], int(np.argmax(depths)))]
    return pieces


def notch_depths(outline: Float[Array, "k 2"]) -> Float[Array, "k"]:
    """Distance of each corner from the side of the convex hull that bridges its notch [m]."""
    on_hull = np.sort(ConvexHull(outline).vertices)
    after = np.searchsorted(on_hull, np.arange(len(outline)), side="right")
    return distance_to_segment(outline, outline[on_hull[after - 1]], outline[on_hull[after % len(on_hull)]])


def distance_to_segment(
    points: Float[Array, "n c"], begin: Float[Array, "#n c"], end: Float[Array, "#n c"]
) -> Float[Array, "n"]:
    """Distance of each point from the straight line between two ends [m]."""
    along, offset = end - begin, points - begin
    share = np.clip(np.sum(along * offset, -1) / np.maximum(np.sum(along * along, -1), FLAT**2), 0, 1)
    return np.linalg.norm(offset - share[:, None] * along, axis=-1)


def fan(polygon: Float[Array, "k 2"]) -> Int[Array, "k-2 3"]:
    """Triangles of a convex polygon around the corner that makes the smallest of them largest."""
    k = len(polygon)
    step = np.arange(1, k - 1)
    fans = [np.stack([np.full(k - 2, i), (i + step) % k, (i + step + 1) % k], axis=-1) for i in range(k)]
    smallest = [_cross(polygon[f[:, 1]] - polygon[f[:, 0]], polygon[f[:, 2]] - polygon[f[:, 0]]).min() for f in fans]
    return fans[int(np.argmax(smallest))]


def _check(outline: Float[Array, "k 2"]) -> None:
    ends = np.roll(outline, -1, axis=0)
    if np.sum(_cross(outline, ends)) <= 0:
        raise GraspmatchError("The outline runs clockwise or encloses nothing; it must run counter-clockwise.")
    if _run_across(outline[:, None], ends[:, None], outline, ends).any():
        raise GraspmatchError("The outline crosses itself; it must be a simple polygon.")


def _best_cut(outline: Float[Array, "k 2"], notch: int) -> tuple[Int[Array, "_"], Int[Array, "_"]]:
    """The two halves that a short cut from the notch leaves with the shallowest notches."""
    corners = np.arange(len(outline))
    best, halves = np.inf, (corners, corners[:0])
    for other in np.flatnonzero(_seen_from(outline, notch)):
        low, high = min(notch, other), max(notch, other)
        one, two = corners[low : high + 1], np.concatenate([corners[high:], corners[: low + 1]])
        left = max(notch_depths(outline[one]).max(), notch_depths(outline[two]).max())
        cost = left + COST_OF_LENGTH * float(np.linalg.norm(outline[notch] - outline[other]))
        if cost < best:
            best, halves = cost, (one, two)
    if best == np.inf:
        raise GraspmatchError(
            "The outline folds back onto itself; only a slit to a hole may be run in both directions."
        )
    return halves


def _seen_from(outline: Float[Array, "k 2"], eye: int) -> Bool[Array, "k"]:
    """The corners to which a straight line from the corner `eye` runs inside the outline, touching nothing."""
    k = len(outline)
    after, before = np.roll(outline, -1, axis=0) - outline, np.roll(outline, 1, axis=0) - outline
    way = outline - outline[eye]
    seen = _inside_corner(after, before, -way) & _inside_corner(after[[eye]], before[[eye]], way)
    ends = np.roll(outline, -1, axis=0)
    for other in np.flatnonzero(seen):
        beside = np.abs(_cross(way[other], way)) > FLAT * np.linalg.norm(way[other])
        share = way @ way[other] / (way[other] @ way[other])
        touched = ~beside & (share > FLAT) & (share < 1 - FLAT)
        seen[other] = not (touched.any() or _run_across(outline[eye], outline[other], outline, ends).any())
    seen[[eye, (eye - 1) % k, (eye + 1) % k]] = False
    return seen


def _inside_corner(
    after: Float[Array, "k 2"], before: Float[Array, "k 2"], way: Float[Array, "n 2"]
) -> Bool[Array, "_"]:
    """Does the way lead strictly into the interior, between the edge to the next corner and that to the last?"""
    left_of_after, right_of_before = _cross(after, way), -_cross(before, way)
    reflex = _cross(after, before) < 0
    # Not sharper than rounding, in the unit of the products [m2].
    tiny = FLAT * np.linalg.norm(way, axis=-1)
    return np.where(
        reflex,
        (left_of_after > tiny) | (right_of_before > tiny),
        (left_of_after > tiny) & (right_of_before > tiny),
    )


def _run_across(
    a: Float[Array, "*m 2"], b: Float[Array, "*m 2"], c: Float[Array, "*n 2"], d: Float[Array, "*n 2"]
) -> Bool[Array, "*_"]:
    """Do the lines from a to b and from c to d cross between their ends?"""
    return (_cross(b - a, c - a) * _cross(b - a, d - a) < 0) & (_cross(d - c, a - c) * _cross(d - c, b - c) < 0)


def _cross(a: Float[Array, "*n 2"], b: Float[Array, "*m 2"]) -> Float[Array, "*_"]:
    """Positive where b is to the left of a."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
