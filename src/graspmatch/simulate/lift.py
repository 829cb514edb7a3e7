"""Protocol `lift`: approach, close, lift 20 cm in 1.5 s, hold for 5 s."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Float

from graspmatch.config import LiftConfig
from graspmatch.geometry.se3 import apply
from graspmatch.simulate.contacts import Touch, touch
from graspmatch.simulate.motion import Recording, Run
from graspmatch.simulate.verdict import Verdict, angle_between, in_hand, motion_in_hand, verdict_of
from graspmatch.simulate.world import Physics, World, gripper_pose, object_pose, place

Array = np.ndarray

LOST = 0.15
"""An object that has moved this far in the hand does not come back [m]."""
WATCHED = 5
"""Between looks at the object in the hand [time steps]."""


def lift_physics(config: LiftConfig) -> Physics:
    """The engine's settings for this protocol."""
    return Physics(config.time_step, config.friction, config.torsional_friction)


def lift(
    world: World,
    T_world_pregrasp: Float[Array, "4 4"],
    T_world_gripper: Float[Array, "4 4"],
    pregrasp_joints: Float[Array, "d"],
    T_world_object: Float[Array, "4 4"],
    config: LiftConfig,
    recording: Recording | None = None,
) -> Verdict:
    """Try one grasp of an object that rests on the table z = 0."""
    start = T_world_gripper.copy()
    start[:3, 3] = T_world_pregrasp[:3, 3]
    run = Run(world, place(world, start, T_world_object, pregrasp_joints), recording)
    return lift_in(run, T_world_gripper, T_world_object, config)


def lift_in(
    run: Run, T_world_gripper: Float[Array, "4 4"], T_world_object: Float[Array, "4 4"], config: LiftConfig
) -> Verdict:
    """Try one grasp in a world that is ready for it: the hand in its place before the approach, all things at rest."""
    world = run.world
    trouble, push, depth = _approach(run, T_world_gripper, T_world_object, config)
    if trouble:
        return verdict_of(run, trouble, push=push, depth=depth)
    run.phase = "close"
    for _ in run.close(config.closing_seconds, squeeze=config.squeeze_seconds):
        pass
    held = touch(world, run.data)
    if not held.fingers:
        return verdict_of(run, "missed", push=push, touched=held)
    begin = in_hand(world, run.data)
    run.phase = "lift"
    up = np.array([0.0, 0.0, config.lift_height])
    lost = _watch(run, run.move(up, config.lift_seconds), begin)
    if lost or not _holds(run, begin, config.lift_height / 2, config):
        return verdict_of(run, "slipped in the lift", begin=begin, push=push, touched=held)
    run.phase = "hold"
    lost = _watch(run, run.wait(config.hold_seconds), begin)
    if lost or not _holds(run, begin, config.least_height, config):
        return verdict_of(run, "dropped in the hold", begin=begin, push=push, touched=held)
    return verdict_of(run, "", begin=begin, push=push, touched=held)


def _approach(
    run: Run, T_world_gripper: Float[Array, "4 4"], T_world_object: Float[Array, "4 4"], config: LiftConfig
) -> tuple[str, float, float]:
    """What went wrong on the way in, how far the object was moved [m], and the deepest contact [m]."""
    world = run.world
    way = T_world_gripper[:3, 3] - gripper_pose(world, run.data)[:3, 3]
    centre = apply(T_world_object, world.target.centre_of_mass[None])[0]
    met: list[Touch] = []
    for _ in run.move(way, config.approach_seconds):
        if run.data.ncon:
            met.append(touch(world, run.data))
    push = float(np.linalg.norm(apply(object_pose(world, run.data), world.target.centre_of_mass[None])[0] - centre))
    reached = gripper_pose(world, run.data)
    short, askew = (
        float(np.linalg.norm(reached[:3, 3] - T_world_gripper[:3, 3])),
        angle_between(reached, T_world_gripper),
    )
    depth = max((t.depth for t in met), default=0.0)
    for is_wrong, what in (
        (any(t.hand_on_table for t in met), "the hand meets the table"),
        (push > config.largest_push, "the object is pushed away"),
        (any(t.press > config.largest_press for t in met), "the hand presses on the object"),
        (short > config.largest_shortfall or askew > config.largest_tilt, "the hand stops short"),
    ):
        if is_wrong:
            return f"collision in approach: {what}", push, depth
    return "", push, depth


def lowest_point(world: World, data: mujoco.MjData) -> float:
    """Height of the object's lowest point [m]."""
    T = object_pose(world, data)
    return float(min((part.vertices @ T[2, :3]).min() for part in world.target.parts) + T[2, 3])


def _watch(run: Run, steps: Iterator[None], begin: Float[Array, "4 4"]) -> bool:
    """Let the steps go on until the object is lost for good; whether it is."""
    return any(i % WATCHED == 0 and motion_in_hand(run.world, run.data, begin)[0] > LOST for i, _ in enumerate(steps))


def _holds(run: Run, begin: Float[Array, "4 4"], least_height: float, config: LiftConfig) -> bool:
    """Whether the object is off the table, touches the hand and has kept its place in it."""
    slip, turn = motion_in_hand(run.world, run.data, begin)
    is_up = lowest_point(run.world, run.data) > least_height
    kept = slip < config.largest_slip and turn < config.largest_turn
    return is_up and kept and touch(run.world, run.data).hand_on_object
