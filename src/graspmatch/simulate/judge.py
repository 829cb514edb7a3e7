"""From grasps and an object to a report: every grasp tried in the simulator by one protocol."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float

from graspmatch.config import ForceClosureConfig, LiftConfig, TugConfig
from graspmatch.errors import GraspmatchError
from graspmatch.geometry.se3 import translation
from graspmatch.gripper.kinematics import HandModel
from graspmatch.simulate.free import force_closure, force_closure_physics, tug, tug_physics
from graspmatch.simulate.lift import lift, lift_physics
from graspmatch.simulate.motion import Recording
from graspmatch.simulate.rigid_body import RigidBody
from graspmatch.simulate.verdict import Verdict
from graspmatch.simulate.world import World, build_world
from graspmatch.types import GraspSet, SimulationReport

Array = np.ndarray
ProtocolConfig = LiftConfig | ForceClosureConfig | TugConfig
ProtocolName = Literal["lift", "fc6", "tug"]

PROTOCOLS: dict[ProtocolName, type[ProtocolConfig]] = {"lift": LiftConfig, "fc6": ForceClosureConfig, "tug": TugConfig}


def protocol_name(config: ProtocolConfig) -> ProtocolName:
    """Under which name the protocol of these settings is known."""
    return next(name for name, kind in PROTOCOLS.items() if isinstance(config, kind))


def world_of(target: RigidBody, hand: HandModel, config: ProtocolConfig) -> World:
    """The world in which a protocol tries grasps; can be used for many."""
    if isinstance(config, LiftConfig):
        return build_world(target, hand, lift_physics(config))
    physics = force_closure_physics(config) if isinstance(config, ForceClosureConfig) else tug_physics(config)
    return build_world(target, hand, physics)


def try_grasp(
    world: World,
    grasps: GraspSet,
    index: int,
    T_world_object: Float[Array, "4 4"],
    config: ProtocolConfig,
    recording: Recording | None = None,
) -> Verdict:
    """The verdict on one grasp of a set, for an object at rest at a pose."""
    joints, T_world_gripper = grasps.pregrasp_joints[index], grasps.T_world_gripper[index]
    if isinstance(config, LiftConfig):
        T_world_pregrasp = grasps.T_world_pregrasp[index]
        if not np.isfinite(T_world_pregrasp).all():  # a file of another tool does not say
            T_world_pregrasp = T_world_gripper @ translation(-config.approach_distance * world.hand.card.approach)
        return lift(world, T_world_pregrasp, T_world_gripper, joints, T_world_object, config, recording)
    if isinstance(config, ForceClosureConfig):
        return force_closure(world, T_world_gripper, joints, T_world_object, config, recording)
    return tug(world, T_world_gripper, joints, T_world_object, config, recording)


def judge(
    grasps: GraspSet,
    target: RigidBody,
    hand: HandModel,
    T_world_object: Float[Array, "4 4"],
    config: ProtocolConfig,
    *,
    watch: Callable[[Iterable[int]], Iterator[int]] = iter,
) -> SimulationReport:
    """Try every grasp of a set, each on the untouched object; `watch` wraps the indices, to show progress.

    For `lift` the table is z = 0 and the object must rest on it (`settle`). Raises `GraspmatchError` where the
    joints of the grasps are not those of the hand.
    """
    check_joints(grasps, hand)
    world = world_of(target, hand, config)
    verdicts, seconds = [], []
    for index in watch(range(len(grasps))):
        begin = time.perf_counter()
        verdicts.append(try_grasp(world, grasps, index, T_world_object, config))
        seconds.append(time.perf_counter() - begin)
    return SimulationReport(
        protocol=protocol_name(config),
        settings=json.dumps(asdict(config)),
        engine=f"MuJoCo {mujoco.__version__}",
        gripper=hand.card.name,
        object=target.name,
        mass=target.mass,
        bulge=target.bulge,
        held=np.array([v.held for v in verdicts], dtype=bool),
        reason=tuple(v.reason for v in verdicts),
        slip=np.array([v.slip for v in verdicts], dtype=float),
        turn=np.array([v.turn for v in verdicts], dtype=float),
        push=np.array([v.push for v in verdicts], dtype=float),
        fingers_touching=np.array([v.fingers for v in verdicts], dtype=int),
        seconds=np.array(seconds, dtype=float),
    )


def check_joints(grasps: GraspSet, hand: HandModel) -> None:
    """Refuse grasps that are not for this hand, or that say nothing of its joints."""
    if grasps.joint_names != hand.joint_names:
        raise GraspmatchError(
            f"The grasps are for the joints {', '.join(grasps.joint_names) or 'none'}; "
            f"{hand.card.name} has {', '.join(hand.joint_names)}."
        )
    if not np.isfinite(grasps.T_world_gripper).all():
        raise GraspmatchError("A pose among the grasps is not finite.")
    if not np.isfinite(grasps.pregrasp_joints).all():
        raise GraspmatchError("The file has no joint values before the grasp (pregrasp), which the simulator needs.")
