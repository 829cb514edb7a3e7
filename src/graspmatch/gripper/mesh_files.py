"""Finding the mesh files that a description names, and giving them to MuJoCo in a format that it reads."""

from __future__ import annotations

import os
from pathlib import Path

from graspmatch.errors import GraspmatchError


def find_file(reference: str, folder: Path) -> Path | None:
    """The file that a description means: absolute, relative to `folder`, `file://`, `package://` or `model://`."""
    scheme, separator, rest = reference.partition("://")
    if not separator:
        candidates = [folder / reference]
    elif scheme == "file":
        candidates = [Path(rest)]
    else:
        package, _, inside = rest.partition("/")
        candidates = [root / inside for root in _package_folders(package, folder)]
    return next((path.resolve() for path in candidates if path.is_file()), None)


def mesh_for_mujoco(path: Path) -> tuple[str, bytes]:
    """Suffix and content of the mesh file as MuJoCo can read it [m]; what it cannot read becomes an OBJ."""
    content = path.read_bytes()
    suffix = path.suffix.lower()
    if suffix in (".obj", ".msh") or (suffix == ".stl" and _is_readable_stl(content)):
        return suffix, content
    import trimesh

    try:
        scene = trimesh.load_scene(path)
        if scene.units is not None:  # only formats that say their unit: COLLADA, glTF
            scene = scene.convert_units("meters")
        mesh = scene.to_mesh()
    except Exception as error:  # each of the many loaders behind this call has errors of its own
        raise GraspmatchError(f"Cannot read the mesh {path}: {error}") from error
    if len(mesh.faces) == 0:
        raise GraspmatchError(f"The mesh {path} has no triangles.")
    text = mesh.export(file_type="obj", include_normals=False, include_color=False, include_texture=False)
    return ".obj", str(text).encode()


def _package_folders(package: str, folder: Path) -> list[Path]:
    """Folders that may be the ROS package: near the description first, then on ROS_PACKAGE_PATH."""
    listed = [Path(entry) for entry in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if entry]
    roots = [folder.resolve(), *folder.resolve().parents, *listed]
    return [path for root in roots for path in ([root] if root.name == package else []) + [root / package]]


def _is_readable_stl(content: bytes) -> bool:
    """Binary, and within MuJoCo's limit of faces for the format."""
    count = int.from_bytes(content[80:84], "little")
    return len(content) == 84 + 50 * count and 0 < count < 200_000
