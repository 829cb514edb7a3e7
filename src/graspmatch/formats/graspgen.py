"""GraspGen's grasp files in JSON: transforms of the hand's base, and which of them held the object."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from graspmatch.errors import GraspmatchError
from graspmatch.formats.canonical import Block, canonical_grasps, canonical_poses, in_gripper
from graspmatch.formats.files import disguise, one_line, read_text, write_atomically
from graspmatch.formats.native import ARRAYS, INTEGERS, arrays_of, texts_of
from graspmatch.types import GraspSet, Gripper


def write_graspgen(grasps: GraspSet, path: Path, gripper: Gripper) -> None:
    """Write transforms and predicted verdicts; our other fields go under the key `graspmatch`."""
    document = {
        "object": {"file": grasps.provenance.source, "scale": 1.0},
        "grasps": {
            "transforms": canonical_poses(grasps, gripper).tolist(),
            "object_in_gripper": in_gripper(grasps, path).astype(bool).tolist(),
        },
        "graspmatch": {
            **texts_of(grasps),
            "T_gripper_canonical": gripper.T_gripper_canonical.tolist(),
            "arrays": {name: _nulls_for_nan(array.tolist()) for name, array in arrays_of(grasps).items()},
        },
    }
    text = json.dumps(document, allow_nan=False)
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_graspgen(path: Path, gripper: Gripper | None = None) -> GraspSet:
    """Read a file of this or of another tool, best first; one of another tool needs the gripper."""
    text = read_text(path)
    try:
        document = json.loads(text)
        entry = document["grasps"]
        transforms, held = np.array(entry["transforms"]), np.array(entry["object_in_gripper"])
        block = _block(document["graspmatch"], len(transforms)) if "graspmatch" in document else None
        return canonical_grasps(transforms, held, block, path, gripper)
    except GraspmatchError:
        raise
    except Exception as error:  # the text is anyone's: nested too deeply, ragged, of words where numbers should be
        raise GraspmatchError(
            f"{path} is not a grasp file of GraspGen in JSON: {one_line(error)}{disguise(path)}."
        ) from error


def _block(own: dict[str, Any], n: int) -> Block:
    """Our block of a file; JSON says neither NaN nor the shape of an empty array."""
    arrays = {}
    for name in ARRAYS:
        array = np.array(own["arrays"][name], dtype=int if name in INTEGERS else float)
        empty = {"T_world_gripper": (0, 4, 4), "T_world_pregrasp": (0, 4, 4)}.get(name, (0,))
        if name in ("pregrasp_joints", "grasp_joints"):
            empty = (0, len(own["joint_names"]))
        arrays[name] = array if array.size or n else array.reshape(empty)
    return own, arrays


def _nulls_for_nan(value: Any) -> Any:
    """The same with null for every number that JSON cannot say."""
    if isinstance(value, list):
        return [_nulls_for_nan(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
