"""The objects of a benchmark: files of a folder, or those made by code."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from graspmatch.errors import GraspmatchError
from graspmatch.scene.read import MESH_SUFFIXES, read_mesh

if TYPE_CHECKING:
    from graspmatch.simulate.rigid_body import RigidBody


@dataclass(frozen=True)
class ObjectSource:
    """Where an object comes from."""

    name: str
    mesh: Path | None
    """None: it is made by code."""

    def content_hash(self) -> str:
        """Of the files that the object is made of."""
        if self.mesh is None:
            return "made by code"
        files = [self.mesh, *sorted((self.mesh.parent / "convex").glob("*"))]
        return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()

    def load(self, *, mass: float | None = None) -> RigidBody:
        """The object as physics sees it; the first time, its convex parts are computed."""
        from graspmatch.simulate.convex import convex_parts
        from graspmatch.simulate.rigid_body import rigid_body

        if self.mesh is None:
            from graspmatch.scene.household import BULGE, OBJECTS

            made = OBJECTS[self.name]()
            return rigid_body(self.name, made.mesh, made.parts, bulge=BULGE, mass=mass)
        mesh = read_mesh(self.mesh)
        ready = self.mesh.parent / "convex"
        convex = convex_parts(mesh, folder=ready if ready.is_dir() else None)
        return rigid_body(self.name, mesh, convex.parts, bulge=convex.bulge, mass=mass)


def object_name(mesh: Path) -> str:
    """What to call the object of a mesh file: NAME/mesh.stl is NAME, NAME.stl too."""
    return mesh.absolute().parent.name if mesh.stem == "mesh" else mesh.stem


def household_sources() -> list[ObjectSource]:
    """The twelve objects made by code."""
    from graspmatch.scene.household import OBJECTS

    return [ObjectSource(name, None) for name in sorted(OBJECTS)]


def folder_sources(folder: Path) -> list[ObjectSource]:
    """Every NAME/mesh.* and every mesh file of a folder, by name."""
    if not folder.is_dir():
        raise GraspmatchError(f"No folder {folder}. Objects are given as a folder of NAME/mesh.stl, or of mesh files.")
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and path.suffix.lower() in MESH_SUFFIXES]
    inner = [path for path in sorted(folder.glob("*/mesh.*")) if path.suffix.lower() in MESH_SUFFIXES]
    sources = [ObjectSource(path.stem, path.resolve()) for path in files]
    sources += [ObjectSource(object_name(path), path.resolve()) for path in inner]
    names = [source.name for source in sources]
    if len(set(names)) < len(names):
        doubles = ", ".join(sorted({name for name in names if names.count(name) > 1}))
        raise GraspmatchError(f"{folder} has more than one object called {doubles}.")
    if not sources:
        raise GraspmatchError(
            f"{folder} has no object: expected NAME/mesh.stl, or mesh files ({MESH_SUFFIXES[0]}, ...)."
        )
    return sources
