"""Files of objects -> arrays, by suffix. Nothing is scaled, cleaned or turned here: the arrays are the file's own."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from graspmatch.geometry.mesh import TriangleMesh, concatenate
from graspmatch.scene.pcd import read_pcd
from graspmatch.types import GraspmatchError

Array = np.ndarray

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".glb", ".gltf", ".off", ".dae")
"""Of these, .ply and .obj may hold a cloud instead."""
CLOUD_SUFFIXES = (".pcd", ".xyz", ".txt", ".npy", ".npz")
CLOUD_KEYS = ("points", "xyz", "pts", "object_points")
"""The names under which an .npz file may keep its cloud."""


@dataclass(frozen=True)
class CloudFile:
    """A point cloud as its file has it, in the file's unit and frame: of any shape and type, which others check."""

    points: Array
    normals: Array | None = None
    obstacles: Array | None = None
    sensor_origin: Float[Array, "3"] | None = None
    shape: tuple[int, int] | None = None
    """Rows and columns of an organised cloud, whose points are row by row."""


def read_object(path: str | os.PathLike[str]) -> TriangleMesh | CloudFile:
    """Whatever the file holds: a mesh, or a cloud where it has no faces."""
    path = existing_file(path)
    suffix = path.suffix.lower()
    if suffix in MESH_SUFFIXES:
        return _read_with_trimesh(path)
    if suffix == ".pcd":
        return _read_pcd_cloud(path)
    if suffix == ".npz":
        return _read_npz(path)
    if suffix == ".npy":
        return _from_columns(_load_numpy(path)["array"], path)
    if suffix in (".xyz", ".txt"):
        return _from_columns(_load_text(path), path)
    known = ", ".join(MESH_SUFFIXES + CLOUD_SUFFIXES)
    raise GraspmatchError(f"{path.name}: unknown kind of file {suffix or '(no suffix)'!r}. Known: {known}.")


def read_mesh(path: str | os.PathLike[str]) -> TriangleMesh:
    """The mesh of a file that must hold one; the parts of a scene in one soup, where the file puts them."""
    content = read_object(path)
    if isinstance(content, CloudFile):
        raise GraspmatchError(f"{Path(path).name} holds points but no faces: read it as a cloud (Scene.from_cloud).")
    return content


def read_cloud(path: str | os.PathLike[str]) -> CloudFile:
    """The cloud of a file that must hold one."""
    content = read_object(path)
    if isinstance(content, TriangleMesh):
        raise GraspmatchError(f"{Path(path).name} holds a mesh, not a cloud: read it as a mesh (Scene.from_mesh).")
    return content


def existing_file(path: str | os.PathLike[str]) -> Path:
    """The path, once it is known to be a file."""
    path = Path(path)
    if path.is_dir():
        raise GraspmatchError(f"{path} is a directory: name one file in it.")
    if not path.is_file():
        raise GraspmatchError(f"No such file: {path}.")
    return path


def triangles(loaded: Any) -> TriangleMesh:
    """The triangles of a trimesh object; those of a trimesh scene in one soup, each part where the scene has it."""
    parts = loaded.dump() if hasattr(loaded, "dump") else [loaded]
    meshes = [
        TriangleMesh(np.array(part.vertices, dtype=np.float64), np.array(part.faces, dtype=np.int64))
        for part in parts
        if len(getattr(part, "faces", ())) > 0
    ]
    return concatenate(meshes)


def _read_with_trimesh(path: Path) -> TriangleMesh | CloudFile:
    import trimesh

    try:
        loaded = trimesh.load(str(path), process=False)
    except Exception as error:  # its loaders raise whatever their parsers do; each means the same to the user
        reason = " ".join(str(error).split()) or type(error).__name__
        raise GraspmatchError(f"{path.name} could not be read as {path.suffix[1:].upper()}: {reason}.") from error
    if isinstance(loaded, trimesh.PointCloud):
        return CloudFile(np.array(loaded.vertices, dtype=np.float64), _ply_normals(loaded.metadata))
    mesh = triangles(loaded)
    if len(mesh.faces) == 0:
        raise GraspmatchError(f"{path.name} holds no faces and no points: it is empty or damaged.")
    return mesh


def _ply_normals(metadata: dict) -> Float[Array, "n 3"] | None:
    """Vertex normals of a PLY cloud: trimesh keeps them only among the raw columns."""
    columns = metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = getattr(getattr(columns, "dtype", None), "names", None) or (columns if isinstance(columns, dict) else ())
    if columns is None or not {"nx", "ny", "nz"} <= set(names):
        return None
    return np.stack([np.asarray(columns[name], dtype=np.float64).ravel() for name in ("nx", "ny", "nz")], axis=-1)


def _read_pcd_cloud(path: Path) -> CloudFile:
    """The position of the sensor is believed where the cloud is organised or the position is not the default."""
    pcd = read_pcd(path)
    known = pcd.viewpoint is not None and (pcd.height > 1 or bool(pcd.viewpoint.any()))
    shape = (pcd.height, pcd.width) if pcd.height > 1 else None
    return CloudFile(pcd.points, pcd.normals, sensor_origin=pcd.viewpoint if known else None, shape=shape)


def _read_npz(path: Path) -> CloudFile:
    """`points` (or `xyz`, `pts`, `object_points`), and optionally `normals` and `obstacles`.

    A file that also has the `depth` image and the camera matrix `K` is a capture: its camera is at the origin.
    """
    arrays = _load_numpy(path)
    candidates = [key for key in CLOUD_KEYS if key in arrays]
    if len(candidates) != 1:
        found = f"several clouds ({', '.join(candidates)})" if candidates else f"no cloud among {', '.join(arrays)}"
        raise GraspmatchError(f"{path.name} has {found}; exactly one of these keys is needed: {', '.join(CLOUD_KEYS)}.")
    capture = "depth" in arrays and "K" in arrays
    return CloudFile(
        arrays[candidates[0]], arrays.get("normals"), arrays.get("obstacles"), np.zeros(3) if capture else None
    )


def _load_numpy(path: Path) -> dict[str, Array]:
    """All arrays of an .npz file, or that of an .npy file as `array`; never a pickle."""
    try:
        content = np.load(path, allow_pickle=False)
        return {"array": content} if isinstance(content, np.ndarray) else {key: content[key] for key in content.files}
    except Exception as error:  # damaged archives raise errors of zipfile, zlib and numpy's own parser
        raise GraspmatchError(f"{path.name} could not be read as {path.suffix[1:].upper()}: {error}.") from error


def _load_text(path: Path) -> Float[Array, "n c"]:
    """Numbers in columns, separated by blanks, commas or semicolons; `#` and `//` begin comments."""
    text = path.read_text(encoding="utf-8", errors="replace").replace(",", " ").replace(";", " ")
    if not text.strip():
        raise GraspmatchError(f"{path.name} is empty: one point per line is needed, x y z.")
    try:
        return np.loadtxt(text.splitlines(), dtype=np.float64, comments=("#", "//"), ndmin=2)
    except ValueError as error:
        raise GraspmatchError(f"{path.name} is not columns of numbers: {error}.") from error


def _from_columns(table: Shaped[Array, "..."], path: Path) -> CloudFile:
    """x y z in the first three columns; the next three are normals if they are unit vectors, else colours."""
    if table.ndim != 2 or table.shape[1] < 3:
        raise GraspmatchError(f"{path.name} has shape {table.shape}: a cloud is (n, 3), or (n, 6) with normals.")
    if table.shape[1] < 6:
        return CloudFile(table[:, :3])
    lengths = np.linalg.norm(np.nan_to_num(table[:, 3:6].astype(np.float64)), axis=1)
    are_normals = len(lengths) > 0 and np.mean(np.abs(lengths - 1) < 0.01) > 0.5
    return CloudFile(table[:, :3], table[:, 3:6] if are_normals else None)
