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
from graspmatch.formats.files import write_atomically
from graspmatch.geometry import se3
from graspmatch.types import GraspSet, Provenance

Document = dict[str, Any]

NUMBERS = ("quality", "clearance", "matching_error", "loss")
"""What is known of a grasp beyond the format [1, m, m2, m2]."""


def write_isaac(grasps: GraspSet, gripper_frame: str, path: Path) -> None:
    """Write poses, scores and both joint blocks; `gripper_frame` is the base link of the hand."""
    import yaml

    # Both spellings: the editor writes `object_frame`, its tutorial `object_frame_link`.
    document = {
        "format": "isaac_grasp",
        "format_version": 1.0,
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
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    text = yaml.dump(document, Dumper=dumper, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_isaac(path: Path) -> GraspSet:
    """Read a file of this or of another tool, best first; what it does not say is NaN, or -1 fingers touching."""
    document = _load(path)
    try:
        return _grasp_set(document, path)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise GraspmatchError(f"{path}: a grasp or a name is missing or malformed ({_one_line(error)}).") from error


def _grasp_entry(grasps: GraspSet, i: int) -> Document:
    """One grasp as the format has it, and our own block."""
    return {
        "confidence": float(grasps.score[i]),
        **_pose_entry(grasps.T_world_gripper[i]),
        "cspace_position": dict(zip(grasps.joint_names, grasps.grasp_joints[i].tolist(), strict=True)),
        "pregrasp_cspace_position": dict(zip(grasps.joint_names, grasps.pregrasp_joints[i].tolist(), strict=True)),
        "graspmatch": {
            "preshape": grasps.preshape_names[grasps.preshape[i]],
            "pregrasp": _pose_entry(grasps.T_world_pregrasp[i]),
            "fingers_touching": int(grasps.fingers_touching[i]),
            **{name: float(getattr(grasps, name)[i]) for name in NUMBERS},
        },
    }


def _pose_entry(T_world_gripper: Float[np.ndarray, "4 4"]) -> Document:
    """Position [m] and orientation of a pose."""
    w, *xyz = se3.quaternion_from_matrix(T_world_gripper[:3, :3]).tolist()
    return {"position": T_world_gripper[:3, 3].tolist(), "orientation": {"w": w, "xyz": xyz}}


def _load(path: Path) -> Document:
    """The document, checked to be of this format."""
    import yaml

    try:
        document = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except OSError as error:
        raise GraspmatchError(f"Cannot read {path}: {error.strerror or error}.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise GraspmatchError(f"{path} is not YAML: {_one_line(error)}.") from error
    if not isinstance(document, dict) or document.get("format") != "isaac_grasp":
        raise GraspmatchError(f"{path} is not an Isaac grasp file: it has no 'format: isaac_grasp'.")
    missing = [key for key in ("format_version", "grasps") if key not in document]
    if missing:
        raise GraspmatchError(f"{path} is not a whole Isaac grasp file: '{missing[0]}' is missing.")
    return document


def _grasp_set(document: Document, path: Path) -> GraspSet:
    """The grasps of a document."""
    entries = list((document["grasps"] or {}).values())
    own = document.get("graspmatch")
    if own is None:
        own = _foreign_header(document, entries, path)
        entries.sort(key=lambda entry: -float(entry.get("confidence", 0.0)))
    joint_names, preshape_names = tuple(own["joint_names"]), tuple(own["preshape_names"])
    extras = [entry.get("graspmatch", {}) for entry in entries]
    unknown = np.full((4, 4), np.nan)
    pregrasps = [_pose(extra["pregrasp"]) if "pregrasp" in extra else unknown for extra in extras]
    preshapes = [preshape_names.index(extra.get("preshape", preshape_names[0])) for extra in extras]
    return GraspSet(
        joint_names=joint_names,
        preshape_names=preshape_names,
        T_world_gripper=np.array([_pose(entry) for entry in entries]).reshape(-1, 4, 4),
        T_world_pregrasp=np.array(pregrasps).reshape(-1, 4, 4),
        preshape=np.array(preshapes, dtype=int),
        pregrasp_joints=_joint_values(entries, "pregrasp_cspace_position", joint_names),
        grasp_joints=_joint_values(entries, "cspace_position", joint_names),
        score=np.array([float(entry.get("confidence", np.nan)) for entry in entries], dtype=float),
        fingers_touching=np.array([int(extra.get("fingers_touching", -1)) for extra in extras], dtype=int),
        **{name: np.array([float(extra.get(name, np.nan)) for extra in extras], dtype=float) for name in NUMBERS},
        tally=dict(own["tally"]),
        provenance=Provenance(**own["provenance"]),
        advice=str(own["advice"]),
    )


def _foreign_header(document: Document, entries: list[Document], path: Path) -> Document:
    """What our own block would say, for a file of another tool."""
    frame = document.get("gripper_frame", document.get("gripper_frame_link", "unknown"))
    blocks = [entry.get(key, {}) for entry in entries for key in ("cspace_position", "pregrasp_cspace_position")]
    joint_names = list(dict.fromkeys(name for block in blocks for name in block))
    provenance = Provenance(
        gripper=str(frame), gripper_hash="", config="", seed=0, device="", version="", source=str(path)
    )
    return {
        "joint_names": joint_names,
        "preshape_names": ["unknown"],
        "tally": {"candidates": len(entries)},
        "provenance": dataclasses.asdict(provenance),
        "advice": "",
    }


def _pose(entry: Document) -> Float[np.ndarray, "4 4"]:
    """Position and orientation of an entry as a transform."""
    position = np.array(entry["position"], dtype=float)
    wxyz = np.array([entry["orientation"]["w"], *entry["orientation"]["xyz"]], dtype=float)
    norm = np.linalg.norm(wxyz)
    if position.shape != (3,) or wxyz.shape != (4,) or not np.isfinite(position).all() or not norm > 0:
        raise ValueError("a pose needs three finite coordinates and a quaternion that is not zero")
    return se3.from_parts(se3.matrix_from_quaternion(wxyz / norm), position)


def _joint_values(entries: list[Document], key: str, joint_names: tuple[str, ...]) -> Float[np.ndarray, "n d"]:
    """Values of the named joints, NaN where an entry does not say."""
    values = [[float(entry.get(key, {}).get(name, np.nan)) for name in joint_names] for entry in entries]
    return np.array(values, dtype=float).reshape(len(entries), len(joint_names))


def _one_line(error: Exception) -> str:
    """The message of an error without line breaks."""
    return " ".join(f"{type(error).__name__}: {error}".split())
