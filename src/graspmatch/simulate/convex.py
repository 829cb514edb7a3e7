"""The convex parts of a mesh, which physics can handle, and how faithful they are; made once, cached by content."""

from __future__ import annotations

import hashlib
from dataclasses import astuple, dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.gripper.cache import read_cached, write_cached
from graspmatch.scene.read import read_mesh
from graspmatch.scene.surface import clean_mesh
from graspmatch.simulate.decompose import convex_hull, decompose, recipe
from graspmatch.simulate.fidelity import Fidelity, fidelity
from graspmatch.simulate.mend import closed_bodies
from graspmatch.types import GraspmatchError

Array = np.ndarray

CONVEX_VERSION = 1
"""Raised whenever the same mesh gives other parts or other figures."""


@dataclass(frozen=True)
class ConvexParts:
    """An object as convex parts, in the frame of its mesh."""

    parts: tuple[TriangleMesh, ...]
    """Each convex, closed, faces outward."""
    fidelity: Fidelity

    @property
    def bulge(self) -> float:
        """How far the parts reach beyond the mesh [m], at 95 % of their exposed surface."""
        return self.fidelity.bulge


def convex_parts(mesh: TriangleMesh, *, folder: Path | None = None) -> ConvexParts:
    """The parts that the STL files of a folder hold, else those found by decomposing the mesh.

    The first call for a mesh takes up to a minute, later ones read the cache. Raises `GraspmatchError` for a mesh
    without faces or volume, and for a folder that holds no readable parts.
    """
    mesh, _, _ = clean_mesh(mesh, "the mesh")
    given = None if folder is None else read_parts(folder)
    key = _cache_key(mesh, given)
    cached = read_cached(key, _unpack)
    if cached is not None:
        return cached
    bodies, is_open = closed_bodies(mesh)
    parts = decompose(bodies) if given is None else given
    result = ConvexParts(parts, fidelity(mesh, parts, is_open=is_open))
    write_cached(key, _pack(result))
    return result


def read_parts(folder: Path) -> tuple[TriangleMesh, ...]:
    """The hulls of the STL files of a folder, in the order of their names."""
    files = sorted(path for path in folder.glob("*") if path.suffix.lower() == ".stl")
    if not files:
        found = "holds no STL file" if folder.is_dir() else "is no folder"
        raise GraspmatchError(f"{folder} {found}: convex parts are read from a folder of STL files, one part each.")
    hulls = [convex_hull(read_mesh(path).vertices) for path in files]
    flat = [path.name for path, hull in zip(files, hulls, strict=True) if hull is None]
    if flat:
        raise GraspmatchError(f"{', '.join(flat)} in {folder} enclose no volume: a convex part is a solid.")
    return tuple(hull for hull in hulls if hull is not None)


def _cache_key(mesh: TriangleMesh, given: tuple[TriangleMesh, ...] | None) -> str:
    """Content of the mesh and of the given parts, or of all that decides how parts are found."""
    digest = hashlib.sha256()
    for part in (mesh, *(given or ())):
        digest.update(f"{len(part.vertices)} {len(part.faces)};".encode())
        digest.update(np.ascontiguousarray(part.vertices, dtype=np.float64).data)
        digest.update(np.ascontiguousarray(part.faces, dtype=np.int64).data)
    digest.update(f"{CONVEX_VERSION} {version('graspmatch')} {recipe()}".encode())
    return f"convex-{digest.hexdigest()[:20]}"


def _unpack(arrays: dict[str, Array]) -> ConvexParts:
    vertices = np.split(arrays["vertices"], np.cumsum(arrays["vertex_counts"])[:-1])
    faces = np.split(arrays["faces"], np.cumsum(arrays["face_counts"])[:-1])
    parts = tuple(TriangleMesh(v, f) for v, f in zip(vertices, faces, strict=True))
    return ConvexParts(parts, Fidelity(*arrays["fidelity"].tolist()))


def _pack(convex: ConvexParts) -> dict[str, Array]:
    return {
        "vertices": np.concatenate([part.vertices for part in convex.parts]),
        "faces": np.concatenate([part.faces for part in convex.parts]),
        "vertex_counts": np.array([len(part.vertices) for part in convex.parts]),
        "face_counts": np.array([len(part.faces) for part in convex.parts]),
        "fidelity": np.array(astuple(convex.fidelity)),
    }
