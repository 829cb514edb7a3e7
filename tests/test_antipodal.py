"""The antipodal baseline: opposite contacts, free grasps, and an account of itself where there are none."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

from baselines.antipodal import CLEARANCE, ENOUGH, FRICTION, antipodal, hit_by_rays, opposite_points, sorted_jaws
from baselines.result import grasp_set
from graspmatch.geometry import se3
from graspmatch.geometry.mesh import TriangleMesh, transformed
from graspmatch.gripper.kinematics import load_hand, pose_links
from graspmatch.gripper.load import load_gripper
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, GraspSet, Gripper
from toy_hand import COARSE, write_toy

SIZE = np.array([0.04, 0.03, 0.08])
COSINE = np.cos(np.arctan(FRICTION))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("toy")
    write_toy(folder)
    return folder


@pytest.fixture(scope="module")
def toy(folder) -> Gripper:
    """Opens 60 mm, fingers 60 mm long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GRASPMATCH_CACHE", str(folder / "cache"))
        return load_gripper(folder / "card.toml", baking=COARSE)


def box_scene(size=SIZE) -> Scene:
    """A box on a table, around the z axis."""
    box = trimesh.creation.box(size).apply_translation((0, 0, size[2] / 2))
    return Scene.from_mesh(TriangleMesh(np.array(box.vertices), np.array(box.faces)))


@pytest.fixture(scope="module")
def grasps(toy) -> GraspSet:
    return antipodal(box_scene(), toy, 3)


def test_pairs_are_opposite_points_within_both_friction_cones(toy):
    pairs = opposite_points(box_scene().target, 0.06, np.random.default_rng(0))
    assert len(pairs.width) > 50
    for sign in (-1, 1):
        contact = pairs.middle + sign * pairs.width[:, None] / 2 * pairs.axis - [0, 0, SIZE[2] / 2]
        gap = np.abs(np.abs(contact) - SIZE / 2)  # to each pair of faces
        face = np.argmin(gap, axis=-1)
        rows = np.arange(len(face))
        assert gap[rows, face].max() < 1e-3
        outward = np.sign(contact[rows, face])
        inner = np.sort(gap, axis=-1)[:, 1] > 2e-3  # at an edge either face may be the one
        assert np.all((sign * outward * pairs.axis[rows, face])[inner] > COSINE - 1e-3)
    assert pairs.width.max() <= 0.06


def test_a_ray_takes_a_point_where_it_leaves_the_object(toy):
    # Two sheets across x, one facing the ray's start and one facing away from it, and a third beyond reach.
    yz = np.stack(np.meshgrid(*2 * [np.arange(-0.02, 0.021, 0.002)]), axis=-1).reshape(-1, 2)
    sheets = [(0.0, -1.0), (0.02, 1.0), (0.03, -1.0), (0.09, 1.0)]
    points = np.concatenate([np.insert(yz, 0, x, axis=1) for x, _ in sheets])
    normals = np.repeat([[side, 0.0, 0.0] for _, side in sheets], len(yz), axis=0)
    first = np.flatnonzero(points[:, 0] == 0)[::9]
    direction = np.tile([1.0, 0.0, 0.0], (len(first), 1))
    hit = hit_by_rays(points, normals, first, direction, 0.05, np.random.default_rng(0))
    np.testing.assert_array_equal(points[hit, 0], 0.02)
    assert np.linalg.norm(points[hit, 1:] - points[first, 1:], axis=-1).max() < 0.0025
    nothing = hit_by_rays(points, normals, first, -direction, 0.05, np.random.default_rng(0))
    assert (nothing == -1).all()


def test_the_pads_close_on_opposite_sides_of_the_object(toy, grasps):
    assert 20 < len(grasps) <= ENOUGH
    jaws = sorted_jaws(toy)
    np.testing.assert_allclose(jaws.pad_centre, np.tile([0, 0, 0.045], (3, 1)), atol=1e-6)  # the toy's TCP
    R = grasps.T_world_gripper[:, :3, :3]
    closing, centre = R @ toy.closing, se3.apply(grasps.T_world_gripper, toy.tool_centre_point[None])[:, 0]
    assert (np.abs(closing).max(axis=-1) > COSINE - 1e-3).all()
    assert (np.abs(centre - [0, 0, SIZE[2] / 2]) < SIZE / 2).all()
    assert (np.abs(closing[:, 2]) < 0.9).all()  # 80 mm is wider than the hand
    assert (grasps.fingers_touching == 2).all()
    opening = 2 * (0.03 - grasps.grasp_joints[:, 0])
    assert opening.min() > SIZE.min() - 2 * COARSE.grid_spacing
    assert (grasps.grasp_joints >= grasps.pregrasp_joints).all()


def test_hand_and_way_in_are_free_of_object_and_table(toy, grasps, folder):
    model = load_hand(folder / "card.toml")
    scene = box_scene()
    solid = trimesh.collision.CollisionManager()
    assert scene.mesh is not None
    solid.add_object("box", trimesh.Trimesh(scene.mesh.vertices, scene.mesh.faces))
    for i in range(0, len(grasps), 3):
        T_gripper_link = pose_links(model, grasps.pregrasp_joints[i])
        for back in np.linspace(0, toy.approach_distance, 7):
            T = grasps.T_world_gripper[i] @ se3.translation(-back * toy.approach) @ T_gripper_link
            for link, T_world_link in zip(toy.links, T, strict=True):
                mesh = transformed(link.collision, T_world_link)
                assert mesh.vertices[:, 2].min() > CLEARANCE - 1e-6
                # Not asked for CLEARANCE, since the toy's fields are baked on a grid of 5 mm, which rounds corners off.
                assert solid.in_collision_single(trimesh.Trimesh(mesh.vertices, mesh.faces)) is False


def test_the_preshape_is_the_narrowest_that_clears(toy):
    """Across 10 mm and their clearance the hand needs 24 mm of opening, never 60."""
    grasps = antipodal(box_scene(np.array([0.01, 0.2, 0.08])), toy, 0)
    closing = grasps.T_world_gripper[:, :3, :3] @ toy.closing
    square = np.abs(closing[:, 0]) > 0.99
    assert square.sum() > 3
    assert {grasps.preshape_names[index] for index in grasps.preshape[square]} == {"close_60"}


def test_equal_seeds_give_equal_grasps_and_others_do_not(toy, grasps):
    again = antipodal(box_scene(), toy, 3)
    for name in ("T_world_gripper", "preshape", "pregrasp_joints", "grasp_joints", "score"):
        np.testing.assert_array_equal(getattr(again, name), getattr(grasps, name))
    assert again.tally == grasps.tally
    other = antipodal(box_scene(), toy, 4)
    assert not np.array_equal(other.T_world_gripper[:5], grasps.T_world_gripper[:5])


def test_the_tally_accounts_for_every_candidate(grasps):
    assert grasps.tally["candidates"] == len(grasps) + sum(grasps.tally.values()) - grasps.tally["candidates"]


def test_an_object_wider_than_the_hand_is_explained(toy):
    grasps = antipodal(box_scene(np.array([0.07, 0.07, 0.07])), toy, 0)
    assert len(grasps) == 0
    assert grasps.T_world_gripper.shape == (0, 4, 4)
    assert grasps.tally["no opposite surface in both friction cones and within the opening"] == 2000
    assert "toy opens 60 mm wide" in grasps.explain()


def test_hands_of_more_fingers_are_refused(toy):
    three = dataclasses.replace(toy, fingers=(*toy.fingers, toy.fingers[0]))
    with pytest.raises(GraspmatchError, match="two fingers, toy has 3"):
        antipodal(box_scene(), three, 0)


def test_a_baselines_grasps_are_sorted_and_what_it_does_not_know_is_unknown(toy):
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = [1, 2, 3]
    joints = np.arange(3.0)[:, None]
    score = np.array([0.2, 0.9, 0.5])
    grasps = grasp_set("test", T, np.array([0, 1, 2]), joints, joints + 10, score, toy, {"candidates": 3}, 7)
    assert grasps.score.tolist() == [0.9, 0.5, 0.2]
    assert grasps.T_world_gripper[:, 0, 3].tolist() == [2, 3, 1]
    assert grasps.preshape.tolist() == [1, 2, 0]
    assert grasps.pregrasp_joints.ravel().tolist() == [1, 2, 0]
    assert grasps.grasp_joints.ravel().tolist() == [11, 12, 10]
    assert grasps.T_world_pregrasp[:, :3, 3].tolist() == [[2, 0, -0.15], [3, 0, -0.15], [1, 0, -0.15]]
    assert np.isnan([grasps.clearance, grasps.loss, grasps.matching_error]).all()
    assert (grasps.fingers_touching == -1).all()
    assert grasps.provenance.seed == 7
    assert grasps.provenance.gripper == "toy"
