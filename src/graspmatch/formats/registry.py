"""The formats by suffix of the file."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from graspmatch.errors import GraspmatchError
from graspmatch.formats.acronym import check_library, read_acronym, write_acronym
from graspmatch.formats.graspgen import read_graspgen, write_graspgen
from graspmatch.formats.graspnet import read_graspnet, write_graspnet
from graspmatch.formats.isaac import is_isaac, isaac_grasps, write_isaac
from graspmatch.formats.moveit import is_moveit, moveit_grasps, write_moveit
from graspmatch.formats.npz import read_npz, write_npz
from graspmatch.formats.yaml_files import read_yaml
from graspmatch.geometry import se3
from graspmatch.types import GraspSet, Gripper

Writer = Callable[[GraspSet, Path, Gripper], None]
Reader = Callable[[Path, Gripper | None], GraspSet]


def _read_npy(path: Path, gripper: Gripper | None) -> GraspSet:
    if gripper is None:
        raise GraspmatchError(f"{path} says nothing about the hand: give it, read_grasps(path, gripper).")
    return read_graspnet(path, gripper)


def _read_yaml(path: Path, gripper: Gripper | None, T_file_gripper: Float[np.ndarray, "4 4"] | None = None) -> GraspSet:
    """YAML says itself what it holds."""
    documents = read_yaml(path)
    if len(documents) == 1 and is_isaac(documents[0]):
        return isaac_grasps(documents[0], path, gripper, T_file_gripper)
    if is_moveit(documents):
        return moveit_grasps(documents, path, gripper, T_file_gripper)
    raise GraspmatchError(
        f"{path} holds no grasps: neither 'format: isaac_grasp' nor messages of type moveit_msgs/Grasp with a "
        "'grasp_pose'."
    )


def _write_isaac(grasps: GraspSet, path: Path, gripper: Gripper) -> None:
    write_isaac(grasps, gripper.base_link, path)


WRITERS: dict[str, Writer] = {
    ".npz": lambda grasps, path, gripper: write_npz(grasps, path),
    ".yaml": _write_isaac,
    ".yml": _write_isaac,
    ".moveit.yaml": write_moveit,
    ".moveit.yml": write_moveit,
    ".npy": write_graspnet,
    ".h5": write_acronym,
    ".json": write_graspgen,
}

READERS: dict[str, Reader] = {
    ".npz": lambda path, gripper: read_npz(path),
    ".yaml": _read_yaml,
    ".yml": _read_yaml,
    ".moveit.yaml": _read_yaml,
    ".moveit.yml": _read_yaml,
    ".npy": _read_npy,
    ".h5": read_acronym,
    ".json": read_graspgen,
}

NO_FRAME = (".yaml", ".yml", ".moveit.yaml", ".moveit.yml")
"""Formats that leave open which frame of the hand a pose is of."""
NO_HAND = (".npy", ".h5", ".json")
"""Formats that another tool's file can be read in only where the hand is given."""


def suffix_of(path: Path) -> str:
    """What tells the format: the last suffix, or the last two where they are one."""
    name = path.name.lower()
    return next((suffix for suffix in (".moveit.yaml", ".moveit.yml") if name.endswith(suffix)), path.suffix.lower())


def writer_of(path: Path) -> Writer:
    """What writes a file of this suffix."""
    suffix = suffix_of(path)
    if suffix not in WRITERS:
        raise GraspmatchError(f"Cannot write {path}: {_unknown_suffix(path, WRITERS)}")
    if suffix == ".h5":
        check_library(path)
    return WRITERS[suffix]


def write_grasps(grasps: GraspSet, path: Path | str, gripper: Gripper | None = None) -> None:
    """Write grasps in the format that the suffix of the file names; all but .npz need the gripper."""
    path = Path(path)
    write = writer_of(path)
    if suffix_of(path) == ".npz":
        return write_npz(grasps, path)
    if gripper is None:
        raise GraspmatchError(f"Cannot write {path} without the hand: give it, write_grasps(grasps, path, gripper).")
    return write(grasps, path, gripper)


def read_grasps(
    path: Path | str, gripper: Gripper | None = None, *, frame: Literal["base", "canonical"] = "base"
) -> GraspSet:
    """Read grasps, best first, in the format that the suffix of the file names.

    Files of other tools in .npy, .h5 and .json know no hand and need the gripper. YAML of other tools does without, but
    then says neither where the approach begins nor in which preshape to arrive. `frame` is for such YAML, which leaves
    it open: its poses are of the base link, or of the canonical frame (+z approach, +x closing), as GraspGen's are.
    """
    path = Path(path)
    suffix = suffix_of(path)
    if suffix not in READERS:
        raise GraspmatchError(f"Cannot read {path}: {_unknown_suffix(path, READERS)}")
    if frame == "base":
        return READERS[suffix](path, gripper)
    if suffix not in NO_FRAME or gripper is None:
        raise GraspmatchError(
            f"The frame of the poses in {path} can be chosen for YAML of other tools only, and with the gripper given."
        )
    return _read_yaml(path, gripper, se3.inverse(gripper.T_gripper_canonical))


def _unknown_suffix(path: Path, known: Iterable[str]) -> str:
    return f"no format of grasps has the suffix '{path.suffix}'. Known: {', '.join(known)}."
