"""The input of `plan`: one object, or a capture of a whole scene in which one is picked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from graspmatch.apps.numbers import numbers_of, read_pose_text
from graspmatch.apps.options import Capture
from graspmatch.errors import GraspmatchError
from graspmatch.scene.bag import is_bag, read_bag
from graspmatch.scene.camera import Camera, camera
from graspmatch.scene.camera_file import read_intrinsics
from graspmatch.scene.depth_file import DEPTH_KEYS
from graspmatch.scene.every import scenes_of_depth, scenes_of_view
from graspmatch.scene.read import CLOUD_KEYS
from graspmatch.scene.scene import METRES, Scene, Unit
from graspmatch.scene.view import View, view_of_cloud

Table = float | Literal["auto"] | None

IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".exr", ".pgm")


def read_scene(path: Path | None, capture: Capture, *, table: Table, unit: Unit, obstacles: Path | None) -> Scene:
    """The scene of a mesh, of the cloud of an object, or of an object in a depth image, cloud or bag of a scene."""
    picks_object = capture.object is not None or capture.at is not None or capture.mask is not None
    depth = _depth_of(path, capture, picks_object)
    if depth is None and path is not None and not is_bag(path):
        if capture == Capture():
            return Scene.read(path, table=table, unit=unit, obstacles=obstacles)
        if not picks_object:
            raise GraspmatchError(
                f"{path.name} is read as one object. To pick one in the cloud of a whole scene, say which: --object 0, "
                "--at or --mask."
            )
    source = _source(path, depth, capture, unit, obstacles)
    place = _place(capture.at, "--at", "320,240")
    shared = source.options(capture, table)
    if source.depth is not None:
        scene = Scene.from_depth(source.depth, source.camera, object=capture.object, at=place, **shared)
    else:
        assert source.cloud is not None
        scene = Scene.from_view(source.cloud, object=capture.object, at=place, **shared)
    return source.named(scene)


def read_scenes(
    path: Path | None, capture: Capture, *, table: Table, unit: Unit, obstacles: Path | None
) -> dict[int, Scene]:
    """Every object of a depth image, cloud or bag of a scene, by its number."""
    if capture.object is not None or capture.at is not None:
        raise GraspmatchError("--all plans for every object: leave out --object and --at, or --all.")
    source = _source(path, _depth_of(path, capture, picks_object=True), capture, unit, obstacles)
    shared = source.options(capture, table)
    if source.depth is not None:
        scenes = scenes_of_depth(source.depth, source.camera, **shared)
    else:
        assert source.cloud is not None
        scenes = scenes_of_view(source.cloud, **shared)
    return {number: source.named(scene) for number, scene in scenes.items()}


@dataclass(frozen=True)
class _Source:
    """A depth image and its camera, or a cloud; `bag` is the file that it was in."""

    unit: Unit
    depth: Path | np.ndarray | None = None
    camera: Camera | None = None
    cloud: Path | View | None = None
    bag: str = ""
    note: str = ""

    def options(self, capture: Capture, table: Table) -> dict[str, Any]:
        """What the library takes besides which object it is."""
        options: dict[str, Any] = {"mask": capture.mask, "table": table, "complete": capture.complete}
        options["up"] = _place(capture.up, "--up", "0,-1,0")
        if self.depth is None:
            return options | {"unit": self.unit, "T_world_cloud": _pose(capture)}
        scale = METRES[self.unit] if capture.depth_scale is None and self.unit != "auto" else capture.depth_scale
        return options | {"metres_per_unit": scale, "correct": capture.correct_depth}

    def named(self, scene: Scene) -> Scene:
        """The scene, with the name of the bag that it is from."""
        return replace(scene, source=self.bag, notes=(self.note, *scene.notes)) if self.bag else scene


def _source(path: Path | None, depth: Path | None, capture: Capture, unit: Unit, obstacles: Path | None) -> _Source:
    """Where a capture is, and of which camera."""
    if obstacles is not None:
        raise GraspmatchError("Obstacles of a capture come from the capture: leave out --obstacles.")
    if depth is not None:
        return _Source(unit, depth, _camera(depth, capture))
    assert path is not None
    if not is_bag(path):
        return _Source(unit, cloud=path)
    frame = read_bag(path, topic=capture.topic)
    bag, note = path.name, f"{frame.topic} of {path.name} was read."
    if frame.depth is not None:
        return _Source(unit, frame.depth, _camera(frame.depth, capture, frame.camera), bag=bag, note=note)
    assert frame.cloud is not None
    view = view_of_cloud(frame.cloud, scale=METRES[unit], T_world_cloud=_pose(capture), source=bag)
    return _Source(unit, cloud=view, bag=bag, note=note)


def _depth_of(path: Path | None, capture: Capture, picks_object: bool) -> Path | None:
    """The depth image, if the capture is one."""
    if path is None and capture.depth is None:
        raise GraspmatchError("Nothing to grasp is given: name a mesh or a cloud, or a depth image (--depth).")
    if path is not None and capture.depth is not None:
        raise GraspmatchError(f"Both {path} and the depth image {capture.depth} are given; one of them is enough.")
    return capture.depth or (path if path is not None and _is_depth(path, picks_object) else None)


def _camera(depth: Path | np.ndarray, capture: Capture, known: Camera | None = None) -> Camera | None:
    """The intrinsics that are given, or else known, at the pose that is given."""
    of = known if capture.intrinsics is None else _intrinsics(capture.intrinsics)
    if of is None and isinstance(depth, Path) and depth.suffix.lower() == ".npz":
        of = read_intrinsics(depth)
    pose = _pose(capture)
    return of if of is None or pose is None else of.placed(pose)


def _intrinsics(text: str) -> Camera:
    """A file, or fx,fy,cx,cy."""
    numbers = numbers_of(text)
    return read_intrinsics(text) if numbers is None else camera(numbers)


def _pose(capture: Capture) -> np.ndarray | None:
    """A file, or x,y,z,qw,qx,qy,qz."""
    return None if capture.camera_pose is None else read_pose_text(capture.camera_pose)


def _place(text: str | None, option: str, example: str) -> tuple[float, ...] | None:
    """Numbers with commas between them, as many as in the example at least."""
    if text is None:
        return None
    numbers = numbers_of(text)
    if numbers is None or len(numbers) < example.count(",") + 1:
        raise GraspmatchError(f"{option} is '{text}'; numbers with commas between them are needed, as {example}.")
    return tuple(float(number) for number in numbers)


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
