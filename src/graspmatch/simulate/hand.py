"""A hand in the simulator: its description on a stiff base that moves freely, driven as its card says."""

from __future__ import annotations

import mujoco
import numpy as np

from graspmatch.gripper.description import load_spec
from graspmatch.gripper.kinematics import HandModel
from graspmatch.simulate.shape import PREFIX, give_true_shapes

BASE = "base"
BASE_AXES = ("x", "y", "z", "turn_x", "turn_y", "turn_z")
"""Joints and servos of the base."""
HAND_BIT, OBJECT_BIT, TABLE_BIT = 1, 2, 4
"""Collision classes: the hand meets the object and the table, not itself."""

ARM_INERTIA = (5.0, 5.0, 5.0, 0.1, 0.1, 0.1)
"""What the arm adds to the hand along and about each axis [kg, kg m2]."""
BASE_STIFFNESS = (1e5, 1e5, 1e5, 2e3, 2e3, 2e3)
"""[N/m, N m/rad]: half a millimetre at 50 N."""
BASE_LIMIT = (150.0, 150.0, 150.0, 30.0, 30.0, 30.0)
"""What the arm can press with [N, N m]."""
ARMATURE = {mujoco.mjtJoint.mjJNT_SLIDE: 0.1, mujoco.mjtJoint.mjJNT_HINGE: 1e-3}
"""Inertia of a drive [kg, kg m2], where the description gives less."""
MOST_DAMPING = {mujoco.mjtJoint.mjJNT_SLIDE: 1.0, mujoco.mjtJoint.mjJNT_HINGE: 0.01}
"""Of a joint [N s/m, N m s], where the description gives more: files are careless, and the drive has its own."""
FOLLOWER_SHARE = 0.1
"""Of a drive's inertia, for the joints that follow it."""
SYNERGY = "synergy/"
"""Prefix of the constraints by which the joints of a finger move as one; which ones, each trial says."""
STIFF_SOLREF, STIFF_SOLIMP = (0.004, 1.0), (0.99, 0.999, 1e-4, 0.5, 2.0)
"""Of gears, couplings and end stops."""


def add_hand(spec: mujoco.MjSpec, hand: HandModel) -> None:
    """Put the hand into a world, on the joints and servos of `BASE_AXES`, with a motor at every joint that closes.

    What the description has of actuators and contact rules is replaced: the hand does not meet itself, its weight is
    carried by the arm, its couplings and end stops are stiff.
    """
    part, _ = load_spec(hand.description.path)
    for element in [*part.actuators, *part.excludes, *part.pairs, *part.keys, *part.sensors]:
        part.delete(element)
    _agree_on_options(part, spec)
    base = _add_base(spec)
    root = next(body for body in part.bodies if body.name == hand.card.base_link)
    for joint in list(root.joints):
        part.delete(joint)
    base.add_frame().attach_body(root, PREFIX, "")
    spec.assets = {**spec.assets, **part.assets}
    for equality in spec.equalities:
        equality.solref, equality.solimp = STIFF_SOLREF, STIFF_SOLIMP
    _prepare_bodies(base)
    give_true_shapes(spec, base, hand.description)
    _add_couplings(spec, hand)
    _add_drives(spec, hand)


def _agree_on_options(part: mujoco.MjSpec, spec: mujoco.MjSpec) -> None:
    """The simulator's settings are the protocol's, not the description's."""
    for name in ("timestep", "integrator", "cone", "jacobian", "impratio", "solver", "iterations", "noslip_iterations"):
        setattr(part.option, name, getattr(spec.option, name))
    for name in ("tolerance", "ls_iterations", "ls_tolerance", "disableflags", "enableflags", "ccd_iterations"):
        setattr(part.option, name, getattr(spec.option, name))
    part.option.gravity = spec.option.gravity


def _add_base(spec: mujoco.MjSpec) -> mujoco.MjsBody:
    """A body on three slides and three hinges along the world's axes, each with a position servo."""
    base = spec.worldbody.add_body(name=BASE, gravcomp=1)
    types = [mujoco.mjtJoint.mjJNT_SLIDE] * 3 + [mujoco.mjtJoint.mjJNT_HINGE] * 3
    for i, (name, kind) in enumerate(zip(BASE_AXES, types, strict=True)):
        base.add_joint(name=name, type=kind, axis=np.eye(3)[i % 3], armature=ARM_INERTIA[i])
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        damping = 2 * np.sqrt(BASE_STIFFNESS[i] * 1.2 * ARM_INERTIA[i])  # critical, with a hand of a fifth
        servo.set_to_position(kp=BASE_STIFFNESS[i], kv=damping)
        servo.forcelimited, servo.forcerange = True, (-BASE_LIMIT[i], BASE_LIMIT[i])
    return base


def _prepare_bodies(base: mujoco.MjsBody) -> None:
    """Collision classes, weightlessness and the inertia of drives."""
    for body in base.find_all("body"):
        body.gravcomp = 1
        touching = [g for g in body.geoms if g.contype or g.conaffinity] or list(body.geoms)
        for geom in body.geoms:
            touches = any(geom is other for other in touching)
            geom.contype, geom.conaffinity = (HAND_BIT, OBJECT_BIT | TABLE_BIT) if touches else (0, 0)
            geom.priority, geom.gap, geom.solmix = 0, 0.0, 1.0
        for joint in body.joints:
            joint.armature = max(joint.armature, FOLLOWER_SHARE * ARMATURE[joint.type])
            joint.damping = np.clip(joint.damping, 0.0, MOST_DAMPING[joint.type])
            joint.frictionloss = 0
            joint.solref_limit, joint.solimp_limit = STIFF_SOLREF, STIFF_SOLIMP


def _add_couplings(spec: mujoco.MjSpec, hand: HandModel) -> None:
    for follower, coupling in hand.card.couplings.items():
        equality = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=PREFIX + follower,
            name2=PREFIX + coupling.joint,
        )
        equality.data[:2] = coupling.offset, coupling.multiplier
        equality.solref, equality.solimp = STIFF_SOLREF, STIFF_SOLIMP


def _add_drives(spec: mujoco.MjSpec, hand: HandModel) -> None:
    """A motor at each driven joint that closes, and room for constraints by which joints of a finger move as one."""
    for name in hand.joint_names:
        joint = next(j for j in spec.joints if j.name == PREFIX + name)
        joint.armature = max(joint.armature, ARMATURE[joint.type])
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        if hand.card.joints[name].closed is not None:
            drive = spec.add_actuator(name=PREFIX + name, target=PREFIX + name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            drive.set_to_motor()
    for finger in hand.card.fingers:
        for name in finger.joints[1:]:
            equality = spec.add_equality(
                name=f"{SYNERGY}{finger.name}/{name}",
                type=mujoco.mjtEq.mjEQ_JOINT,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                name1=PREFIX + name,
                name2=PREFIX + finger.joints[0],
                active=False,
            )
            equality.solref, equality.solimp = STIFF_SOLREF, STIFF_SOLIMP
