"""The native format: every field of a `GraspSet`, exactly, in NumPy's `.npz` without pickles."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import MOST_BYTES, check_readable, disguise, one_line, write_atomically
from graspmatch.formats.native import ARRAYS, arrays_of, grasp_set, texts_of
from graspmatch.types import GraspSet

FORMAT = "graspmatch_grasps"
VERSION = 1


def write_npz(grasps: GraspSet, path: Path) -> None:
    """Write all fields of a grasp set."""
    header = np.array(json.dumps({"format": FORMAT, "format_version": VERSION, **texts_of(grasps)}))
    contents: dict[str, Any] = {"header": header, **arrays_of(grasps)}

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **contents)

    write_atomically(path, write)


def read_npz(path: Path) -> GraspSet:
    """Read what `write_npz` wrote; anything else is an error."""
    check_readable(path)
    try:
        return grasp_set(*_contents(path))
    except Exception as error:  # the bytes are anyone's: zip, NumPy and JSON each fail in ways of their own
        raise GraspmatchError(
            f"{path} is not a file of grasps written by graspmatch, or damaged: {one_line(error)}{disguise(path)}."
        ) from error


def _contents(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header and the arrays of a file."""
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no .npz archive")
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(member.file_size for member in archive.infolist())
    if unpacked > MOST_BYTES:
        raise ValueError(f"it would unpack to {unpacked / 2**20:.0f} MiB, grasps to at most {MOST_BYTES / 2**20:.0f}")
    with np.load(path, allow_pickle=False) as file:
        header = json.loads(str(file["header"]))
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise ValueError("its header is not ours")
        if header["format_version"] != VERSION:
            raise ValueError(f"it has format version {header['format_version']}, this version reads {VERSION}")
        return header, {name: file[name] for name in ARRAYS}
