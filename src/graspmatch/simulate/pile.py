"""Piles: several objects dropped onto the table, and what becomes of them when one is lifted out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from graspmatch.config import LiftConfig
from graspmatch.errors import GraspmatchError
from graspmatch.geometry.se3 import apply, from_parts, rotation_exp
from graspmatch.gripper.kinematics import HandModel
from graspmatch.simulate.lift import lift_in, lift_physics
from graspmatch.simulate.motion import Run
from graspmatch.simulate.rigid_body import RigidBody
from graspmatch.simulate.verdict import Verdict
from graspmatch.simulate.world import (
    Physics,
    World,
    add_object,
    body_pose,
    build_world,
    compile_spec,
    free_joint_values,
    new_spec,
    other_name,
    place,
)

Array = np.ndarray

WALL = 0.16
"""Half a side of the box without a lid in which a pile comes to rest, before its walls are taken away [m]."""
DROP_HEIGHT, DROP_SPREAD = 0.05, 0.05
"""From how far above the top of the one before each object falls, and how far from the middle, along x and y [m]."""
FARTHEST = 0.2
"""An object whose centre of mass comes to rest farther from the middle is of no pile [m]."""
FALLING, COMING_TO_REST = 2.5, 4.0
"""At most so long [s]."""
REST_SPEED, REST_SECONDS = 5e-3, 0.2
"""Slower than this [m/s] for so long [s] is at rest."""
DRAWS = 20
"""Of a pile, until one stays together."""


@dataclass(frozen=True, eq=False)
class Pile:
    """Objects at rest on the table z = 0."""

    objects: tuple[RigidBody, ...]
    T_world_object: Float[Array, "k 4 4"]

    def __len__(self) -> int:
        return len(self.objects)

    def without(self, index: int) -> Pile:
        """All but one of them, where they are."""
        rest = [i for i in range(len(self)) if i != index]
        return Pile(tuple(self.objects[i] for i in rest), self.T_world_object[rest])


def drop(objects: Sequence[RigidBody], config: LiftConfig, rng: np.random.Generator) -> Pile:
    """The objects fall one after the other, turned at random, into a box whose walls are then taken away.

    Raises `GraspmatchError` where they roll apart or never come to rest, in many draws.
    """
    physics = lift_physics(config)
    for _ in range(DRAWS):
        T = _above_one_another(objects, rng)
        fallen, _ = _moved(objects, T, physics, FALLING, walls=True)
        T, is_still = _moved(objects, fallen, physics, COMING_TO_REST)
        centres = [apply(pose, body.centre_of_mass[None])[0] for pose, body in zip(T, objects, strict=True)]
        if is_still and np.linalg.norm(np.array(centres)[:, :2], axis=-1).max() < FARTHEST:
            return Pile(tuple(objects), T)
    names = ", ".join(body.name for body in objects)
    raise GraspmatchError(f"No pile of {names} came to rest in {DRAWS} draws: take other objects.")


def settled(pile: Pile, config: LiftConfig) -> Pile:
    """The pile after whatever still moves in it has come to rest, or after some seconds."""
    if not len(pile):
        return pile
    T, _ = _moved(pile.objects, pile.T_world_object, lift_physics(config), COMING_TO_REST)
    return Pile(pile.objects, T)


def try_in_pile(
    pile: Pile,
    index: int,
    hand: HandModel,
    T_world_pregrasp: Float[Array, "4 4"],
    T_world_gripper: Float[Array, "4 4"],
    pregrasp_joints: Float[Array, "d"],
    config: LiftConfig,
) -> tuple[Verdict, Pile]:
    """Protocol `lift` for one object of a pile, among all others; and where everything is afterwards."""
    rest = pile.without(index)
    world = build_world(pile.objects[index], hand, lift_physics(config), rest.objects)
    start = T_world_gripper.copy()
    start[:3, 3] = T_world_pregrasp[:3, 3]
    target = pile.T_world_object[index]
    run = Run(world, place(world, start, target, pregrasp_joints, list(rest.T_world_object)))
    verdict = lift_in(run, T_world_gripper, target, config)
    return verdict, Pile(pile.objects, _poses(world, run.data, index))


def _poses(world: World, data: mujoco.MjData, index: int) -> Float[Array, "k 4 4"]:
    """Of all objects, the target at its place among them."""
    mujoco.mj_kinematics(world.model, data)
    bodies = list(world.other_bodies)
    bodies.insert(index, world.object_body)
    return np.array([body_pose(data, body) for body in bodies])


def _above_one_another(objects: Sequence[RigidBody], rng: np.random.Generator) -> Float[Array, "k 4 4"]:
    """Turned at random, none touching another."""
    poses, height = [], 0.0
    for body in objects:
        corners = np.concatenate([part.vertices for part in body.parts]) - body.centre_of_mass
        R = rotation_exp(rng.normal(size=3) * np.pi / np.sqrt(3))
        low, high = (corners @ R.T)[:, 2].min(), (corners @ R.T)[:, 2].max()
        centre = np.r_[rng.uniform(-DROP_SPREAD, DROP_SPREAD, 2), height + DROP_HEIGHT - low]
        poses.append(from_parts(R, centre - R @ body.centre_of_mass))
        height += DROP_HEIGHT + high - low
    return np.array(poses)


def _moved(
    objects: Sequence[RigidBody], T: Float[Array, "k 4 4"], physics: Physics, seconds: float, *, walls: bool = False
) -> tuple[Float[Array, "k 4 4"], bool]:
    """Where the objects are after so long, or as soon as all are at rest; and whether they are."""
    spec = new_spec(physics)
    names = [other_name(i) for i in range(len(objects))]
    for name, body in zip(names, objects, strict=True):
        add_object(spec, body, name)
    if walls:
        _add_walls(spec)
    model = compile_spec(spec, physics)
    data = mujoco.MjData(model)
    for name, pose in zip(names, T, strict=True):
        data.qpos[model.joint(name).qposadr[0] :][:7] = free_joint_values(pose)
    quiet = 0.0
    for _ in range(round(seconds / physics.time_step)):
        mujoco.mj_step(model, data)
        quiet = quiet + physics.time_step if _speed(objects, data) < REST_SPEED else 0.0
        if quiet >= REST_SECONDS:
            break
    mujoco.mj_kinematics(model, data)
    return np.array([body_pose(data, model.body(name).id) for name in names]), quiet >= REST_SECONDS


def _speed(objects: Sequence[RigidBody], data: mujoco.MjData) -> float:
    """Of the fastest part of any object, at most [m/s]."""
    velocity = data.qvel.reshape(len(objects), 6)
    reach = [np.sqrt(np.trace(body.inertia) / body.mass) for body in objects]
    return float(np.max(np.linalg.norm(velocity[:, :3], axis=-1) + reach * np.linalg.norm(velocity[:, 3:], axis=-1)))


def _add_walls(spec: mujoco.MjSpec) -> None:
    """Four planes that face inwards."""
    table = next(geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE)
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=(1, 1, 0.1),
            pos=(WALL * x, WALL * y, 0),
            zaxis=(-x, -y, 0),
            contype=table.contype,
            conaffinity=table.conaffinity,
        )
