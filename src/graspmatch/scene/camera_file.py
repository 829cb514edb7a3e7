"""Files of cameras: intrinsics as ROS, RealSense, Open3D or NumPy write them, and poses."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.se3 import from_parts, matrix_from_quaternion
from graspmatch.scene.camera import Camera, camera, checked_pose
from graspmatch.scene.read import existing_file
from graspmatch.types import GraspmatchError

Array = np.ndarray

MATRIX_KEYS = ("camera_matrix", "K", "k", "intrinsics", "intrinsic_matrix", "cam_K", "depth_intrinsics")
LENS_KEYS = ("distortion_coefficients", "D", "d", "coeffs", "distortion")
MODEL_KEYS = ("distortion_model", "model")
SIZE_KEYS = (("image_width", "image_height"), ("width", "height"))
POSE_KEYS = ("T_world_camera", "camera_pose", "pose", "transform", "T", "matrix")
LENS_MODELS = ("", "none", "plumb_bob", "rational_polynomial", "brown_conrady", "inverse_brown_conrady")
NOTATIONS = "a camera_info YAML or JSON, an .npy, .npz or .txt of the 3x3 matrix"


def read_intrinsics(path: str | os.PathLike[str]) -> Camera:
    """The camera of a file: ROS camera_info (YAML or JSON), fx fy cx cy, or a 3x3 matrix (NPY, NPZ, TXT)."""
    content = _load(existing_file(path))
    name = Path(path).name
    if not isinstance(content, Mapping):
        return camera(_array(content, name))
    return camera_of(content, name)


def camera_of(content: Mapping[str, Any], name: str) -> Camera:
    """The camera of a record such as a camera_info message."""
    content = _inner(content, ("camera_info", "depth", "depth_camera"), (*MATRIX_KEYS, "fx"))
    lens = _first(content, LENS_KEYS)
    model = str(_first(content, MODEL_KEYS) or "").lower().split(".")[-1].replace(" ", "_")
    coefficients = np.zeros(0) if lens is None else np.asarray(_data(lens), dtype=np.float64)
    if model not in LENS_MODELS and coefficients.any():
        raise GraspmatchError(f"{name}: unknown lens '{model}'. Known: plumb_bob, rational_polynomial.")
    if model == "inverse_brown_conrady" and coefficients.any():
        raise GraspmatchError(
            f"{name}: its lens model is inverse_brown_conrady with coefficients that are not zero; undo it first."
        )
    size = next(
        (tuple(int(content[key]) for key in keys) for keys in SIZE_KEYS if all(k in content for k in keys)), None
    )
    return camera(
        _matrix(content, name), distortion=coefficients, size=(size[0], size[1]) if size and min(size) > 0 else None
    )


def read_pose(path: str | os.PathLike[str]) -> Float[Array, "4 4"]:
    """A pose such as `T_world_camera`: a file of a 4x4 matrix (NPY, NPZ, TXT, YAML, JSON), or of a ROS pose."""
    content = _load(existing_file(path))
    name = Path(path).name
    if not isinstance(content, Mapping):
        return pose_of_numbers(_array(content, name))
    matrix = _first(content, POSE_KEYS)
    if matrix is not None and not isinstance(matrix, Mapping):
        return pose_of_numbers(_array(matrix, name))
    content = _inner(content, (*POSE_KEYS, "pose"), ("position", "translation"))
    position, orientation = _first(content, ("position", "translation")), _first(content, ("orientation", "rotation"))
    if position is None or orientation is None:
        known = "a 4x4 matrix under T_world_camera, or position and orientation"
        raise GraspmatchError(f"{name} has no pose among {', '.join(map(str, content))}. Possible: {known}.")
    xyz = [position[axis] for axis in "xyz"] if isinstance(position, Mapping) else position
    if not isinstance(orientation, Mapping):
        raise GraspmatchError(f"{name}: the orientation needs its names w, x, y, z, since both orders are in use.")
    return pose_of_numbers(np.array([*xyz, *(orientation[axis] for axis in "wxyz")], dtype=np.float64))


def pose_of_numbers(values: Array) -> Float[Array, "4 4"]:
    """A pose of 16 or 12 numbers row by row, or of x y z [m] and the quaternion w x y z."""
    if values.size in (12, 16):
        return checked_pose(
            np.vstack([values.reshape(-1, 4)[:3], [0, 0, 0, 1]]) if values.size == 12 else values.reshape(4, 4)
        )
    if values.size != 7 or not np.isfinite(values).all() or abs(np.linalg.norm(values.ravel()[3:]) - 1) > 0.01:
        raise GraspmatchError("A pose must be a 4x4 matrix, or x y z and a unit quaternion w x y z.")
    position, quaternion = values.ravel()[:3], values.ravel()[3:] / np.linalg.norm(values.ravel()[3:])
    return from_parts(matrix_from_quaternion(quaternion), position)


def _load(path: Path) -> object:
    """What the file holds, as arrays, numbers, lists and dictionaries."""
    suffix = path.suffix.lower()
    try:
        if suffix in (".npy", ".npz"):
            content = np.load(path, allow_pickle=False)
            return content if isinstance(content, np.ndarray) else {key: content[key] for key in content.files}
        text = path.read_text(encoding="utf-8")
        if suffix == ".json":
            return json.loads(text)
        if suffix in (".yaml", ".yml"):
            import yaml

            # OpenCV's own files begin with a directive that YAML does not know, and tag their matrices.
            text = text.replace("%YAML:1.0", "").replace("!!opencv-matrix", "")
            return next((document for document in yaml.safe_load_all(text) if document is not None), {})
        if suffix in (".txt", ".csv", ".k"):
            return np.loadtxt(text.replace(",", " ").splitlines(), ndmin=1)
    except Exception as error:  # each parser has errors of its own; all mean the same to the user
        raise GraspmatchError(
            f"{path.name} could not be read as {suffix[1:].upper()}: {' '.join(str(error).split())}."
        ) from error
    raise GraspmatchError(f"{path.name}: unknown kind of camera file '{suffix}'. Possible: {NOTATIONS}.")


def _matrix(content: Mapping[str, Any], name: str) -> Array:
    """The numbers of the camera matrix, or fx, fy, cx, cy."""
    if {"fx", "fy"} <= set(content):
        centre = [_first(content, keys) for keys in (("cx", "ppx"), ("cy", "ppy"))]
        if None not in centre:
            return _array([content["fx"], content["fy"], *centre], name)
    found = _first(content, MATRIX_KEYS)
    if found is None:
        keys = ", ".join(str(key) for key in content)
        raise GraspmatchError(
            f"{name} has no intrinsics among {keys}. Possible: fx, fy, cx, cy, or a matrix K or camera_matrix."
        )
    if isinstance(found, Mapping) and "data" not in found:
        return _matrix(found, name)
    values = _array(_data(found), name)
    by_columns = values.size == 9 and values.ndim == 1 and values[2] == 0 and values[6] > 1
    return values.reshape(3, 3).T if by_columns else values  # Open3D writes its matrix column by column


def _inner(content: Mapping[str, Any], names: tuple[str, ...], wanted: tuple[str, ...]) -> Mapping[str, Any]:
    """The record inside the record that has what is wanted, or the record itself."""
    while not any(key in content for key in wanted):
        inside = next((content[name] for name in names if isinstance(content.get(name), Mapping)), None)
        if inside is None:
            return content
        content = inside
    return content


def _first(content: Mapping[str, Any], keys: tuple[str, ...]) -> Any:
    return next((content[key] for key in keys if key in content), None)


def _data(value: Any) -> Any:
    """The numbers of a matrix that is written with its rows and columns."""
    return value["data"] if isinstance(value, Mapping) and "data" in value else value


def _array(value: Any, name: str) -> Array:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise GraspmatchError(f"{name} holds no numbers where a matrix is needed.") from error
