"""Real objects, real hands: grasps exist, and an independent judge (FCL on the meshes, by trimesh) finds no touch."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspmatch.geometry import se3
from graspmatch.gripper.kinematics import load_hand, pose_links
from graspmatch.gripper.load import load_gripper
from graspmatch.gripper.zoo import card_path
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene

OBJECTS = ("Cat", "Bottle", "LetterP", "Spray", "Glass", "Milk", "Mug", "Shoe", "Shark")
HANDS = ("franka_hand", "barrett_bh282", "kinova_kg3")


def collision_world(mesh: trimesh.Trimesh, table_height: float) -> trimesh.collision.CollisionManager:
    """The object's triangles and a slab of table, which ends a hair below the object."""
    slab = trimesh.creation.box(extents=[3.0, 3.0, 0.1])
    slab.apply_translation([*mesh.bounds.mean(axis=0)[:2], table_height - 0.05])
    world = trimesh.collision.CollisionManager()
    world.add_object("object", mesh)
    world.add_object("table", slab)
    return world


class Body:
    """A hand for the judge: the real triangles of its links."""

    def __init__(self, name: str) -> None:
        self.gripper, self.model = load_gripper(name), load_hand(card_path(name))
        self.links = trimesh.collision.CollisionManager()
        for link in self.gripper.links:
            mesh = trimesh.Trimesh(link.collision.vertices, link.collision.faces, process=False)
            self.links.add_object(link.name, mesh)

    def touches(self, world: trimesh.collision.CollisionManager, T_world_gripper, joints) -> list[tuple[str, str]]:
        """Which link intersects what."""
        for link, T in zip(self.gripper.links, pose_links(self.model, joints), strict=True):
            self.links.set_transform(link.name, T_world_gripper @ T)
        _, pairs = self.links.in_collision_other(world, return_names=True)  # type: ignore[misc]
        return sorted(pairs)


@pytest.mark.parametrize("name", HANDS)
def test_paper_objects_have_grasps_that_touch_nothing(name, shared_data):
    hand = Body(name)
    gripper = hand.gripper
    for object_name in OBJECTS:
        path = shared_data / "objects" / "paper" / object_name / "mesh.stl"
        scene = Scene.from_mesh(path)
        assert scene.table is not None
        assert scene.mesh is not None
        grasps = plan(scene, gripper)
        assert len(grasps) > 0, f"{object_name}: {grasps.explain()}"
        mesh = trimesh.Trimesh(scene.mesh.vertices, scene.mesh.faces, process=False)
        world = collision_world(mesh, scene.table.offset)
        for T, joints in zip(grasps.T_world_gripper, grasps.pregrasp_joints, strict=True):
            for back in np.linspace(0.0, gripper.approach_distance, 6):
                pose = T @ se3.translation(-back * gripper.approach)
                assert not hand.touches(world, pose, joints), f"{object_name}, {back * 1000:.0f} mm back"


def test_the_judge_sees_a_hand_that_is_pushed_into_the_object(shared_data):
    hand = Body("franka_hand")
    scene = Scene.from_mesh(shared_data / "objects" / "paper" / "Milk" / "mesh.stl")
    assert scene.table is not None
    assert scene.mesh is not None
    mesh = trimesh.Trimesh(scene.mesh.vertices, scene.mesh.faces, process=False)
    world = collision_world(mesh, scene.table.offset)
    down = se3.from_parts(np.diag([1.0, -1.0, -1.0]), scene.centre_of_mass + np.array([0, 0, 0.09]))
    assert any("object" in pair for pair in hand.touches(world, down, np.array([0.02])))
    low = se3.from_parts(np.diag([1.0, -1.0, -1.0]), scene.centre_of_mass * [1, 1, 0] + [0.2, 0, 0.09])
    assert any("table" in pair for pair in hand.touches(world, low, np.array([0.04])))
