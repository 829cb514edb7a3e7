"""Simple scenes for the tests of the judge: a box on a table or in the air, and a hand above it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.config import LiftConfig
from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.geometry.se3 import from_parts, translation
from graspmatch.gripper.kinematics import HandModel, load_hand
from graspmatch.gripper.zoo import card_path
from graspmatch.simulate.lift import lift, lift_physics
from graspmatch.simulate.motion import Recording
from graspmatch.simulate.rigid_body import RigidBody, rigid_body
from graspmatch.simulate.verdict import Verdict
from graspmatch.simulate.world import World, build_world

Array = np.ndarray

HANDS = ("franka_hand", "barrett_bh282", "kinova_kg3")
FREELY_PINCHED = 0.5
"""Mass [kg] that every hand carries at friction 0.6, and none at 0.02."""


def box(size: tuple[float, float, float], mass: float) -> RigidBody:
    """A box [m] that stands on z = 0."""
    import trimesh

    made = trimesh.creation.box(extents=size)
    made.apply_translation([0, 0, size[2] / 2])
    mesh = TriangleMesh(np.asarray(made.vertices, dtype=float), np.asarray(made.faces, dtype=int))
    return rigid_body("box", mesh, (mesh,), bulge=0.0, mass=mass)


def cube(mass: float = FREELY_PINCHED) -> RigidBody:
    """5 cm."""
    return box((0.05, 0.05, 0.05), mass)


def hand(name: str) -> HandModel:
    """A built-in hand."""
    return load_hand(card_path(name))


def half_open(model: HandModel) -> Float[Array, "d"]:
    """Wide open for two fingers; for three, so that the tips come together on a way that is short."""
    share = 0.0 if len(model.card.fingers) == 2 else 0.3
    return model.card.open_joints + share * (model.card.closed_joints - model.card.open_joints)


def from_above(model: HandModel, tool_centre_point: tuple[float, float, float]) -> Float[Array, "4 4"]:
    """T_world_gripper that points down with the fingers closing along y, the TCP at a point [m]."""
    card = model.card
    R_gripper = np.stack([np.cross(card.closing, card.approach), card.closing, card.approach], axis=-1)
    R_world = np.stack([np.cross((0, 1, 0), (0, 0, -1)), (0, 1, 0), (0, 0, -1)], axis=-1)
    rotation = R_world @ R_gripper.T
    return from_parts(rotation, np.array(tool_centre_point) - rotation @ card.tool_centre_point)


def pinch(
    model: HandModel,
    target: RigidBody,
    config: LiftConfig,
    *,
    at: tuple[float, float, float] = (0.0, 0.0, 0.03),
    recording: Recording | None = None,
) -> Verdict:
    """Lift the object from above, the TCP at a point [m]."""
    T = from_above(model, at)
    back = T @ translation(-0.15 * model.card.approach)
    return lift(pinch_world(model, target, config), back, T, half_open(model), np.eye(4), config, recording)


def pinch_world(model: HandModel, target: RigidBody, config: LiftConfig) -> World:
    """Its world."""
    return build_world(target, model, lift_physics(config))
