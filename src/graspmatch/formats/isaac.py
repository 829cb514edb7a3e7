"""Isaac grasp YAML, as the grasp editor of NVIDIA Isaac Sim and GraspGen read it.

The object frame of the file is the world frame of the grasps: the frame of the file or array that the scene came from.
What the format has no name for goes under the key `graspmatch`, which other readers pass over.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import MOST_GRASPS, one_line
from graspmatch.formats.foreign import MOST_JOINTS, Found, foreign_grasps, joint_names_of, joint_table
from graspmatch.formats.native import grasp_set, quaternion_rotation
from graspmatch.formats.yaml_files import read_yaml, write_yaml
from graspmatch.geometry import se3
from graspmatch.types import GraspSet, Gripper

Document = dict[str, Any]

VERSION = 1.0
NUMBERS = ("quality", "clearance", "matching_error", "loss")
"""What is known of a grasp beyond the format [1, m, m2, m2]."""


def write_isaac(grasps: GraspSet, gripper_frame: str, path: Path) -> None:
    """Write poses, scores and both joint blocks; `gripper_frame` is the base link of the hand.

    Joint values that are not known are left out: a reader would take NaN for a command.
    """
    # Both spellings: the editor writes `object_frame`, its tutorial `object_frame_link`.
    document = {
        "format": "isaac_grasp",
        "format_version": VERSION,
        "object_frame": "object",
        "object_frame_link": "object",
        "gripper_frame": gripper_frame,
        "gripper_frame_link": gripper_frame,
        "grasps": {f"grasp_{i}": _grasp_entry(grasps, i) for i in range(len(grasps))},
        "graspmatch": {
            "joint_names": list(grasps.joint_names),
            "preshape_names": list(grasps.preshape_names),
            "tally": dict(grasps.tally),
            "provenance": dataclasses.asdict(grasps.provenance),
            "advice": grasps.advice,
        },
    }
    write_yaml(document, path)


def read_isaac(path: Path, gripper: Gripper | None = None) -> GraspSet:
    """Read a file of this or of another tool, best first; its poses are those of the hand's base link.

    What another tool does not say is NaN, or -1 fingers touching, or follows from the gripper.
    """
    documents = read_yaml(path)
    if len(documents) != 1 or not is_isaac(documents[0]):
        raise GraspmatchError(f"{path} is not an Isaac grasp file: it has no 'format: isaac_grasp'.")
    return isaac_grasps(documents[0], path, gripper)


def is_isaac(document: object) -> bool:
    """Whether the document says that it is of this format."""
    return isinstance(document, dict) and document.get("format") == "isaac_grasp"


def isaac_grasps(
    document: Document, path: Path, gripper: Gripper | None, T_file_gripper: Float[np.ndarray, "4 4"] | None = None
) -> GraspSet:
    """The grasps of a document; `T_file_gripper` is where our gripper frame is in the frame that another tool's is."""
    missing = [key for key in ("format_version", "grasps") if key not in document]
    if missing:
        raise GraspmatchError(f"{path} is not a whole Isaac grasp file: '{missing[0]}' is missing.")
    if _version(document["format_version"]) != VERSION:
        raise GraspmatchError(
            f"{path} has format_version {str(document['format_version'])[:20]}; this program reads {VERSION}."
        )
    grasps = document["grasps"] or {}
    if not isinstance(grasps, dict):
        raise GraspmatchError(f"{path}: 'grasps' must be a mapping of names to grasps.")
    if len(grasps) > MOST_GRASPS:
        raise GraspmatchError(f"{path} has {len(grasps)} grasps, at most {MOST_GRASPS} are read.")
    entries = [_Entry(str(name)[:60], entry, path) for name, entry in grasps.items()]
    if "graspmatch" in document:
        if T_file_gripper is not None:
            raise GraspmatchError(f"{path} was written by graspmatch: its poses are those of the base link.")
        return _own_grasps(document["graspmatch"], entries, path)
    names = joint_names_of([entry.grasp_joints | entry.pregrasp_joints for entry in entries], path)
    found = Found(
        T_world_gripper=np.array([entry.pose for entry in entries]).reshape(-1, 4, 4)
        @ (np.eye(4) if T_file_gripper is None else T_file_gripper),
        score=np.array([entry.confidence for entry in entries], dtype=float),
        joint_names=names,
        pregrasp_joints=joint_table([entry.pregrasp_joints for entry in entries], names),
        grasp_joints=joint_table([entry.grasp_joints for entry in entries], names),
        hand=str(document.get("gripper_frame", document.get("gripper_frame_link", "")))[:200],
    )
    return foreign_grasps(found, path, gripper)


class _Entry:
    """One grasp of a document, checked."""

    def __init__(self, name: str, entry: Any, path: Path) -> None:
        try:
            self.pose = _pose(entry)
            self.confidence = _number(entry.get("confidence", np.nan), "confidence")
            self.grasp_joints = _joint_values(entry, "cspace_position")
            self.pregrasp_joints = _joint_values(entry, "pregrasp_cspace_position")
            self.own: Document = entry.get("graspmatch", {})
            self.pregrasp = _pose(self.own["pregrasp"]) if "pregrasp" in self.own else np.full((4, 4), np.nan)
        except Exception as error:  # anything may stand where a number should
            raise GraspmatchError(f"{path}: grasp '{name}' is malformed ({one_line(error)}).") from error


def _own_grasps(own: Any, entries: list[_Entry], path: Path) -> GraspSet:
    """The grasps of a file that `write_isaac` wrote, in its order."""
    try:
        joint_names, preshapes = tuple(own["joint_names"]), {name: i for i, name in enumerate(own["preshape_names"])}
        if len(joint_names) > MOST_JOINTS:
            raise ValueError(f"it names {len(joint_names)} joints, at most {MOST_JOINTS} are possible")
        named = joint_names_of([entry.grasp_joints | entry.pregrasp_joints for entry in entries], path)
        if strangers := set(named) - set(joint_names):
            raise ValueError(f"'{min(strangers)[:60]}' is none of its joint_names")
        preshape = [preshapes[entry.own["preshape"]] if "preshape" in entry.own else 0 for entry in entries]
        arrays = {
            "T_world_gripper": np.array([entry.pose for entry in entries]).reshape(-1, 4, 4),
            "T_world_pregrasp": np.array([entry.pregrasp for entry in entries]).reshape(-1, 4, 4),
            "preshape": np.array(preshape, dtype=int),
            "pregrasp_joints": joint_table([entry.pregrasp_joints for entry in entries], joint_names),
            "grasp_joints": joint_table([entry.grasp_joints for entry in entries], joint_names),
            "score": np.array([entry.confidence for entry in entries], dtype=float),
            "fingers_touching": np.array([int(entry.own.get("fingers_touching", -1)) for entry in entries], dtype=int),
        }
        for name in NUMBERS:
            arrays[name] = np.array([float(entry.own.get(name, np.nan)) for entry in entries], dtype=float)
        return grasp_set(own, arrays)
    except GraspmatchError:
        raise
    except Exception as error:
        raise GraspmatchError(f"{path}: its block 'graspmatch' is malformed ({one_line(error)}).") from error


def _grasp_entry(grasps: GraspSet, i: int) -> Document:
    """One grasp as the format has it, and our own block."""
    pregrasp = grasps.T_world_pregrasp[i]
    return {
        "confidence": float(grasps.score[i]),
        **_pose_entry(grasps.T_world_gripper[i]),
        "cspace_position": _known(grasps.joint_names, grasps.grasp_joints[i]),
        "pregrasp_cspace_position": _known(grasps.joint_names, grasps.pregrasp_joints[i]),
        "graspmatch": {
            "preshape": grasps.preshape_names[grasps.preshape[i]],
            **({} if np.isnan(pregrasp).any() else {"pregrasp": _pose_entry(pregrasp)}),
            "fingers_touching": int(grasps.fingers_touching[i]),
            **{name: float(getattr(grasps, name)[i]) for name in NUMBERS},
        },
    }


def _known(names: tuple[str, ...], values: Float[np.ndarray, "d"]) -> dict[str, float]:
    """Values of the joints whose values are known."""
    return {name: float(value) for name, value in zip(names, values, strict=True) if np.isfinite(value)}


def _pose_entry(T_world_gripper: Float[np.ndarray, "4 4"]) -> Document:
    """Position [m] and orientation of a pose."""
    w, *xyz = se3.quaternion_from_matrix(T_world_gripper[:3, :3]).tolist()
    return {"position": T_world_gripper[:3, 3].tolist(), "orientation": {"w": w, "xyz": xyz}}


def _pose(entry: Document) -> Float[np.ndarray, "4 4"]:
    """Position and orientation of an entry as a transform."""
    position = np.array(entry["position"], dtype=float)
    wxyz = np.array([entry["orientation"]["w"], *entry["orientation"]["xyz"]], dtype=float)
    if position.shape != (3,) or wxyz.shape != (4,) or not np.isfinite(position).all():
        raise ValueError("a pose needs three finite coordinates and the four numbers of a quaternion")
    return se3.from_parts(quaternion_rotation(wxyz), position)


def _joint_values(entry: Document, key: str) -> dict[str, float]:
    """Values of the joints that a block names, which may be missing."""
    return {str(name): _number(value, str(name)) for name, value in (entry.get(key) or {}).items()}


def _number(value: Any, name: str) -> float:
    """A number that is finite, or NaN for unknown."""
    number = float(value)
    if np.isinf(number):
        raise ValueError(f"'{name[:60]}' is infinite")
    return number


def _version(entry: Any) -> float | None:
    """The version as a number; some tools quote it."""
    try:
        return float(entry)
    except (TypeError, ValueError):
        return None
