"""Our own fields of a `GraspSet`, as the `.npz` holds them and as other formats carry them along."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from graspmatch.geometry import se3
from graspmatch.types import GraspSet, Provenance

# What is not an array is kept in one JSON text.
TEXTS = ("joint_names", "preshape_names", "tally", "provenance", "advice")
ARRAYS = tuple(field.name for field in dataclasses.fields(GraspSet) if field.name not in TEXTS)
INTEGERS = ("preshape", "fingers_touching")
FINITE = ("pregrasp_joints", "grasp_joints", "score")
"""Finite, or NaN where unknown."""
NOT_UNIT = 0.01
"""A quaternion is one up to this difference of its length from 1: files of two or three digits are read too."""


def texts_of(grasps: GraspSet) -> dict[str, Any]:
    """What is not an array, in types that JSON has."""
    return {name: getattr(grasps, name) for name in TEXTS} | {"provenance": dataclasses.asdict(grasps.provenance)}


def arrays_of(grasps: GraspSet) -> dict[str, np.ndarray]:
    """The arrays by name."""
    return {name: getattr(grasps, name) for name in ARRAYS}


def grasp_set(texts: dict[str, Any], arrays: dict[str, np.ndarray]) -> GraspSet:
    """The grasps of what a file says, checked; a ValueError, TypeError or KeyError says what does not fit."""
    joint_names, preshape_names = _names(texts["joint_names"]), _names(texts["preshape_names"])
    _check(arrays, len(joint_names), len(preshape_names))
    return GraspSet(
        joint_names=joint_names,
        preshape_names=preshape_names,
        tally={str(reason): int(count) for reason, count in dict(texts["tally"]).items()},
        provenance=provenance(texts["provenance"]),
        advice=str(texts["advice"]),
        **{name: arrays[name] for name in ARRAYS},
    )


def provenance(entry: dict[str, Any]) -> Provenance:
    """Where grasps came from, checked."""
    made = Provenance(**entry)
    for field in dataclasses.fields(Provenance):
        expected = {"seed": int, "seconds": dict}.get(field.name, str)
        if not isinstance(getattr(made, field.name), expected):
            raise ValueError(f"'{field.name}' of the provenance must be {expected.__name__}")
    return made


def _names(entry: object) -> tuple[str, ...]:
    if not isinstance(entry, list | tuple) or not all(isinstance(name, str) for name in entry):
        raise ValueError("names must be a list of texts")
    return tuple(entry)


def _check(arrays: dict[str, np.ndarray], joints: int, preshapes: int) -> None:
    """Do the arrays fit together, and are the poses poses?"""
    n = len(arrays["T_world_gripper"])
    rows = {
        "T_world_gripper": (4, 4),
        "T_world_pregrasp": (4, 4),
        "pregrasp_joints": (joints,),
        "grasp_joints": (joints,),
    }
    for name in ARRAYS:
        array, expected = arrays[name], (n, *rows.get(name, ()))
        if array.shape != expected:
            raise ValueError(f"'{name}' has the shape {array.shape}, expected {expected}")
        if array.dtype.kind != ("i" if name in INTEGERS else "f"):
            raise ValueError(f"'{name}' holds {array.dtype}")
        if name in FINITE and np.isinf(array).any():
            raise ValueError(f"'{name}' has an infinite number")
    if not np.isin(arrays["preshape"], np.arange(preshapes)).all():
        raise ValueError("a preshape has no name")
    check_poses("T_world_gripper", arrays["T_world_gripper"])
    pregrasp = arrays["T_world_pregrasp"]
    check_poses("T_world_pregrasp", pregrasp[~np.isnan(pregrasp).all(axis=(1, 2))])  # unknown is all NaN


def quaternion_rotation(wxyz: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Rotation of a quaternion that should be unit; a ValueError where it is not."""
    length = float(np.linalg.norm(wxyz))
    if not abs(length - 1) <= NOT_UNIT:
        raise ValueError(f"its quaternion has the length {length:.3g}, not 1")
    return se3.matrix_from_quaternion(wxyz / length)


def check_poses(name: str, T: np.ndarray) -> None:
    """Refuse matrices that are no poses."""
    with np.errstate(over="ignore"):  # of matrices that are far from rotations
        good = se3.is_rigid(T)
    if not good.all():
        raise ValueError(f"'{name}' of grasp {int(np.argmin(good))} is no pose: a rotation and a finite position")
