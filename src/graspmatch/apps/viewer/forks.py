"""Many hands at a glance: each a fork of four lines that shows where it is, where it points and how it closes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.se3 import apply
from graspmatch.types import Gripper

Array = np.ndarray

FINGER, STEM = 0.45, 0.3
"""Lengths of tines and stem, as shares of the distance from the hand's base to its tool centre point."""


def fork(gripper: Gripper) -> Float[Array, "4 2 3"]:
    """Stem, bar and two tines of a hand, gripper frame [m]."""
    tip = gripper.tool_centre_point
    length = max(float(tip @ gripper.approach), 0.02)
    palm = tip - FINGER * length * gripper.approach
    base = palm - STEM * length * gripper.approach
    side = gripper.opening / 2 * gripper.closing
    return np.array([[base, palm], [palm - side, palm + side], [palm - side, tip - side], [palm + side, tip + side]])


def forks_at(gripper: Gripper, T_world_gripper: Float[Array, "n 4 4"]) -> Float[Array, "s 2 3"]:
    """The forks of n hands, four segments each, world frame."""
    lines = fork(gripper).reshape(1, -1, 3)
    return apply(T_world_gripper, np.repeat(lines, len(T_world_gripper), axis=0)).reshape(-1, 2, 3)
