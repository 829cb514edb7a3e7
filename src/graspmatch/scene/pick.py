"""Which of the things in a view is the target: by number, by a place in the image, or by a mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from graspmatch.scene.pieces import linked_parts
from graspmatch.scene.plane import SupportPlane
from graspmatch.scene.segment import NOTHING, OTHER, TABLE, Segmentation, above_table, described, support_plane, thinned
from graspmatch.scene.view import View
from graspmatch.types import GraspmatchError, Plane

Array = np.ndarray

NEAR_PIXELS = 12
NEAR_METRES = 0.03
"""A place names the nearest object within these."""
CORE = 0.1
"""Parts of a masked object that are smaller than this share of it are what the mask's edge spilled onto."""
FEWEST_MASKED = 30


def choose(
    view: View, found: Segmentation, *, number: int | None = None, at: Sequence[float] | None = None
) -> Sequence[int]:
    """The indices of the objects in question: the one of the number or at a place, else all, the largest first.

    at: column and row [pixels] in an organised view, else x, y or x, y, z [m] in the frame of the cloud.
    """
    if number is not None and at is not None:
        raise GraspmatchError("Both the number and the place of the object are given; one of them is enough.")
    if number is not None:
        matching = np.flatnonzero(found.numbers == number)
        if len(matching) == 0:
            raise GraspmatchError(f"There is no object {number}. Found: {found.describe()}.")
        return [int(matching[0])]
    if at is None:
        return range(len(found))
    return [_at_pixel(view, found, at) if view.shape is not None else _at_place(view, found, at)]


def segment_by_mask(view: View, mask: Shaped[Array, "h w"], *, table: Plane | None = None) -> Segmentation:
    """The objects that a mask marks, numbered by its values; 0 marks nothing. Without a plane there is no table."""
    values = _checked_mask(view, mask)
    seen = np.flatnonzero(view.is_seen)
    points = view.points[seen]
    support: SupportPlane | None
    try:
        support = support_plane(points, table, view)
        above = above_table(points, support, view)
    except GraspmatchError:
        if table is not None:
            raise
        support, above = None, np.ones(len(points), dtype=bool)
    label = np.where(above, OTHER, TABLE).astype(np.int32)
    numbers = np.unique(values[values != 0])
    for index, number in enumerate(numbers):
        label[_cleaned(points, above & (values[seen] == number), int(number), view)] = index
    whole = np.full(len(view.points), NOTHING, dtype=np.int32)
    whole[seen] = label
    return replace(described(view, support, whole), numbers=numbers.astype(np.int64))


def _checked_mask(view: View, mask: Shaped[Array, "h w"]) -> Int[Array, "n"]:
    array = np.asarray(mask)
    if view.shape is None:
        raise GraspmatchError("A mask needs a depth image or an organised cloud; this cloud has no rows and columns.")
    if array.shape != view.shape:
        has, needs = (" x ".join(str(side) for side in shape[::-1]) for shape in (array.shape, view.shape))
        raise GraspmatchError(f"The mask has {has} pixels, the view {needs}: both must be of the same image.")
    if not np.any(array != 0):
        raise GraspmatchError("The mask is zero everywhere: it marks no object.")
    return array.astype(np.int64).ravel()


def _cleaned(points: Float[Array, "m 3"], marked: Bool[Array, "m"], number: int, view: View) -> Int[Array, "k"]:
    """Indices of the marked points, without what lies apart from them: masks reach over edges."""
    chosen = np.flatnonzero(marked)
    if len(chosen) < FEWEST_MASKED:
        raise GraspmatchError(
            f"Of what the mask marks with {number}, only {len(chosen)} pixels have a depth and lie above the table; "
            f"{FEWEST_MASKED} are needed."
        )
    centroids, inverse, spacing = thinned(points[chosen], view)
    part = linked_parts(centroids, spacing)
    return chosen[(np.bincount(part)[part] >= CORE * len(part))[inverse]]


def _at_pixel(view: View, found: Segmentation, at: Sequence[float]) -> int:
    assert view.shape is not None
    if len(at) != 2 or not (0 <= at[0] < view.shape[1] and 0 <= at[1] < view.shape[0]):
        size = f"{view.shape[1]} x {view.shape[0]}"
        raise GraspmatchError(f"{_written(at)} is no pixel: column,row of an image of {size} pixels is needed.")
    rows, columns = np.nonzero((found.labels >= 0).reshape(view.shape))
    distance = np.hypot(columns - at[0], rows - at[1])
    nearest = int(np.argmin(distance))
    if distance[nearest] > NEAR_PIXELS:
        raise GraspmatchError(f"There is no object at the pixel {_written(at)}. Found: {found.describe()}.")
    return int(found.labels.reshape(view.shape)[rows[nearest], columns[nearest]])


def _at_place(view: View, found: Segmentation, at: Sequence[float]) -> int:
    if len(at) not in (2, 3) or not np.isfinite(at).all():
        raise GraspmatchError(f"{_written(at)} is no place: x,y or x,y,z in metres is needed.")
    mine = np.flatnonzero(found.labels >= 0)
    distance = np.linalg.norm(view.points[mine, : len(at)] - np.asarray(at), axis=1)
    nearest = int(np.argmin(distance))
    if distance[nearest] > NEAR_METRES:
        raise GraspmatchError(f"There is no object at {_written(at)}. Found: {found.describe()}.")
    return int(found.labels[mine[nearest]])


def _written(at: Sequence[float]) -> str:
    return ",".join(f"{value:g}" for value in at)
