"""One object of a view as the target, and what is around it, in the world."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from graspmatch.geometry.cloud import bounds
from graspmatch.scene.depth_file import read_mask
from graspmatch.scene.pick import choose, segment_by_mask
from graspmatch.scene.segment import OTHER, Segmentation, segment
from graspmatch.scene.view import View, to_world
from graspmatch.types import GraspmatchError, Plane

Array = np.ndarray

NEAREST, FARTHEST = 0.15, 3.0
"""Median distances [m] between which nobody asks whether a table is so far away."""
SURROUNDINGS = 0.4
"""Things farther from the target than this [m] are in nobody's way."""

ACROSS = 5
"""So many pixels beside an object [pixels], past those that measured nothing, is what is next to it."""
NEARER = 0.01
"""What is nearer to the camera than the object beside it by so much [m] may hide some of it."""


@dataclass(frozen=True)
class Target:
    """What a view says about one object, in the world."""

    points: Float[Array, "n 3"]
    obstacles: Float[Array, "m 3"]
    """What else rises above the table near the object [m]."""
    table: Plane | None
    notes: tuple[str, ...] = ()
    cut: float = 0.0
    """Share of its outline in the image where something nearer hides what may follow."""


def targets_in_turn(
    view: View,
    table: Plane | None = None,
    *,
    number: int | None = None,
    at: Sequence[float] | None = None,
    mask: str | os.PathLike[str] | Array | None = None,
) -> Iterator[Target]:
    """The object of a number or at a place; without either, all of them, that of which most is seen first. `table` is
    in the view frame, None to find it."""
    found = _segmented(view, table, mask)
    is_chosen = number is not None or at is not None
    for index in choose(view, found, number=number, at=at):
        yield cut_out(view, found, index, notes=_notes(found, index, is_chosen=is_chosen))


def targets_of(
    view: View, table: Plane | None = None, *, mask: str | os.PathLike[str] | Array | None = None
) -> dict[int, Target]:
    """Every object of a view by its number, each with all others as obstacles."""
    found = _segmented(view, table, mask)
    notes = _notes(found, 0, is_chosen=True)
    return {int(number): cut_out(view, found, index, notes=notes) for index, number in enumerate(found.numbers)}


def _segmented(view: View, table: Plane | None, mask: str | os.PathLike[str] | Array | None) -> Segmentation:
    """The objects of a view, or those that a mask marks."""
    if mask is None:
        try:
            return segment(view, table=table)
        except GraspmatchError as error:
            raise GraspmatchError(f"{error}{_doubt(view)}") from error
    marked = mask if isinstance(mask, np.ndarray) else read_mask(mask)
    return segment_by_mask(view, marked, table=table)


def _doubt(view: View) -> str:
    """A question where what was seen is as near or as far as no table with things to grasp on it."""
    if view.origin is None:
        return ""
    seen = view.points[view.is_seen]
    away = float(np.median(np.linalg.norm(seen[:: max(len(seen) // 5000, 1)] - view.origin, axis=1)))
    if NEAREST < away < FARTHEST:
        return ""
    return f" What is seen is {away:.2g} m away: is the unit right (--depth-scale, --unit)?"


def cut_out(view: View, found: Segmentation, index: int, *, notes: tuple[str, ...] = ()) -> Target:
    """One object of a segmentation, and all else above the table that is near it."""
    points = np.compress(found.labels == index, view.points, axis=0)
    low, high = bounds(points)
    low, high = low - SURROUNDINGS, high + SURROUNDINGS
    is_other = (found.labels == OTHER) | ((found.labels >= 0) & (found.labels != index))
    others = np.compress(is_other, view.points, axis=0)
    near = np.all([(others[:, i] > low[i]) & (others[:, i] < high[i]) for i in range(3)], axis=0)
    table = None if found.table is None else _plane_in_world(view, found.table)
    cut = cut_share(view, found.labels == index)
    return Target(to_world(view, points), to_world(view, others[near]), table, notes, cut)


def cut_share(view: View, mine: Bool[Array, "n"]) -> float:
    """Share of the outline of an object in the image beside which something nearer was seen; 0 for a view without rows
    or a known camera. Pixels that measured nothing are looked across: edges are full of them."""
    if view.shape is None or view.origin is None:
        return 0.0
    rows, columns = (np.flatnonzero(mine.reshape(view.shape).any(axis=axis)) for axis in (1, 0))
    around = tuple(slice(max(at[0] - ACROSS, 0), at[-1] + ACROSS + 1) for at in (rows, columns))
    inside = np.pad(mine.reshape(view.shape)[around], ACROSS)
    offset = view.points.reshape(*view.shape, 3)[around] - view.origin.astype(view.points.dtype)
    distance = np.pad(np.sqrt(np.square(offset) @ np.ones(3, dtype=offset.dtype)), ACROSS, constant_values=np.nan)
    nearer = beside = 0
    for axis, way in itertools.product((0, 1), (-1, 1)):
        next_one = np.full_like(distance, np.nan)
        for step in range(ACROSS, 0, -1):
            found = np.roll(distance, way * step, axis=axis)
            next_one = np.where(np.isnan(found), next_one, found)
        leaves = inside & ~np.roll(inside, way, axis=axis) & np.isfinite(next_one)
        beside += np.count_nonzero(leaves)
        nearer += np.count_nonzero(leaves & (next_one < distance - NEARER))
    return nearer / max(beside, 1)


def _plane_in_world(view: View, plane: Plane) -> Plane:
    normal = view.T_world_view[:3, :3] @ plane.normal
    return Plane(normal, float(plane.offset + normal @ view.T_world_view[:3, 3]))


def _notes(found: Segmentation, index: int, *, is_chosen: bool) -> tuple[str, ...]:
    notes: tuple[str, ...] = ()
    if found.table is None:
        notes += ("No support plane was found around the mask: no table is assumed.",)
    if len(found) > 1 and not is_chosen:
        number = found.numbers[index]
        notes += (f"{len(found)} objects were found, and number {number} was taken: {found.describe()}.",)
    return notes
