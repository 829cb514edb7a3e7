"""From a depth image and its camera to a view: files read, the depth corrected where the table is known."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Shaped

from graspmatch.geometry.se3 import inverse
from graspmatch.scene.camera import Camera, camera
from graspmatch.scene.camera_file import read_intrinsics
from graspmatch.scene.correct import correct_depth, levelled
from graspmatch.scene.depth import DepthImage, depth_image
from graspmatch.scene.depth_file import read_depth
from graspmatch.scene.view import View, view_of_depth, with_up
from graspmatch.types import GraspmatchError, Plane

Array = np.ndarray
PathLike = str | os.PathLike[str]
Correct = Literal["auto", "depth", "tilt", "off"]

VERTICAL = np.array([0.0, 0.0, 1.0])


def depth_view(
    depth: PathLike | Shaped[Array, "h w"] | DepthImage,
    camera_or_file: PathLike | Array | Camera | None,
    table: str | float | int | Plane | None = "auto",
    *,
    metres_per_unit: float | None = None,
    correct: Correct = "auto",
    up: object = None,
) -> tuple[View, Plane | None]:
    """What the image saw, and the table in the view frame where it is given; the options are those of `from_depth`."""
    image, source = _image(depth, camera_or_file, metres_per_unit)
    view = with_up(view_of_depth(image, source), up)
    plane = plane_in_view(view, table)
    if correct not in get_args(Correct):
        raise GraspmatchError(f"Unknown correction {correct!r}. Known: {', '.join(get_args(Correct))}.")
    if correct == "tilt":
        if view.up is None:
            raise GraspmatchError(
                "To make the table level, give the camera's pose (--camera-pose) or what is up (--up)."
            )
        image, _ = correct_depth(image, up_camera=view.up, camera_height=None if plane is None else -plane.offset)
    elif correct in ("auto", "depth") and plane is not None:
        if correct == "auto" and view.is_placed:
            image = levelled(image)
            view = with_up(view_of_depth(image, source), up)
            plane = plane_in_view(view, table)
            assert plane is not None
        image, _ = correct_depth(image, up_camera=plane.normal, camera_height=-plane.offset)
    else:
        return view, plane
    return with_up(view_of_depth(image, source), view.up), plane


def plane_in_view(view: View, table: object, scale: float = 1.0) -> Plane | None:
    """A table given in the world, as a height [`scale` m] or a plane [m], in the view frame; None to find it."""
    if table is None or (isinstance(table, str) and table == "auto"):
        return None
    if isinstance(table, Plane):
        length = float(np.linalg.norm(table.normal))
        if not (length > 0 and np.isfinite(table.offset)):
            raise GraspmatchError("The table needs a normal that is not zero and an offset that is a number.")
        normal_world, offset_world = table.normal / length, table.offset / length
    elif isinstance(table, (int, float, np.integer, np.floating)) and np.isfinite(table):
        if not view.is_placed:
            raise GraspmatchError(
                "The table's height means nothing without the camera's pose: give the pose (--camera-pose), "
                "or let the table be found (--table auto)."
            )
        normal_world, offset_world = VERTICAL, float(table) * scale
    else:
        raise GraspmatchError(f"The table is {table!r}. Possible: auto, the height of the table, a Plane.")
    T_view_world = inverse(view.T_world_view)
    normal = T_view_world[:3, :3] @ normal_world
    return Plane(normal, float(offset_world + normal @ T_view_world[:3, 3]))


def _image(
    depth: PathLike | Array | DepthImage, camera_or_file: PathLike | Array | Camera | None, scale: float | None
) -> tuple[DepthImage, str]:
    if isinstance(depth, DepthImage):
        return depth, "array"
    raw, source = (depth, "array") if isinstance(depth, np.ndarray) else (read_depth(depth), Path(depth).name)
    return depth_image(raw, _camera(depth, camera_or_file), metres_per_unit=scale), source


def _camera(depth: PathLike | Array, camera_or_file: PathLike | Array | Camera | None) -> Camera:
    if isinstance(camera_or_file, Camera):
        return camera_or_file
    if isinstance(camera_or_file, (str, os.PathLike)):
        return read_intrinsics(camera_or_file)
    if camera_or_file is not None:
        return camera(camera_or_file)
    if not isinstance(depth, np.ndarray) and Path(depth).suffix.lower() == ".npz":
        return read_intrinsics(depth)  # many captures keep both in one file
    raise GraspmatchError(
        "A depth image needs the camera's intrinsics (--intrinsics): a camera_info YAML or JSON, a file of the 3x3 "
        "matrix, or fx,fy,cx,cy."
    )
