"""GraspNet API's `GraspGroup` in `.npy`, as AnyGrasp and graspnet-baseline write it: rows of 17 numbers.

    score, width, height, depth, rotation (9, row by row), translation (3), object id

The rotation's columns are x = approach, y = closing and z = x cross y. The translation is the middle of the jaw, and
the fingertips lie at translation + depth x +- (width / 2) y. The format knows neither joints nor hand: a row becomes a
pose of any hand by laying the hand's fingertip plane into that of the row, and the middle of its jaw on the row's.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import write_atomically
from graspmatch.geometry import se3
from graspmatch.types import GraspSet, Gripper, Preshape, Provenance

COLUMNS = 17
SCORE, WIDTH, HEIGHT, DEPTH, ROTATION, TRANSLATION, OBJECT = 0, 1, 2, 3, slice(4, 13), slice(13, 16), 16

FINGER_DEPTH = 0.02
"""From the grasp centre to the fingertips in what we write [m]: of the depths that graspnet-baseline uses (1 to 4 cm)
one that lies between the pads of any hand. A reader takes the depth of each row, whatever it is."""
FINGER_HEIGHT = 0.02
"""Finger thickness that the format's own tools assume [m]."""
UNKNOWN_OBJECT = -1.0
FACING = 0.5
"""A part of the inner surface is a pad where the cosine between its normal and the closing axis is at least this."""
SLACK = 1e-4
"""A preshape counts as wide enough up to this [m], since other tools store widths in single precision."""


@dataclass(frozen=True)
class Jaw:
    """What the format knows of a hand, for one preshape."""

    tip_centre: Float[np.ndarray, "3"]
    """The middle between the fingertips, in the plane of the foremost point of the fingers [m], gripper frame."""
    opening: float
    """Clear distance between the pads along the closing axis [m]; NaN where there are no two pads face to face."""


def jaw(preshape: Preshape, gripper: Gripper) -> Jaw:
    """The jaw of a preshape, from the outlines of its fingers and the samples of its inner surface near their tips."""
    tip = max(float((outline[0] @ gripper.approach).max()) for outline in preshape.finger_outlines)
    points, normals = preshape.samples.points, preshape.samples.normals
    assert normals is not None, "baking gives every sample its normal"
    across = points @ gripper.closing
    facing = np.where(points @ gripper.approach > tip - FINGER_DEPTH, normals @ gripper.closing, 0.0)
    upper = float(across[facing <= -FACING].min(initial=np.inf))
    lower = float(across[facing >= FACING].max(initial=-np.inf))
    has_pads = np.isfinite(upper - lower) and upper > lower
    tcp = gripper.tool_centre_point
    middle = (upper + lower) / 2 if has_pads else float(tcp @ gripper.closing)
    to_middle = (middle - tcp @ gripper.closing) * gripper.closing + (tip - tcp @ gripper.approach) * gripper.approach
    return Jaw(tcp + to_middle, upper - lower if has_pads else np.nan)


def write_graspnet(grasps: GraspSet, path: Path, gripper: Gripper) -> None:
    """Write grasps of a two-finger hand, with the opening of the preshape that each arrives with as its width."""
    if len(gripper.fingers) != 2:
        raise GraspmatchError(
            f"Cannot write {path}: GraspNet's format is for two fingers, {gripper.name} has {len(gripper.fingers)}. "
            "Possible: .npz, .yaml."
        )
    jaws = [jaw(preshape, gripper) for preshape in gripper.preshapes]
    opening = np.array([each.opening for each in jaws])[grasps.preshape]
    if np.isnan(opening).any():
        name = gripper.preshapes[int(grasps.preshape[np.isnan(opening)][0])].name
        raise GraspmatchError(
            f"Cannot write {path}: in the preshape '{name}' the pads of {gripper.name} do not face each other along "
            "its closing axis, so there is no jaw opening to write. Possible: .npz, .yaml."
        )
    tips = np.array([each.tip_centre for each in jaws])[grasps.preshape]
    centre_gripper = tips - FINGER_DEPTH * gripper.approach
    T = grasps.T_world_gripper
    rows = np.zeros((len(grasps), COLUMNS))
    rows[:, SCORE], rows[:, WIDTH], rows[:, HEIGHT] = grasps.score, opening, FINGER_HEIGHT
    rows[:, DEPTH], rows[:, OBJECT] = FINGER_DEPTH, UNKNOWN_OBJECT
    rows[:, ROTATION] = (T[:, :3, :3] @ _R_gripper_jaw(gripper)).reshape(-1, 9)
    rows[:, TRANSLATION] = se3.apply(T, centre_gripper[:, None])[:, 0]

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.save(file, rows, allow_pickle=False)

    write_atomically(path, write)


def read_graspnet(path: Path, gripper: Gripper) -> GraspSet:
    """The grasps of a file as poses of any hand, best first, with the narrowest preshape that opens to their width.

    Where none opens so wide it is the widest one. Joint values at the grasp, clearances and errors are NaN.
    """
    rows = _load(path)
    rows = rows[np.argsort(-rows[:, SCORE], kind="stable")]
    jaws = [jaw(preshape, gripper) for preshape in gripper.preshapes]
    preshape = _fitting_preshape(rows[:, WIDTH], np.array([each.opening for each in jaws]))
    rotation = rows[:, ROTATION].reshape(-1, 3, 3)
    tip_world = rows[:, TRANSLATION] + rows[:, DEPTH, None] * rotation[:, :, 0]
    R_world_gripper = rotation @ _R_gripper_jaw(gripper).T
    tip_gripper = np.array([each.tip_centre for each in jaws])[preshape]
    T = se3.from_parts(R_world_gripper, tip_world - np.einsum("nij,nj->ni", R_world_gripper, tip_gripper))
    unknown = np.full(len(rows), np.nan)
    pregrasp_joints = np.array([shape.joints for shape in gripper.preshapes])[preshape]
    return GraspSet(
        joint_names=gripper.joint_names,
        preshape_names=tuple(shape.name for shape in gripper.preshapes),
        T_world_gripper=T,
        T_world_pregrasp=T @ se3.translation(-gripper.approach_distance * gripper.approach),
        preshape=preshape,
        pregrasp_joints=pregrasp_joints,
        grasp_joints=np.full_like(pregrasp_joints, np.nan),
        score=rows[:, SCORE],
        clearance=unknown,
        matching_error=unknown,
        loss=unknown,
        quality=unknown,
        fingers_touching=np.full(len(rows), -1),
        tally={"candidates": len(rows)},
        provenance=Provenance(gripper.name, gripper.content_hash, "", seed=0, device="", version="", source=str(path)),
    )


def _R_gripper_jaw(gripper: Gripper) -> Float[np.ndarray, "3 3"]:
    """The format's axes in the gripper frame: those of the canonical frame, named in another order."""
    return gripper.T_gripper_canonical[:3, [2, 0, 1]]


def _fitting_preshape(width: Float[np.ndarray, "n"], opening: Float[np.ndarray, "p"]) -> Int[np.ndarray, "n"]:
    """For each width the preshape of the smallest opening that is no less, else of the largest.

    No margin is added: the width of a row is a jaw opening, in which its author's margin is already.
    """
    known = np.where(np.isnan(opening), -np.inf, opening)  # hands without a jaw take their first preshape
    fits = known >= width[:, None] - SLACK
    narrowest = np.argmin(np.where(fits, known, np.inf), axis=-1)
    return np.where(fits.any(axis=-1), narrowest, np.argmax(known))


def _load(path: Path) -> Float[np.ndarray, "n 17"]:
    """The rows of a file, checked."""
    try:
        with path.open("rb") as file:
            rows = np.lib.format.read_array(file, allow_pickle=False)
    except OSError as error:
        raise GraspmatchError(f"Cannot read {path}: {error.strerror or error}.") from error
    except Exception as error:  # the bytes are anyone's, and NumPy fails on them in ways of its own
        raise GraspmatchError(f"{path} is no .npy file of numbers: {' '.join(str(error).split())}") from error
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or rows.dtype.kind != "f":
        raise GraspmatchError(
            f"{path} is not a GraspGroup of GraspNet: it holds {rows.dtype} of the shape {rows.shape}, "
            f"expected floats of the shape (n, {COLUMNS})."
        )
    rows = rows.astype(float)
    good = np.isfinite(rows).all(axis=-1)
    if not good.all():
        raise GraspmatchError(f"{path}: row {np.argmin(good)} has a number that is not finite.")
    good = se3.is_rigid(se3.from_parts(rows[:, ROTATION].reshape(-1, 3, 3), rows[:, TRANSLATION]))
    if not good.all():
        raise GraspmatchError(f"{path}: columns 4 to 12 of row {np.argmin(good)} are no rotation matrix.")
    return rows
