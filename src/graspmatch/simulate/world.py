"""The world of a trial: an object on a table and a hand, as one MuJoCo model, and what to ask of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

from graspmatch.errors import GraspmatchError
from graspmatch.geometry.se3 import from_parts, quaternion_from_matrix
from graspmatch.gripper.description import keep_no_log
from graspmatch.gripper.kinematics import HandModel, solve_posture
from graspmatch.simulate.hand import BASE, BASE_AXES, HAND_BIT, OBJECT_BIT, SYNERGY, TABLE_BIT, add_hand
from graspmatch.simulate.rigid_body import RigidBody
from graspmatch.simulate.shape import PREFIX

Array = np.ndarray

OBJECT, TABLE = "object", "table"
CONTACT_SOLREF, CONTACT_SOLIMP = (0.005, 1.0), (0.95, 0.99, 1e-3, 0.5, 2.0)
"""Of every contact: stiff, a tenth of a millimetre at the forces of a grasp."""


@dataclass(frozen=True)
class Physics:
    """Settings of the engine that a protocol chooses."""

    time_step: float
    """[s]"""
    friction: float
    """Sliding friction of every contact."""
    torsional_friction: float
    """[m]"""
    integrator: int = int(mujoco.mjtIntegrator.mjINT_DISCRETE)
    impratio: float = 50.0
    noslip_iterations: int = 0
    gravity: bool = True
    has_table: bool = True


@dataclass(frozen=True, eq=False)
class World:
    """A compiled model with the addresses of its parts. The model is changed from trial to trial, the rest is not."""

    model: mujoco.MjModel
    target: RigidBody
    hand: HandModel
    object_body: int
    object_qpos: int
    object_dof: int
    hand_root: int
    """Body of the gripper frame."""
    base_qpos: Int[Array, "6"]
    base_servo: Int[Array, "6"]
    base_gain: Float[Array, "6 2"]
    """Stiffness and damping of each servo."""
    drive_joint: Int[Array, "d"]
    drive_qpos: Int[Array, "d"]
    drive_dof: Int[Array, "d"]
    drive_motor: Int[Array, "d"]
    """-1 where a joint only spreads."""
    synergies: Int[Array, "s"]
    """Constraints that are free to tie joints of a finger to each other."""
    drive_range: Float[Array, "d 2"]
    """Limits of the driven joints in the description."""
    joint_qpos: Int[Array, "q"]
    """Where the model has the joints of the hand ..."""
    posture_qpos: Int[Array, "q"]
    """... and where a posture has them."""
    finger_of_body: Int[Array, "b"]
    """Index of the finger that each body belongs to, or -1."""
    others: tuple[RigidBody, ...] = ()
    """What else lies on the table."""
    other_bodies: tuple[int, ...] = ()
    other_qpos: tuple[int, ...] = ()

    @property
    def link_bodies(self) -> list[int]:
        """The bodies of `hand.links`."""
        return [self.model.body(PREFIX + link.name).id for link in self.hand.links]


def new_spec(physics: Physics) -> mujoco.MjSpec:
    """An empty world, with a table whose top is z = 0."""
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep, option.integrator, option.impratio = physics.time_step, physics.integrator, physics.impratio
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # MuJoCo 4.0.0 has a fault with sparse ones
    option.noslip_iterations = physics.noslip_iterations
    option.gravity = (0, 0, -9.81 if physics.gravity else 0)
    if physics.has_table:
        spec.worldbody.add_geom(
            name=TABLE,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=(1, 1, 0.1),
            contype=TABLE_BIT,
            conaffinity=OBJECT_BIT | HAND_BIT,
        )
    return spec


def add_object(spec: mujoco.MjSpec, target: RigidBody, name: str = OBJECT) -> None:
    """A free body of convex parts, with the frame of the mesh."""
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    moments, axes = np.linalg.eigh(target.inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = target.mass, target.centre_of_mass, moments
    body.iquat = quaternion_from_matrix(axes)
    for i, part in enumerate(target.parts):
        mesh = spec.add_mesh(name=f"{name}_part_{i}")
        mesh.uservert, mesh.userface = part.vertices.ravel(), part.faces.ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh.name,
            contype=OBJECT_BIT,
            conaffinity=TABLE_BIT | HAND_BIT | OBJECT_BIT,
        )


def compile_spec(spec: mujoco.MjSpec, physics: Physics) -> mujoco.MjModel:
    """The model, with one kind of contact everywhere."""
    keep_no_log()  # warnings are counted in the state
    for geom in spec.geoms:
        geom.friction = (physics.friction, physics.torsional_friction, 0.0001)
        geom.condim, geom.solref, geom.solimp, geom.margin = 4, CONTACT_SOLREF, CONTACT_SOLIMP, 0.0
    try:
        return spec.compile()
    except ValueError as error:
        raise GraspmatchError(f"MuJoCo cannot build the world: {error}") from error


def build_world(target: RigidBody, hand: HandModel, physics: Physics, others: Sequence[RigidBody] = ()) -> World:
    """Object, table and hand, and what else lies there."""
    spec = new_spec(physics)
    add_object(spec, target)
    other_names = [other_name(i) for i in range(len(others))]
    for name, other in zip(other_names, others, strict=True):
        add_object(spec, other, name)
    add_hand(spec, hand)
    model = compile_spec(spec, physics)
    drives = [model.joint(PREFIX + name).id for name in hand.joint_names]
    motors = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, PREFIX + name) for name in hand.joint_names]
    base = [model.joint(name).id for name in BASE_AXES]
    base_servo = np.array([model.actuator(name).id for name in BASE_AXES])
    own, names = hand.description.model, hand.description.joint_names
    return World(
        model=model,
        target=target,
        hand=hand,
        object_body=model.body(OBJECT).id,
        object_qpos=int(model.joint(OBJECT).qposadr[0]),
        object_dof=int(model.joint(OBJECT).dofadr[0]),
        hand_root=model.body(PREFIX + hand.card.base_link).id,
        base_qpos=model.jnt_qposadr[base],
        base_servo=base_servo,
        base_gain=-model.actuator_biasprm[base_servo, 1:3],
        drive_joint=np.array(drives),
        drive_qpos=model.jnt_qposadr[drives],
        drive_dof=model.jnt_dofadr[drives],
        drive_motor=np.array(motors),
        synergies=np.array([e for e in range(model.neq) if model.eq(e).name.startswith(SYNERGY)], dtype=int),
        drive_range=model.jnt_range[drives].copy(),
        joint_qpos=np.array([model.joint(PREFIX + name).qposadr[0] for name in names]),
        posture_qpos=np.array([own.joint(name).qposadr[0] for name in names]),
        finger_of_body=_fingers(model, hand),
        others=tuple(others),
        other_bodies=tuple(model.body(name).id for name in other_names),
        other_qpos=tuple(int(model.joint(name).qposadr[0]) for name in other_names),
    )


def other_name(index: int) -> str:
    """Of the body of what else lies on the table."""
    return f"{OBJECT}_{index}"


def place(
    world: World,
    T_world_gripper: Float[Array, "4 4"],
    T_world_object: Float[Array, "4 4"],
    driven: Float[Array, "d"],
    T_world_others: Sequence[Float[Array, "4 4"]] = (),
) -> mujoco.MjData:
    """A new state: the hand at a pose with its driven joints at given values, all objects at their poses and at rest.

    The servos of the base count from this pose, along the axes of the world.
    """
    model = world.model
    base = model.body(BASE).id
    # The base keeps the world's axes, so that it turns about them by small angles only; its child carries the rotation.
    model.body_pos[base] = T_world_gripper[:3, 3]
    model.body_quat[base] = (1, 0, 0, 0)
    model.body_pos[world.hand_root] = 0
    model.body_quat[world.hand_root] = quaternion_from_matrix(T_world_gripper[:3, :3])
    data = mujoco.MjData(model)
    data.qpos[world.joint_qpos] = solve_posture(world.hand, driven)[world.posture_qpos]
    free_joints = (world.object_qpos, *world.other_qpos)
    for qpos, T in zip(free_joints, (T_world_object, *T_world_others), strict=True):
        data.qpos[qpos:][:7] = free_joint_values(T)
    mujoco.mj_forward(model, data)
    return data


def free_joint_values(T: Float[Array, "4 4"]) -> Float[Array, "7"]:
    """Position and quaternion of a pose, as a free joint has them."""
    return np.r_[T[:3, 3], quaternion_from_matrix(T[:3, :3])]


def object_pose(world: World, data: mujoco.MjData) -> Float[Array, "4 4"]:
    """T_world_object of the frame of the mesh."""
    return body_pose(data, world.object_body)


def gripper_pose(world: World, data: mujoco.MjData) -> Float[Array, "4 4"]:
    """T_world_gripper."""
    return body_pose(data, world.hand_root)


def body_pose(data: mujoco.MjData, body: int) -> Float[Array, "4 4"]:
    """T_world_body."""
    return from_parts(data.xmat[body].reshape(3, 3), data.xpos[body])


def _fingers(model: mujoco.MjModel, hand: HandModel) -> Int[Array, "b"]:
    fingers = np.full(model.nbody, -1)
    for i, finger in enumerate(hand.card.fingers):
        for link in finger.links:
            fingers[model.body(PREFIX + link).id] = i
    return fingers
