"""A grasp as a motion: pregrasp, straight approach, closing, lift, with the joint values of the plan."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.se3 import translation
from graspmatch.types import GraspSet, Gripper

Array = np.ndarray

APPROACH, CLOSING, LIFT = 0.05, 0.45, 0.7
"""Where these phases begin on the way from 0 to 1; before, the hand waits at the pregrasp."""
LIFT_HEIGHT = 0.12
"""[m]"""
CLOSED = LIFT
"""The moment at which the fingers have closed."""


@dataclass(frozen=True)
class Moment:
    """Hand and object at one moment."""

    phase: str
    T_world_gripper: Float[Array, "4 4"]
    joints: Float[Array, "d"]
    """Driven joint values."""
    lifted: Float[Array, "3"]
    """How far the object has been carried [m]."""


def moment(grasps: GraspSet, index: int, share: float, up: Float[Array, "3"]) -> Moment:
    """Where a grasp is after a share of its way, from 0 to 1; `up` is the unit vector along which it lifts."""
    pregrasp, grasp = grasps.T_world_pregrasp[index], grasps.T_world_gripper[index]
    open_, closed = grasps.pregrasp_joints[index], grasps.grasp_joints[index]
    if share < APPROACH:
        return Moment("pregrasp", pregrasp, open_, np.zeros(3))
    if share < CLOSING:
        there = (share - APPROACH) / (CLOSING - APPROACH)
        T_world_gripper = grasp.copy()  # the way in is straight and the hand does not turn
        T_world_gripper[:3, 3] = pregrasp[:3, 3] + there * (grasp[:3, 3] - pregrasp[:3, 3])
        return Moment("approach", T_world_gripper, open_, np.zeros(3))
    if share <= LIFT:
        joints = open_ + (share - CLOSING) / (LIFT - CLOSING) * (closed - open_)
        return Moment("closing" if share < LIFT else "grasp", grasp, joints, np.zeros(3))
    lifted = (share - LIFT) / (1 - LIFT) * LIFT_HEIGHT * up
    return Moment("lift", translation(lifted) @ grasp, closed, lifted)


def completed(grasps: GraspSet, gripper: Gripper) -> GraspSet:
    """The grasps with a guess in place of what their file does not know (NaN): the hand's way in, open fingers before
    the grasp, and fingers that stay where they are."""
    back = translation(-gripper.approach_distance * gripper.approach)
    pregrasp = np.where(np.isnan(grasps.T_world_pregrasp), grasps.T_world_gripper @ back, grasps.T_world_pregrasp)
    arriving = np.where(np.isnan(grasps.pregrasp_joints), gripper.open_joints, grasps.pregrasp_joints)
    closed = np.where(np.isnan(grasps.grasp_joints), arriving, grasps.grasp_joints)
    return replace(grasps, T_world_pregrasp=pregrasp, pregrasp_joints=arriving, grasp_joints=closed)
