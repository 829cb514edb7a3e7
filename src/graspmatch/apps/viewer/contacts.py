"""Where the closed fingers press on the object, by the planner's own model, and the cones of friction there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from graspmatch.config import GripConfig
from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.geometry.se3 import apply
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.grade import middling
from graspmatch.planner.hold import hold_at, touchable
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet, Gripper

Array = np.ndarray


@dataclass(frozen=True)
class Contacts:
    """The contacts of one grasp, world frame."""

    points: Float[Array, "c 3"]
    """[m]"""
    pushes: Float[Array, "c 3"]
    """Unit vectors along which they push the object."""


def contacts_of(scene: Scene, gripper: Gripper, grasps: GraspSet, device: str) -> list[Contacts]:
    """Of each grasp: where fingers and palm are on the object when it has stopped giving way, without the table.

    Only for grasps whose preshapes are those of the gripper; of others nothing is known, and there are none.
    """
    names = [preshape.name for preshape in gripper.preshapes]
    if not len(grasps) or list(grasps.preshape_names) != names:
        return [Contacts(np.zeros((0, 3)), np.zeros((0, 3)))] * len(grasps)
    config = GripConfig()
    candidates = Candidates(grasps.preshape, grasps.T_world_gripper)
    friction = np.full(len(grasps), middling(config))
    held = hold_at(candidates, friction, touchable(scene, config.points, device), gripper, config, device)
    found = []
    for i, T_world_gripper in enumerate(grasps.T_world_gripper):
        groups = [(g, c) for g, count in enumerate(held.count[i, :-1]) for c in range(count)]  # the last is the table
        group, corner = (np.array(index, dtype=int) for index in (zip(*groups, strict=True) if groups else ((), ())))
        push = held.push[i, group, corner] @ T_world_gripper[:3, :3].T
        found.append(Contacts(apply(T_world_gripper, held.point[i, group, corner]), push))
    return found


def cone(sections: int = 32) -> TriangleMesh:
    """A cone with its tip at the origin that opens along +z, one high and one in radius, without a lid."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle), np.ones(sections)], axis=-1)
    around = np.arange(sections)
    faces = np.stack([np.zeros(sections, dtype=int), 1 + (around + 1) % sections, 1 + around], axis=-1)
    return TriangleMesh(np.concatenate([np.zeros((1, 3)), rim]), faces)
