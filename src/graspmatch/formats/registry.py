"""The formats by suffix of the file."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from graspmatch.errors import GraspmatchError
from graspmatch.formats.graspnet import read_graspnet, write_graspnet
from graspmatch.formats.isaac import read_isaac, write_isaac
from graspmatch.formats.npz import read_npz, write_npz
from graspmatch.types import GraspSet, Gripper

Writer = Callable[[GraspSet, Path, Gripper], None]
Reader = Callable[[Path, Gripper | None], GraspSet]


def _read_npy(path: Path, gripper: Gripper | None) -> GraspSet:
    if gripper is None:
        raise GraspmatchError(f"{path} says nothing about the hand: give it, read_grasps(path, gripper).")
    return read_graspnet(path, gripper)


WRITERS: dict[str, Writer] = {
    ".npz": lambda grasps, path, gripper: write_npz(grasps, path),
    ".yaml": lambda grasps, path, gripper: write_isaac(grasps, gripper.base_link, path),
    ".yml": lambda grasps, path, gripper: write_isaac(grasps, gripper.base_link, path),
    ".npy": write_graspnet,
}

READERS: dict[str, Reader] = {
    ".npz": lambda path, gripper: read_npz(path),
    ".yaml": lambda path, gripper: read_isaac(path),
    ".yml": lambda path, gripper: read_isaac(path),
    ".npy": _read_npy,
}


def writer_of(path: Path) -> Writer:
    """What writes a file of this suffix."""
    if path.suffix.lower() not in WRITERS:
        raise GraspmatchError(f"Cannot write {path}: {_unknown_suffix(path, WRITERS)}")
    return WRITERS[path.suffix.lower()]


def write_grasps(grasps: GraspSet, path: Path | str, gripper: Gripper) -> None:
    """Write grasps in the format that the suffix of the file names."""
    writer_of(Path(path))(grasps, Path(path), gripper)


def read_grasps(path: Path | str, gripper: Gripper | None = None) -> GraspSet:
    """Read grasps in the format that the suffix of the file names; `.npy`, which knows no hand, needs the gripper."""
    path = Path(path)
    if path.suffix.lower() not in READERS:
        raise GraspmatchError(f"Cannot read {path}: {_unknown_suffix(path, READERS)}")
    return READERS[path.suffix.lower()](path, gripper)


def _unknown_suffix(path: Path, known: Iterable[str]) -> str:
    return f"no format of grasps has the suffix '{path.suffix}'. Known: {', '.join(known)}."
