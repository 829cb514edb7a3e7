"""The native format: every field of a `GraspSet`, exactly, in NumPy's `.npz` without pickles."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import write_atomically
from graspmatch.types import GraspSet, Provenance

FORMAT = "graspmatch_grasps"
VERSION = 1

# What is not an array is kept in one JSON text.
TEXTS = ("joint_names", "preshape_names", "tally", "provenance", "advice")
ARRAYS = tuple(field.name for field in dataclasses.fields(GraspSet) if field.name not in TEXTS)
INTEGERS = ("preshape", "fingers_touching")


def write_npz(grasps: GraspSet, path: Path) -> None:
    """Write all fields of a grasp set."""
    texts = {name: getattr(grasps, name) for name in TEXTS} | {"provenance": dataclasses.asdict(grasps.provenance)}
    header = np.array(json.dumps({"format": FORMAT, "format_version": VERSION, **texts}))
    arrays = {name: getattr(grasps, name) for name in ARRAYS}

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez_compressed(file, header=header, **arrays)

    write_atomically(path, write)


def read_npz(path: Path) -> GraspSet:
    """Read what `write_npz` wrote; anything else is an error."""
    try:
        header, arrays = _contents(path)
        texts: dict[str, Any] = {
            "joint_names": tuple(header["joint_names"]),
            "preshape_names": tuple(header["preshape_names"]),
            "tally": dict(header["tally"]),
            "provenance": Provenance(**header["provenance"]),
            "advice": str(header["advice"]),
        }
        _check(arrays, len(texts["joint_names"]), len(texts["preshape_names"]))
    except OSError as error:
        raise GraspmatchError(f"Cannot read {path}: {error.strerror or error}.") from error
    except Exception as error:  # the bytes are anyone's: zip, NumPy and JSON each fail in ways of their own
        raise GraspmatchError(f"{path} is not a file of grasps written by graspmatch, or damaged: {error}.") from error
    return GraspSet(**texts, **arrays)


def _contents(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The header and the arrays of a file."""
    if not path.exists():
        raise FileNotFoundError(2, "there is no such file")
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no .npz archive")
    with np.load(path, allow_pickle=False) as file:
        header = json.loads(str(file["header"]))
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise ValueError("its header is not ours")
        if header["format_version"] != VERSION:
            raise ValueError(f"it has format version {header['format_version']}, this version reads {VERSION}")
        return header, {name: file[name] for name in ARRAYS}


def _check(arrays: dict[str, np.ndarray], joints: int, preshapes: int) -> None:
    """Do the arrays fit together?"""
    n = len(arrays["T_world_gripper"])
    rows = {
        "T_world_gripper": (4, 4),
        "T_world_pregrasp": (4, 4),
        "pregrasp_joints": (joints,),
        "grasp_joints": (joints,),
    }
    for name, array in arrays.items():
        if array.shape != (n, *rows.get(name, ())):
            raise ValueError(f"'{name}' has the shape {array.shape}, expected {(n, *rows.get(name, ()))}")
        if array.dtype.kind != ("i" if name in INTEGERS else "f"):
            raise ValueError(f"'{name}' holds {array.dtype}")
    if not np.isin(arrays["preshape"], np.arange(preshapes)).all():
        raise ValueError("a preshape has no name")
