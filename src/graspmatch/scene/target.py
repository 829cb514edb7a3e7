"""One object of a view as the target, and what is around it, in the world."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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


@dataclass(frozen=True)
class Target:
    """What a view says about one object, in the world."""

    points: Float[Array, "n 3"]
    obstacles: Float[Array, "m 3"]
    """What else rises above the table near the object [m]."""
    table: Plane | None
    notes: tuple[str, ...] = ()


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
    chosen = [choose(view, found, number=number, at=at)] if is_chosen else range(len(found))
    for index in chosen:
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
    low, high = points.min(axis=0) - SURROUNDINGS, points.max(axis=0) + SURROUNDINGS
    is_other = (found.labels == OTHER) | ((found.labels >= 0) & (found.labels != index))
    others = np.compress(is_other, view.points, axis=0)
    near = np.all([(others[:, i] > low[i]) & (others[:, i] < high[i]) for i in range(3)], axis=0)
    table = None if found.table is None else _plane_in_world(view, found.table)
    return Target(to_world(view, points), to_world(view, others[near]), table, notes)


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
