"""Protocols without gravity or a table: `fc6` pushes the held object along six axes, `tug` pulls it five times."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from graspmatch.config import ForceClosureConfig, TugConfig
from graspmatch.simulate.contacts import touch
from graspmatch.simulate.motion import Recording, Run
from graspmatch.simulate.verdict import Verdict, in_hand, verdict_of
from graspmatch.simulate.world import Physics, World, place

Array = np.ndarray

PUSHES = {f"{sign}{axis}": (1 if sign == "+" else -1) * np.eye(3)[i] for i, axis in enumerate("xyz") for sign in "+-"}
PULLS = np.array([(0, 0, 1), (0, 2, 1), (0, -2, 1), (2, 0, 1), (-2, 0, 1)], dtype=float)


def force_closure_physics(config: ForceClosureConfig) -> Physics:
    """The engine's settings for `fc6`, but for the integrator of its pushes."""
    return Physics(
        config.time_step,
        config.friction,
        config.torsional_friction,
        impratio=10.0,
        noslip_iterations=2,
        gravity=False,
        has_table=False,
    )


def tug_physics(config: TugConfig) -> Physics:
    """The engine's settings for `tug`."""
    return Physics(config.time_step, config.friction, config.torsional_friction, gravity=False, has_table=False)


def force_closure(
    world: World,
    T_world_gripper: Float[Array, "4 4"],
    pregrasp_joints: Float[Array, "d"],
    T_world_object: Float[Array, "4 4"],
    config: ForceClosureConfig,
    recording: Recording | None = None,
) -> Verdict:
    """Try one grasp by protocol `fc6`.

    The fingers close with the integrator `discrete`: `implicitfast`, which the protocol asks for, solves contacts and
    couplings without the drives' damping, and throws the object out of the hand. The pushes are with `implicitfast`.
    """
    world.model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_DISCRETE)
    run = Run(world, place(world, T_world_gripper, T_world_object, pregrasp_joints), recording)
    depth = touch(world, run.data).depth
    if depth > config.deepest_start:
        return verdict_of(run, "the hand begins inside the object")
    run.phase = "close"
    for _ in run.close(config.closing_seconds, squeeze=config.squeeze_seconds):
        pass
    touched = touch(world, run.data)
    if not touched.fingers:
        return verdict_of(run, "missed")
    world.model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    world.model.dof_damping[world.drive_dof] = 0  # at rest they are not needed
    grasp = mujoco.MjData(world.model)
    limits = world.model.jnt_range.copy()
    mujoco.mj_copyData(grasp, world.model, run.data)
    begin, worst = in_hand(world, grasp), verdict_of(run, "", touched=touched)
    for name, direction in PUSHES.items():
        mujoco.mj_copyData(run.data, world.model, grasp)
        world.model.jnt_range[:] = limits
        run.phase = f"push {name}"
        run.data.xfrc_applied[world.object_body, :3] = config.force * direction
        for _ in run.wait(config.push_seconds):
            pass
        verdict = verdict_of(run, "", begin=begin, touched=touched)
        if not verdict.held:
            return verdict
        if verdict.slip > config.largest_slip or verdict.turn > config.largest_turn:
            return verdict_of(run, f"moved by a push along {name}", begin=begin, touched=touched)
        worst = max(worst, verdict, key=lambda v: v.slip)
    return worst


def tug(
    world: World,
    T_world_gripper: Float[Array, "4 4"],
    pregrasp_joints: Float[Array, "d"],
    T_world_object: Float[Array, "4 4"],
    config: TugConfig,
    recording: Recording | None = None,
) -> Verdict:
    """Try one grasp by protocol `tug`."""
    run = Run(world, place(world, T_world_gripper, T_world_object, pregrasp_joints), recording)
    run.phase = "close"
    for _ in run.close(config.closing_seconds, squeeze=0.0):
        pass
    touched = touch(world, run.data)
    if not touched.fingers:
        return verdict_of(run, "missed")
    begin = in_hand(world, run.data)
    run.phase = "pull"
    for pull in PULLS / np.linalg.norm(PULLS, axis=-1, keepdims=True):
        run.data.xfrc_applied[world.object_body, :3] = config.acceleration * world.target.mass * pull
        for _ in run.wait(config.pull_seconds):
            pass
    lost = touched.fingers - touch(world, run.data).fingers
    return verdict_of(run, "a finger lost the object" if lost else "", begin=begin, touched=touched)
