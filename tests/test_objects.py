"""Real objects, real hands: grasps exist, and an independent judge (FCL on the meshes, through trimesh) finds no touch."""

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


def touches(world, gripper, hand, T_world_gripper, joints) -> list[str]:
    """What the hand's link meshes intersect in the given posture."""
    met = set()
    for link, T in zip(gripper.links, pose_links(hand, joints), strict=True):
        body = trimesh.Trimesh(link.collision.vertices, link.collision.faces, process=False)
        hit, names = world.in_collision_single(body, T_world_gripper @ T, return_names=True)
        met |= {f"{link.name} in {name}" for name in names} if hit else set()
    return sorted(met)


@pytest.mark.parametrize("name", HANDS)
def test_paper_objects_have_grasps_that_touch_nothing(name, shared_data):
    gripper, hand = load_gripper(name), load_hand(card_path(name))
    for object_name in OBJECTS:
        path = shared_data / "objects" / "paper" / object_name / "mesh.stl"
        scene = Scene.from_mesh(path)
        assert scene.table is not None and scene.mesh is not None
        grasps = plan(scene, gripper)
        assert len(grasps) > 0, f"{object_name}: {grasps.explain()}"
        mesh = trimesh.Trimesh(scene.mesh.vertices, scene.mesh.faces, process=False)
        world = collision_world(mesh, scene.table.offset)
        for T, joints in zip(grasps.T_world_gripper, grasps.pregrasp_joints, strict=True):
            for back in np.linspace(0.0, gripper.approach_distance, 6):
                pose = T @ se3.translation(-back * gripper.approach)
                assert not touches(world, gripper, hand, pose, joints), f"{object_name}, {back * 1000:.0f} mm back"


def test_the_judge_sees_a_hand_that_is_pushed_into_the_object(shared_data):
    gripper, hand = load_gripper("franka_hand"), load_hand(card_path("franka_hand"))
    scene = Scene.from_mesh(shared_data / "objects" / "paper" / "Milk" / "mesh.stl")
    assert scene.table is not None and scene.mesh is not None
    mesh = trimesh.Trimesh(scene.mesh.vertices, scene.mesh.faces, process=False)
    world = collision_world(mesh, scene.table.offset)
    down = se3.from_parts(np.diag([1.0, -1.0, -1.0]), scene.centre_of_mass + [0, 0, 0.09])
    assert any("object" in touch for touch in touches(world, gripper, hand, down, np.array([0.02])))
    low = se3.from_parts(np.diag([1.0, -1.0, -1.0]), scene.centre_of_mass * [1, 1, 0] + [0.2, 0, 0.09])
    assert any("table" in touch for touch in touches(world, gripper, hand, low, np.array([0.04])))
