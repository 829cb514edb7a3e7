"""ACRONYM's grasp files in HDF5: transforms of the hand's base in the frame of the scaled mesh, and physics' verdicts.

What the format has and a plan does not know, of the object's mass to its motion in the hand, is NaN.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graspmatch.errors import GraspmatchError
from graspmatch.formats.canonical import Block, canonical_grasps, canonical_poses, in_gripper
from graspmatch.formats.files import MOST_BYTES, check_readable, disguise, one_line, write_atomically
from graspmatch.formats.native import ARRAYS, arrays_of, texts_of
from graspmatch.types import GraspSet, Gripper

if TYPE_CHECKING:
    import h5py

PANDA = {"franka_hand": "panda"}
"""How the data set calls hands that we know under other names."""
OWN = "graspmatch"
UNKNOWN_MOTIONS = tuple(
    f"object_motion_during_{phase}_{kind}" for phase in ("closing", "shaking") for kind in ("linear", "angular")
)
UNKNOWN_OF_OBJECT = {"com": (3,), "inertia": (3, 3), "mass": (), "volume": (), "density": (), "friction": ()}
"""What the format says of the object and we do not, with its shape."""


def check_library(path: Path) -> None:
    """Refuse .h5 where the library for it is not installed."""
    try:
        import h5py  # noqa: F401
    except ImportError as error:
        raise GraspmatchError(f"{path} needs h5py: pip install h5py, or graspmatch[formats].") from error


def write_acronym(grasps: GraspSet, path: Path, gripper: Gripper) -> None:
    """Write transforms and predicted verdicts; our other fields go into the group `graspmatch`."""
    check_library(path)
    import h5py

    held = in_gripper(grasps, path)

    def write(temporary: Path) -> None:
        with h5py.File(temporary, "w") as file:
            file["grasps/transforms"] = canonical_poses(grasps, gripper)
            file["grasps/qualities/flex/object_in_gripper"] = held
            for name in UNKNOWN_MOTIONS:
                file[f"grasps/qualities/flex/{name}"] = np.full(len(grasps), np.nan)
            file["gripper/type"] = PANDA.get(gripper.name, gripper.name)
            file["gripper/configuration"] = gripper.open_joints
            file["object/file"] = grasps.provenance.source
            file["object/scale"] = 1.0
            for name, shape in UNKNOWN_OF_OBJECT.items():
                file[f"object/{name}"] = np.full(shape, np.nan)
            texts = {**texts_of(grasps), "T_gripper_canonical": gripper.T_gripper_canonical.tolist()}
            file[f"{OWN}/texts"] = json.dumps(texts)
            for name, array in arrays_of(grasps).items():
                file[f"{OWN}/{name}"] = array

    write_atomically(path, write)


def read_acronym(path: Path, gripper: Gripper | None = None) -> GraspSet:
    """Read a file of this or of another tool, best first; one of another tool needs the gripper."""
    check_library(path)
    check_readable(path)
    import h5py

    try:
        with h5py.File(path, "r") as file:
            transforms = _numbers(file, "grasps/transforms")
            held = _numbers(file, "grasps/qualities/flex/object_in_gripper")
            hand = _text(file, "gripper/type") if "gripper/type" in file else ""
            block = _block(file) if OWN in file else None
        known = {theirs: ours for ours, theirs in PANDA.items()}
        return canonical_grasps(transforms, held, block, path, gripper, hand=known.get(hand, hand)[:200])
    except GraspmatchError:
        raise
    except Exception as error:  # the bytes are anyone's, and HDF5 fails on them in ways of its own
        raise GraspmatchError(
            f"{path} is not a grasp file of ACRONYM in HDF5: {one_line(error)}{disguise(path)}."
        ) from error


def _block(file: h5py.File) -> Block:
    """Our group of a file."""
    texts: dict[str, Any] = json.loads(_text(file, f"{OWN}/texts"))
    return texts, {name: _numbers(file, f"{OWN}/{name}") for name in ARRAYS}


def _numbers(file: h5py.File, name: str) -> np.ndarray:
    """The numbers of a dataset."""
    dataset = _dataset(file, name)
    if dataset.dtype.kind not in "fiub":
        raise ValueError(f"'{name}' holds {dataset.dtype}, expected numbers")
    return dataset[()]


def _text(file: h5py.File, name: str) -> str:
    """The text of a dataset, which reads as bytes."""
    content = _dataset(file, name)[()]
    if not isinstance(content, bytes):
        raise ValueError(f"'{name}' is no text")
    return content.decode()


def _dataset(file: h5py.File, name: str) -> h5py.Dataset:
    """A dataset that is in this file, and not larger than grasps are."""
    import h5py

    way = name.split("/")
    for depth in range(1, len(way) + 1):
        part = "/".join(way[:depth])
        link = file.get(part, getlink=True)
        if link is None:
            raise ValueError(f"there is no '{name}'")
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"'{part}' is a link to another place, which is not followed")
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual:
        raise ValueError(f"'{name}' holds no data of its own")
    if dataset.shape is None or dataset.nbytes > MOST_BYTES:
        raise ValueError(f"'{name}' is empty, or larger than {MOST_BYTES / 2**20:.0f} MiB")
    return dataset
