"""Every object of a capture as a scene of its own, in which the others are in the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from graspmatch.scene.camera import Camera
from graspmatch.scene.captured import view_scene
from graspmatch.scene.depth import DepthImage
from graspmatch.scene.depth_view import Correct, depth_view, plane_in_view
from graspmatch.scene.scene import METRES, Array, PathLike, Scene, Table, Unit, cloud_view
from graspmatch.scene.target import targets_of
from graspmatch.scene.view import View, with_up
from graspmatch.types import Plane, PointCloud


def scenes_of_depth(
    depth: PathLike | Array | DepthImage,
    camera: PathLike | Array | Camera | None = None,
    *,
    mask: PathLike | Array | None = None,
    table: Table = "auto",
    metres_per_unit: float | None = None,
    correct: Correct = "auto",
    up: Sequence[float] | Array | None = None,
    complete: bool = True,
) -> dict[int, Scene]:
    """The scenes of all objects in a depth image, by their numbers; arguments are as for `Scene.from_depth`."""
    view, plane = depth_view(depth, camera, table, metres_per_unit=metres_per_unit, correct=correct, up=up)
    return _scenes(view, plane, table, mask, complete)


def scenes_of_view(
    view: View | PathLike | PointCloud | Array,
    *,
    mask: PathLike | Array | None = None,
    table: Table = "auto",
    unit: Unit = "auto",
    T_world_cloud: Array | None = None,
    sensor_origin: Sequence[float] | Array | None = None,
    up: Sequence[float] | Array | None = None,
    complete: bool = True,
) -> dict[int, Scene]:
    """The scenes of all objects in a cloud, by their numbers; arguments are as for `Scene.from_view`."""
    if not isinstance(view, View):
        view = cloud_view(view, unit, T_world_cloud, sensor_origin)
    view = with_up(view, up)
    return _scenes(view, plane_in_view(view, table, METRES[unit]), table, mask, complete)


def _scenes(
    view: View, plane: Plane | None, table: Table, mask: PathLike | Array | None, complete: bool
) -> dict[int, Scene]:
    targets = targets_of(view, plane, mask=mask)
    if table is None:
        targets = {number: replace(target, table=None) for number, target in targets.items()}
    return {number: view_scene(Scene, view, target, complete=complete) for number, target in targets.items()}
