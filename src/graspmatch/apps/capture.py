"""The input of `plan`: one object, or a capture of a whole scene in which one is picked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from graspmatch.apps.options import Capture
from graspmatch.errors import GraspmatchError
from graspmatch.scene.bag import is_bag, read_bag
from graspmatch.scene.camera import Camera, camera
from graspmatch.scene.camera_file import pose_of_numbers, read_intrinsics, read_pose
from graspmatch.scene.depth_file import DEPTH_KEYS
from graspmatch.scene.read import CLOUD_KEYS
from graspmatch.scene.scene import METRES, Scene, Unit
from graspmatch.scene.view import View, view_of_cloud

Table = float | Literal["auto"] | None

IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".exr", ".pgm")


def read_scene(path: Path | None, capture: Capture, *, table: Table, unit: Unit, obstacles: Path | None) -> Scene:
    """The scene of a mesh, of the cloud of an object, or of an object in a depth image, cloud or bag of a scene."""
    if path is None and capture.depth is None:
        raise GraspmatchError("Nothing to grasp is given: name a mesh or a cloud, or a depth image (--depth).")
    if path is not None and capture.depth is not None:
        raise GraspmatchError(f"Both {path} and the depth image {capture.depth} are given; one of them is enough.")
    picks_object = capture.object is not None or capture.at is not None or capture.mask is not None
    depth = capture.depth or (path if path is not None and _is_depth(path, picks_object) else None)
    if depth is None and path is not None and not is_bag(path):
        if not picks_object and capture == Capture():
            return Scene.read(path, table=table, unit=unit, obstacles=obstacles)
        if not picks_object:
            raise GraspmatchError(
                f"{path.name} is read as one object. To pick one in the cloud of a whole scene, say which: --object 0, "
                "--at or --mask."
            )
    if obstacles is not None:
        raise GraspmatchError("Obstacles of a capture come from the capture: leave out --obstacles.")
    if depth is not None:
        return _from_depth(depth, capture, table, unit)
    assert path is not None
    return _from_bag(path, capture, table, unit) if is_bag(path) else _from_cloud(path, capture, table, unit)


def _from_depth(
    depth: Path | np.ndarray, capture: Capture, table: Table, unit: Unit, known: Camera | None = None
) -> Scene:
    of = known if capture.intrinsics is None else _intrinsics(capture.intrinsics)
    if of is None and isinstance(depth, Path) and depth.suffix.lower() == ".npz":
        of = read_intrinsics(depth)
    pose = _pose(capture)
    if of is not None and pose is not None:
        of = of.placed(pose)
    scale = METRES[unit] if capture.depth_scale is None and unit != "auto" else capture.depth_scale
    return Scene.from_depth(
        depth,
        of,
        object=capture.object,
        at=_place(capture.at, "--at", "320,240"),
        mask=capture.mask,
        table=table,
        metres_per_unit=scale,
        correct=capture.correct_depth,
        up=_place(capture.up, "--up", "0,-1,0"),
        complete=capture.complete,
    )


def _from_cloud(cloud: Path | View, capture: Capture, table: Table, unit: Unit) -> Scene:
    return Scene.from_view(
        cloud,
        object=capture.object,
        at=_place(capture.at, "--at", "320,240"),
        mask=capture.mask,
        table=table,
        unit=unit,
        T_world_cloud=_pose(capture),
        up=_place(capture.up, "--up", "0,-1,0"),
        complete=capture.complete,
    )


def _from_bag(path: Path, capture: Capture, table: Table, unit: Unit) -> Scene:
    frame = read_bag(path, topic=capture.topic)
    note = f"{frame.topic} of {path.name} was read."
    if frame.depth is not None:
        scene = _from_depth(frame.depth, capture, table, unit, frame.camera)
    else:
        assert frame.cloud is not None
        scale = METRES[unit]
        view = view_of_cloud(frame.cloud, scale=scale, T_world_cloud=_pose(capture), source=path.name)
        scene = _from_cloud(view, capture, table, unit)
    return replace(scene, source=path.name, notes=(note, *scene.notes))


def _intrinsics(text: str) -> Camera:
    """A file, or fx,fy,cx,cy."""
    numbers = _numbers(text)
    return read_intrinsics(text) if numbers is None else camera(numbers)


def _pose(capture: Capture) -> np.ndarray | None:
    """A file, or x,y,z,qw,qx,qy,qz."""
    if capture.camera_pose is None:
        return None
    numbers = _numbers(capture.camera_pose)
    return read_pose(capture.camera_pose) if numbers is None else pose_of_numbers(numbers)


def _place(text: str | None, option: str, example: str) -> tuple[float, ...] | None:
    """Numbers with commas between them, as many as in the example at least."""
    if text is None:
        return None
    numbers = _numbers(text)
    if numbers is None or len(numbers) < example.count(",") + 1:
        raise GraspmatchError(f"{option} is '{text}'; numbers with commas between them are needed, as {example}.")
    return tuple(float(number) for number in numbers)


def _numbers(text: str) -> np.ndarray | None:
    """The numbers of a text such as 1,2.5,3; None if it is something else."""
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        return None
    return np.array(values) if len(values) > 1 else None


def _is_depth(path: Path, picks_object: bool) -> bool:
    """An image, or an NPZ file that has one and no cloud, or whose image is asked for by picking an object in it."""
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return True
    if path.suffix.lower() != ".npz" or not path.is_file():
        return False
    try:
        with np.load(path, allow_pickle=False) as content:
            names = set(content.files)
    except (OSError, ValueError) as error:
        raise GraspmatchError(f"{path.name} could not be read as NPZ: {error}.") from error
    return bool(names & set(DEPTH_KEYS)) and (picks_object or not names & set(CLOUD_KEYS))
