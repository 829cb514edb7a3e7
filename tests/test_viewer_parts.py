"""What the viewer computes before it draws: motions, forks, contacts, colours, tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspmatch.apps.viewer.contacts import cone, contacts_of
from graspmatch.apps.viewer.forks import forks_at
from graspmatch.apps.viewer.motion import CLOSED, LIFT_HEIGHT, completed, moment
from graspmatch.apps.viewer.palette import SCALE, colours_of_scores
from graspmatch.config import PlannerConfig
from graspmatch.geometry.cloud import nearest
from graspmatch.geometry.mesh import face_normals_areas
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import mug
from graspmatch.types import GraspSet, Plane

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_mesh(mug())


@pytest.fixture(scope="module")
def grasps(scene: Scene) -> GraspSet:
    return plan(scene, load_gripper("franka_hand"), PlannerConfig(device="cpu"))


def test_a_grasp_moves_as_it_was_planned(grasps: GraspSet) -> None:
    start, closed, end = (moment(grasps, 1, share, UP) for share in (0.0, CLOSED, 1.0))
    np.testing.assert_array_equal(start.T_world_gripper, grasps.T_world_pregrasp[1])
    np.testing.assert_array_equal(start.joints, grasps.pregrasp_joints[1])
    np.testing.assert_array_equal(closed.T_world_gripper, grasps.T_world_gripper[1])
    np.testing.assert_allclose(closed.joints, grasps.grasp_joints[1])
    np.testing.assert_allclose(end.T_world_gripper[:3, 3], grasps.T_world_gripper[1, :3, 3] + LIFT_HEIGHT * UP)
    np.testing.assert_array_equal(end.joints, grasps.grasp_joints[1])
    assert [m.phase for m in (start, closed, end)] == ["pregrasp", "grasp", "lift"]


def test_the_motion_has_no_jumps(grasps: GraspSet) -> None:
    way = [moment(grasps, 0, share, UP) for share in np.linspace(0, 1, 401)]
    places, joints = (np.array([getattr(m, name) for m in way]) for name in ("T_world_gripper", "joints"))
    assert np.abs(np.diff(places, axis=0)).max() < 0.002
    assert np.abs(np.diff(joints, axis=0)).max() < 0.002


def test_what_a_file_does_not_know_is_made_up(grasps: GraspSet) -> None:
    unknown = replace(
        grasps,
        T_world_pregrasp=np.full_like(grasps.T_world_pregrasp, np.nan),
        grasp_joints=np.full_like(grasps.grasp_joints, np.nan),
    )
    whole = completed(unknown, load_gripper("franka_hand"))
    np.testing.assert_allclose(whole.T_world_pregrasp, grasps.T_world_pregrasp)
    np.testing.assert_array_equal(whole.grasp_joints, grasps.pregrasp_joints)


def test_contacts_lie_on_the_object_and_push_into_it(scene: Scene, grasps: GraspSet) -> None:
    contacts = contacts_of(scene, load_gripper("franka_hand"), grasps, "cpu")
    assert len(contacts) == len(grasps)
    best = contacts[0]
    assert len(best.points) >= 2
    np.testing.assert_allclose(np.linalg.norm(best.pushes, axis=-1), 1, atol=1e-5)
    together = np.concatenate([scene.target.points, best.points])
    distance, index = nearest(together, len(together) // 100)
    on_object = [
        next(d for d, j in zip(distance[i], index[i], strict=True) if j < len(scene.target.points))
        for i in range(len(scene.target.points), len(together))
    ]
    assert max(on_object) < 0.012  # the object gives way by some millimetres before it is held
    assert best.pushes.sum(axis=0) @ best.pushes.sum(axis=0) < len(best.pushes) ** 2 / 4  # they oppose each other


def test_grasps_of_an_unknown_preshape_have_no_contacts(scene: Scene, grasps: GraspSet) -> None:
    foreign = replace(grasps, preshape_names=("given",), preshape=np.zeros_like(grasps.preshape))
    assert all(len(c.points) == 0 for c in contacts_of(scene, load_gripper("franka_hand"), foreign, "cpu"))


def test_forks_end_where_the_fingers_meet(grasps: GraspSet) -> None:
    gripper = load_gripper("franka_hand")
    lines = forks_at(gripper, grasps.T_world_gripper).reshape(len(grasps), 4, 2, 3)
    tips = lines[:, 2:, 1]
    tcp = grasps.T_world_gripper[:, :3, :3] @ gripper.tool_centre_point + grasps.T_world_gripper[:, :3, 3]
    np.testing.assert_allclose(tips.mean(axis=1), tcp, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(tips[:, 0] - tips[:, 1], axis=-1), gripper.opening, rtol=1e-5)


def test_a_cone_is_as_wide_as_it_is_high_and_faces_outwards() -> None:
    shape = cone()
    normals, _ = face_normals_areas(shape)
    middles = shape.vertices[shape.faces].mean(axis=1)
    assert np.all(np.sum(normals[:, :2] * middles[:, :2], axis=-1) > 0)
    np.testing.assert_allclose(np.linalg.norm(shape.vertices[1:, :2], axis=-1), shape.vertices[1:, 2])


def test_colours_go_from_the_lowest_score_to_the_highest() -> None:
    colours = colours_of_scores(np.array([0.2, 0.9, 0.55]))
    np.testing.assert_array_equal(colours[:2], SCALE[[0, -1]].astype(np.uint8))
    np.testing.assert_array_equal(colours_of_scores(np.full(3, 0.5)), np.tile(SCALE[-1], (3, 1)).astype(np.uint8))
    assert colours_of_scores(np.zeros(0)).shape == (0, 3)


def test_the_table_lies_under_what_stands_on_it() -> None:
    pytest.importorskip("viser", reason="needs viser: pip install 'graspmatch[view]'")
    from graspmatch.apps.viewer.stage import creased_mesh, table_patch
    from graspmatch.geometry.se3 import matrix_from_quaternion

    points = np.random.default_rng(0).uniform(0.9, 1.1, (50, 3))
    normal = np.array([0.6, 0.0, 0.8])
    corners, wxyz, position = table_patch(Plane(normal, float((points @ normal).min())), points)
    world = corners @ matrix_from_quaternion(wxyz).T + position
    np.testing.assert_allclose(world @ normal, (points @ normal).min())
    creased = creased_mesh(mug())
    np.testing.assert_allclose(creased.vertices[creased.faces], mug().vertices[mug().faces])
