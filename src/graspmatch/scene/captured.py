"""From what a sensor saw to the scene of one object: its far side guessed, and what is hidden beside it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from graspmatch.geometry.cloud import bounds
from graspmatch.scene import surface
from graspmatch.scene.complete import far_side, hidden_part
from graspmatch.scene.sight import sight_lines
from graspmatch.scene.target import Target
from graspmatch.scene.view import View, to_world
from graspmatch.types import PointCloud

if TYPE_CHECKING:
    from graspmatch.scene.scene import Scene

OBSTACLE_SPACING = 0.004
"""Distance between the points of what else a sensor saw [m], at least."""
HAND_REACH = 0.12
"""So far beside the target a hand may be in the way of other things [m]."""


def free_scene(cls: type[Scene], view: View, targets: Iterable[Target], *, with_table: bool, complete: bool) -> Scene:
    """The scene of the first target on which nothing stands; of the first of all, if there is none such."""
    if not with_table:
        targets = (replace(target, table=None) for target in targets)
    scenes = (view_scene(cls, view, target, complete=complete) for target in targets)
    first = next(scenes)
    return next((scene for scene in itertools.chain([first], scenes) if not scene.is_loaded), first)


def view_scene(cls: type[Scene], view: View, target: Target, *, complete: bool) -> Scene:
    """The scene of one object of a view, its far side guessed where that is wanted."""
    origin = None if view.origin is None else to_world(view, view.origin[None])[0]
    seen, _, spacing, notes = surface.cloud_surface(target.points, None, origin)
    obstacles = surface.thin_obstacles(target.obstacles, max(spacing, OBSTACLE_SPACING))
    scene = cls(
        target=seen,
        obstacles=PointCloud(obstacles),
        table=target.table,
        centre_of_mass=seen.points.mean(axis=0),
        source=view.source,
        sensor_origin=origin,
        notes=(*view.notes, *target.notes, *notes),
        view=view,
        cut=target.cut,
    )
    return completed(scene) if complete else scene


def completed(scene: Scene) -> Scene:
    """The scene with the far side of its target guessed, and what other things near it may have where nobody saw;
    unchanged where there is no table, no view, or no sensor's place."""
    if scene.view is None or scene.table is None or scene.is_guessed is not None:
        return scene
    seen, others = scene.target, scene.obstacles.points
    low, high = bounds(seen.points)
    others = others[np.all((others > low - HAND_REACH) & (others < high + HAND_REACH), axis=1)]
    lines = sight_lines(scene.view, seen.points, 2 * HAND_REACH)
    found = None if lines is None else far_side(seen, scene.table, lines, others)
    if lines is None or found is None:
        return scene
    hidden = hidden_part(others, scene.table, lines, seen.points)
    obstacles = np.concatenate([scene.obstacles.points, hidden])
    both = [(seen.points, seen.normals), (found.guessed.points, found.guessed.normals)]
    points, normals = (np.concatenate(parts) for parts in zip(*both, strict=True))
    return replace(
        scene,
        target=PointCloud(points, normals),
        obstacles=PointCloud(obstacles),
        centre_of_mass=found.centre_of_mass,
        doubtful=found.doubtful,
        is_guessed=np.arange(len(points)) >= len(seen.points),
        is_hidden=np.arange(len(obstacles)) >= len(scene.obstacles.points),
    )
