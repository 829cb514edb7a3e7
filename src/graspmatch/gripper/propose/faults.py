"""What is wrong with a description, said by the link or joint that it is about and with what to do."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from graspmatch.errors import GraspmatchError
from graspmatch.gripper.description import MOVING, geom_mesh, is_below, solid_geoms
from graspmatch.gripper.propose.drives import Drives
from graspmatch.gripper.propose.tree import Tree, can_move

LARGEST_LINK, SMALLEST_HAND = 0.8, 0.01
"""Of any hand, across [m]."""
LEAST_TURN = np.radians(5)
"""A hand in which no hinge turns farther has its angles in another unit."""


def refuse_wrong_units(model: mujoco.MjModel, path: Path, tree: Tree) -> None:
    """Raise where lengths or angles cannot be meant in metres and radians."""
    hand = [b for b in range(model.nbody) if is_below(model, b, tree.base) and solid_geoms(model, b)]
    sizes = {}
    for body in hand:
        points = np.concatenate([geom_mesh(model, g).vertices for g in solid_geoms(model, body)])
        sizes[body] = float(np.ptp(points, axis=0).max())
    largest = max(sizes, key=lambda body: sizes[body])
    name, size = model.body(largest).name, sizes[largest]
    if size > LARGEST_LINK:
        raise GraspmatchError(
            f"{path}: the link '{name}' is {size:.3g} m across, too large for a hand. If its mesh is in millimetres, "
            'give the mesh scale="0.001 0.001 0.001"; if it is no part of the hand, give --root.'
        )
    if max(sizes.values()) < SMALLEST_HAND:
        raise GraspmatchError(
            f"{path}: the largest link, '{name}', is {1000 * size:.2g} mm across, too small for a hand. Lengths are in "
            "metres; is a mesh scaled twice?"
        )
    hinges = [j for branch in tree.branches for j in branch.joints if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    limited = [j for j in hinges if model.jnt_limited[j]]
    if limited and len(limited) == len(hinges) and max(np.ptp(model.jnt_range[limited], axis=1)) < LEAST_TURN:
        name, turn = model.joint(limited[0]).name, float(np.ptp(model.jnt_range[limited[0]]))
        raise GraspmatchError(
            f"{path}: no hinge of the hand turns farther than 5 degrees; the joint '{name}' has a range of "
            f"{np.degrees(turn):.2g} degrees. If its limits are radians, an MJCF says so with "
            '<compiler angle="radian"/>; a URDF has radians always.'
        )


def stiff_and_loose(model: mujoco.MjModel, tree: Tree, drives: Drives) -> list[str]:
    """Joints that a person should look at: those that cannot move, and those that nothing moves."""
    joints = [
        j
        for j in range(model.njnt)
        if is_below(model, int(model.jnt_bodyid[j]), tree.base) and model.jnt_bodyid[j] != tree.base
    ]
    found = []
    for j in joints:
        if int(model.jnt_type[j]) in MOVING and not can_move(model, j):
            found.append(f"The joint '{model.joint(j).name}' has limits without room between them: taken as fixed.")
    for j in drives.passive:
        if not model.jnt_stiffness[j].any():
            found.append(
                f"Nothing moves the joint '{model.joint(j).name}': no motor, no spring, no equality. If it is part of "
                "a linkage, close that with <equality> or <mimic>; if it follows another joint, give it a coupling."
            )
    return found
