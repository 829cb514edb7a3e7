"""Where an object comes to rest on the table, before anything is planned for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float

from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.geometry.se3 import from_parts, translation
from graspmatch.simulate.rigid_body import RigidBody
from graspmatch.simulate.world import OBJECT, Physics, add_object, compile_spec, new_spec

Array = np.ndarray

TOPPLED = np.radians(15.0)
"""An object that turned by more has another pose than the one that was given [rad]."""
ROLLED = 0.03
"""So has one that went farther [m]."""
LEVELS = (0.0, 0.001, 0.002, 0.003, 0.004, 0.005)
"""Heights [m] up to which a foot is levelled, until the object stands: a scanned foot is bumpy."""
LONGEST = 3.0
"""[s]"""
REST_SPEED, REST_SECONDS = 2e-3, 0.2
"""Slower than this in every part [m/s] for so long [s] is at rest."""


@dataclass(frozen=True, eq=False)
class Settled:
    """An object at rest, or one that did not stay."""

    target: RigidBody
    """With the foot that it stands on."""
    T_world_object: Float[Array, "4 4"]
    """On the table z = 0."""
    levelled: float
    """Height up to which the foot was levelled [m]."""
    topples: bool
    """It fell over or rolled away even so: it cannot be judged in this pose."""


def settle(target: RigidBody, friction: float) -> Settled:
    """Let the object down onto the table z = 0 in the orientation of its mesh, above the origin of the mesh."""
    for level in LEVELS:
        levelled = _with_level_foot(target, level) if level else target
        T_world_object, is_still = _let_down(levelled, friction)
        turned = float(np.arccos(np.clip(T_world_object[2, 2], -1, 1)))
        went = float(
            np.linalg.norm(
                (T_world_object[:3, :3] @ target.centre_of_mass + T_world_object[:3, 3])[:2] - target.centre_of_mass[:2]
            )
        )
        if is_still and turned < TOPPLED and went < ROLLED:
            return Settled(levelled, T_world_object, level, topples=False)
    return Settled(target, translation(np.array([0, 0, -_lowest(target)])), 0.0, topples=True)


def _let_down(target: RigidBody, friction: float) -> tuple[Float[Array, "4 4"], bool]:
    """Where the object is at rest, and whether it came to rest."""
    physics = Physics(time_step=0.002, friction=friction, torsional_friction=0.005)
    spec = new_spec(physics)
    add_object(spec, target)
    model = compile_spec(spec, physics)
    data = mujoco.MjData(model)
    data.qpos[2] = -_lowest(target)
    reach = float(max(np.linalg.norm(part.vertices - target.centre_of_mass, axis=-1).max() for part in target.parts))
    quiet = 0.0
    for _ in range(round(LONGEST / physics.time_step)):
        mujoco.mj_step(model, data)
        speed = np.linalg.norm(data.qvel[:3]) + reach * np.linalg.norm(data.qvel[3:6])
        quiet = quiet + physics.time_step if speed < REST_SPEED else 0.0
        if quiet >= REST_SECONDS:
            break
    body = model.body(OBJECT).id
    mujoco.mj_kinematics(model, data)
    return from_parts(data.xmat[body].reshape(3, 3), data.xpos[body]), quiet >= REST_SECONDS


def _with_level_foot(target: RigidBody, height: float) -> RigidBody:
    """Corners of the parts within `height` of the lowest point, let down to it: the parts' hulls stand on them."""
    lowest = _lowest(target)
    parts = []
    for part in target.parts:
        vertices = part.vertices.copy()
        vertices[vertices[:, 2] < lowest + height, 2] = lowest
        parts.append(TriangleMesh(vertices, part.faces))
    return replace(target, parts=tuple(parts))


def _lowest(target: RigidBody) -> float:
    return float(min(part.vertices[:, 2].min() for part in target.parts))
