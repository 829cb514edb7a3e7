"""What a protocol says of one grasp."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from graspmatch.geometry.se3 import apply, inverse
from graspmatch.simulate.contacts import Touch, touch
from graspmatch.simulate.motion import Run
from graspmatch.simulate.world import World, gripper_pose, object_pose

Array = np.ndarray

DEEPEST = 0.01
"""Penetration of hand and object that no contact makes: the simulation has come apart [m]."""


@dataclass(frozen=True)
class Verdict:
    """Whether a grasp held, or else why not."""

    held: bool
    reason: str
    """Empty where it held."""
    slip: float
    """Motion of the object's centre of mass in the hand since the fingers closed [m]."""
    turn: float
    """[rad]"""
    push: float
    """Motion of the object before the fingers closed [m]."""
    depth: float
    """Deepest penetration of hand and object that was seen [m]."""
    fingers: int
    """Fingers on the object when they had closed."""


def verdict_of(
    run: Run,
    reason: str,
    *,
    push: float = 0.0,
    depth: float = 0.0,
    begin: Float[Array, "4 4"] | None = None,
    touched: Touch | None = None,
) -> Verdict:
    """The verdict on a run as it stands: a reason why it failed, or none; a simulation that came apart never held.

    `begin` is T_gripper_object, and `touched` what the hand touched, when the fingers had closed.
    """
    slip, turn = (0.0, 0.0) if begin is None else motion_in_hand(run.world, run.data, begin)
    depth = max(depth, 0.0 if touched is None else touched.depth, touch(run.world, run.data).depth)
    finite = np.isfinite(run.data.qpos).all() and np.isfinite([slip, turn]).all()
    if run.is_broken or not finite or (depth > DEEPEST and not reason):
        reason = "unstable simulation"
    fingers = 0 if touched is None else len(touched.fingers)
    return Verdict(not reason, reason, slip, turn, push, depth, fingers)


def in_hand(world: World, data: mujoco.MjData) -> Float[Array, "4 4"]:
    """T_gripper_object."""
    return inverse(gripper_pose(world, data)) @ object_pose(world, data)


def motion_in_hand(world: World, data: mujoco.MjData, begin: Float[Array, "4 4"]) -> tuple[float, float]:
    """How far the object's centre of mass has moved [m] and the object turned [rad] in the hand since `begin`."""
    now = in_hand(world, data)
    centre = world.target.centre_of_mass[None]
    slip = float(np.linalg.norm(apply(now, centre) - apply(begin, centre)))
    return slip, angle_between(begin, now)


def angle_between(T_a: Float[Array, "4 4"], T_b: Float[Array, "4 4"]) -> float:
    """Of the turn from one pose to another [rad]."""
    cosine = (np.trace(T_a[:3, :3].T @ T_b[:3, :3]) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1, 1)))
