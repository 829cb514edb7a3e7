"""The formats by suffix of the file."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from graspmatch.errors import GraspmatchError
from graspmatch.formats.isaac import read_isaac, write_isaac
from graspmatch.formats.npz import read_npz, write_npz
from graspmatch.types import GraspSet, Gripper

Writer = Callable[[GraspSet, Path, Gripper], None]

WRITERS: dict[str, Writer] = {
    ".npz": lambda grasps, path, gripper: write_npz(grasps, path),
    ".yaml": lambda grasps, path, gripper: write_isaac(grasps, gripper.base_link, path),
    ".yml": lambda grasps, path, gripper: write_isaac(grasps, gripper.base_link, path),
}

READERS: dict[str, Callable[[Path], GraspSet]] = {".npz": read_npz, ".yaml": read_isaac, ".yml": read_isaac}


def writer_of(path: Path) -> Writer:
    """What writes a file of this suffix."""
    if path.suffix.lower() not in WRITERS:
        raise GraspmatchError(f"Cannot write {path}: {_unknown_suffix(path, WRITERS)}")
    return WRITERS[path.suffix.lower()]


def write_grasps(grasps: GraspSet, path: Path | str, gripper: Gripper) -> None:
    """Write grasps in the format that the suffix of the file names."""
    writer_of(Path(path))(grasps, Path(path), gripper)


def read_grasps(path: Path | str) -> GraspSet:
    """Read grasps in the format that the suffix of the file names."""
    path = Path(path)
    if path.suffix.lower() not in READERS:
        raise GraspmatchError(f"Cannot read {path}: {_unknown_suffix(path, READERS)}")
    return READERS[path.suffix.lower()](path)


def _unknown_suffix(path: Path, known: Iterable[str]) -> str:
    return f"no format of grasps has the suffix '{path.suffix}'. Known: {', '.join(known)}."
