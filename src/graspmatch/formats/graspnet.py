"""GraspNet API's `GraspGroup` in `.npy`, as AnyGrasp and graspnet-baseline write it: rows of 17 numbers.

    score, width, height, depth, rotation (9, row by row), translation (3), object id

The rotation's columns are x = approach, y = closing and z = x cross y. The translation is the middle of the jaw, and
the fingertips lie at translation + depth x +- (width / 2) y. The format knows neither joints nor hand: a row becomes a
pose of any hand by laying the hand's fingertip plane into that of the row, and the middle of its jaw on the row's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import check_readable, disguise, one_line, write_atomically
from graspmatch.formats.foreign import Found, foreign_grasps
from graspmatch.formats.jaw import fitting_preshape
from graspmatch.formats.jaw import jaw as jaw
from graspmatch.geometry import se3
from graspmatch.types import GraspSet, Gripper

COLUMNS = 17
SCORE, WIDTH, HEIGHT, DEPTH, ROTATION, TRANSLATION, OBJECT = 0, 1, 2, 3, slice(4, 13), slice(13, 16), 16

FINGER_DEPTH = 0.02
"""From the grasp centre to the fingertips in what we write [m]: of the depths that graspnet-baseline uses (1 to 4 cm)
one that lies between the pads of any hand. A reader takes the depth of each row, whatever it is."""
FINGER_HEIGHT = 0.02
"""Finger thickness that the format's own tools assume [m]."""
UNKNOWN_OBJECT = -1.0


def write_graspnet(grasps: GraspSet, path: Path, gripper: Gripper) -> None:
    """Write grasps of a two-finger hand, with the opening of the preshape that each arrives with as its width."""
    if len(gripper.fingers) != 2:
        raise GraspmatchError(
            f"Cannot write {path}: GraspNet's format is for two fingers, {gripper.name} has {len(gripper.fingers)}. "
            "Possible: .npz, .yaml."
        )
    if grasps.preshape_names != tuple(preshape.name for preshape in gripper.preshapes):
        raise GraspmatchError(
            f"Cannot write {path}: the width of a row is that of a preshape of {gripper.name}, and the grasps arrive "
            "in others. Possible: to read them with that gripper given."
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
    jaws = [jaw(preshape, gripper) for preshape in gripper.preshapes]
    preshape = fitting_preshape(rows[:, WIDTH], np.array([each.opening for each in jaws]))
    rotation = rows[:, ROTATION].reshape(-1, 3, 3)
    tip_world = rows[:, TRANSLATION] + rows[:, DEPTH, None] * rotation[:, :, 0]
    R_world_gripper = rotation @ _R_gripper_jaw(gripper).T
    tip_gripper = np.array([each.tip_centre for each in jaws])[preshape]
    T = se3.from_parts(R_world_gripper, tip_world - np.einsum("nij,nj->ni", R_world_gripper, tip_gripper))
    return foreign_grasps(Found(T_world_gripper=T, score=rows[:, SCORE], preshape=preshape), path, gripper)


def _R_gripper_jaw(gripper: Gripper) -> Float[np.ndarray, "3 3"]:
    """The format's axes in the gripper frame: those of the canonical frame, named in another order."""
    return gripper.T_gripper_canonical[:3, [2, 0, 1]]


def _load(path: Path) -> Float[np.ndarray, "n 17"]:
    """The rows of a file, checked."""
    check_readable(path)
    try:
        with path.open("rb") as file:
            rows = np.lib.format.read_array(file, allow_pickle=False)
    except Exception as error:  # the bytes are anyone's, and NumPy fails on them in ways of its own
        raise GraspmatchError(f"{path} is no .npy file of numbers: {one_line(error)}{disguise(path)}.") from error
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or rows.dtype.kind != "f":
        raise GraspmatchError(
            f"{path} is not a GraspGroup of GraspNet: it holds {rows.dtype} of the shape {rows.shape}, "
            f"expected floats of the shape (n, {COLUMNS})."
        )
    rows = rows.astype(float)
    good = np.isfinite(rows).all(axis=-1)
    if not good.all():
        raise GraspmatchError(f"{path}: row {np.argmin(good)} has a number that is not finite.")
    with np.errstate(over="ignore"):  # of matrices that are far from rotations
        good = se3.is_rigid(se3.from_parts(rows[:, ROTATION].reshape(-1, 3, 3), rows[:, TRANSLATION]))
    if not good.all():
        raise GraspmatchError(f"{path}: columns 4 to 12 of row {np.argmin(good)} are no rotation matrix.")
    return rows
