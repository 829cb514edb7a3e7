"""A baked hand on disk: NumPy arrays and JSON, no pickle, with a checksum; what does not check out is baked anew."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from graspmatch.geometry.grid import Grid
from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.types import Finger, Gripper, Link, PointCloud, Preshape

T = TypeVar("T")


def cache_folder() -> Path:
    """`GRASPMATCH_CACHE`, else `graspmatch` in the user's cache folder."""
    if folder := os.environ.get("GRASPMATCH_CACHE"):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "graspmatch"


def read_gripper(key: str) -> Gripper | None:
    """The hand stored under a key; None where there is none or the file is damaged."""
    return read_cached(key, _unpack)


def write_gripper(key: str, gripper: Gripper) -> None:
    """Store a hand under a key."""
    write_cached(key, _pack(gripper))


def read_cached(key: str, unpack: Callable[[dict[str, np.ndarray]], T]) -> T | None:
    """What `unpack` makes of the arrays stored under a key; None where there are none or the file is damaged."""
    try:
        with np.load(cache_folder() / f"{key}.npz", allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        digest = bytes(arrays.pop("digest")).decode()
        return unpack(arrays) if digest == _digest(arrays) else None
    except FileNotFoundError:
        return None
    except Exception:  # what a damaged archive raises has no end; it reads like none: the content is computed again
        return None


def write_cached(key: str, arrays: dict[str, np.ndarray]) -> None:
    """Store arrays. A folder that cannot be written costs the next call its time, not this one its result."""
    digest = np.frombuffer(_digest(arrays).encode(), dtype=np.uint8)
    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(suffix=".npz", dir=cache_folder())
    except OSError:
        return
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays, digest=digest)
        os.replace(name, cache_folder() / f"{key}.npz")
    except OSError:
        Path(name).unlink(missing_ok=True)


def _digest(arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 over names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape};".encode())
        digest.update(array.data)
    return digest.hexdigest()


def _pack(gripper: Gripper) -> dict[str, np.ndarray]:
    """Arrays by name; everything that is no array goes into one JSON text."""
    arrays: dict[str, np.ndarray] = {
        name: getattr(gripper, name)
        for name in ("lower", "upper", "open_joints", "closed_joints", "approach", "closing", "tool_centre_point")
    }
    for i, link in enumerate(gripper.links):
        for kind in ("collision", "visual"):
            mesh = getattr(link, kind)
            arrays |= {f"link{i}.{kind}.vertices": mesh.vertices, f"link{i}.{kind}.faces": mesh.faces}
    for i, preshape in enumerate(gripper.preshapes):
        arrays |= {f"preshape{i}.{name}": array for name, array in _preshape_arrays(preshape).items()}
    text = json.dumps(_plain(gripper)).encode()
    return arrays | {"plain": np.frombuffer(text, dtype=np.uint8)}


def _plain(gripper: Gripper) -> dict[str, Any]:
    return {
        "name": gripper.name,
        "description": str(gripper.description),
        "base_link": gripper.base_link,
        "joint_names": gripper.joint_names,
        "links": [(link.name, link.rgba) for link in gripper.links],
        "fingers": [(finger.name, finger.links, finger.joints) for finger in gripper.fingers],
        "finger_force": gripper.finger_force,
        "opening": gripper.opening,
        "approach_distance": gripper.approach_distance,
        "preshapes": [(p.name, p.hand.spacing, p.is_fingertips) for p in gripper.preshapes],
        "content_hash": gripper.content_hash,
    }


def _preshape_arrays(preshape: Preshape) -> dict[str, np.ndarray]:
    arrays = {
        "joints": preshape.joints,
        "closed": preshape.closed,
        "samples": preshape.samples.points,
        "normals": preshape.samples.normals,
        "weights": preshape.weights,
        "tool_centre_point": preshape.tool_centre_point,
        "hand.origin": preshape.hand.origin,
        "hand.values": preshape.hand.values,
        "corridor.origin": preshape.corridor.origin,
        "corridor.values": preshape.corridor.values,
        "nearest_sample": preshape.nearest_sample,
        "arrival": preshape.arrival,
        "outline": preshape.outline,
    }
    return arrays | {f"finger_outline{f}": outline for f, outline in enumerate(preshape.finger_outlines)}


def _unpack(arrays: dict[str, np.ndarray]) -> Gripper:
    plain = json.loads(bytes(arrays["plain"]))

    def mesh(name: str) -> TriangleMesh:
        return TriangleMesh(arrays[f"{name}.vertices"], arrays[f"{name}.faces"])

    links = [
        Link(name, mesh(f"link{i}.collision"), mesh(f"link{i}.visual"), tuple(rgba))
        for i, (name, rgba) in enumerate(plain["links"])
    ]
    fingers = [Finger(name, tuple(links), tuple(joints)) for name, links, joints in plain["fingers"]]
    preshapes = [
        _unpack_preshape(arrays, f"preshape{i}.", name, spacing, len(fingers), is_fingertips)
        for i, (name, spacing, is_fingertips) in enumerate(plain["preshapes"])
    ]
    return Gripper(
        name=plain["name"],
        description=Path(plain["description"]),
        base_link=plain["base_link"],
        joint_names=tuple(plain["joint_names"]),
        lower=arrays["lower"],
        upper=arrays["upper"],
        open_joints=arrays["open_joints"],
        closed_joints=arrays["closed_joints"],
        links=tuple(links),
        fingers=tuple(fingers),
        approach=arrays["approach"],
        closing=arrays["closing"],
        tool_centre_point=arrays["tool_centre_point"],
        finger_force=plain["finger_force"],
        opening=plain["opening"],
        approach_distance=plain["approach_distance"],
        preshapes=tuple(preshapes),
        content_hash=plain["content_hash"],
    )


def _unpack_preshape(
    arrays: dict[str, np.ndarray], at: str, name: str, spacing: float, fingers: int, is_fingertips: bool
) -> Preshape:
    return Preshape(
        name=name,
        joints=arrays[at + "joints"],
        is_fingertips=is_fingertips,
        closed=arrays[at + "closed"],
        samples=PointCloud(arrays[at + "samples"], arrays[at + "normals"]),
        weights=arrays[at + "weights"],
        tool_centre_point=arrays[at + "tool_centre_point"],
        hand=Grid(arrays[at + "hand.origin"], spacing, arrays[at + "hand.values"]),
        corridor=Grid(arrays[at + "corridor.origin"], spacing, arrays[at + "corridor.values"]),
        nearest_sample=arrays[at + "nearest_sample"],
        arrival=arrays[at + "arrival"],
        outline=arrays[at + "outline"],
        finger_outlines=tuple(arrays[f"{at}finger_outline{f}"] for f in range(fingers)),
    )
