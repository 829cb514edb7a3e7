"""SplitPSO, the baseline for multi-finger hands: what its swarm finds on a bottle-like cylinder."""

from __future__ import annotations

import numpy as np
import pytest

from baselines.posed_hand import depths, hand_shape, lowest_corner, shared_axes
from baselines.split_pso import complementarity, optimise, split_pso, start_grasps, target_of
from graspmatch.geometry import se3
from graspmatch.geometry.grid import node_positions
from graspmatch.geometry.mesh import transformed
from graspmatch.gripper.kinematics import load_hand, pose_links
from graspmatch.gripper.load import load_gripper
from graspmatch.gripper.zoo import card_path
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import revolved
from graspmatch.types import GraspmatchError, GraspSet, Gripper

RADIUS, HEIGHT = 0.035, 0.2
SMALL = {"starts": 10, "particles": 12, "iterations": 15}


@pytest.fixture(scope="module")
def barrett() -> Gripper:
    return load_gripper("barrett_bh282")


@pytest.fixture(scope="module")
def cylinder() -> Scene:
    """Standing on the table, away from the origin."""
    side = np.linspace(0, HEIGHT, 9)
    profile = np.array([[0.0, 0.0], *((RADIUS, z) for z in side), [0.0, HEIGHT]])
    return Scene.from_mesh(transformed(revolved(profile).mesh, se3.translation(np.array([0.3, -0.2, 0.1]))))


@pytest.fixture(scope="module")
def grasps(cylinder: Scene, barrett: Gripper) -> GraspSet:
    return split_pso(cylinder, barrett, 0, **SMALL)


def distance_to_cylinder(points: np.ndarray) -> np.ndarray:
    """Signed distance [m], negative inside."""
    x, y, z = (points - [0.3, -0.2, 0.1 + HEIGHT / 2]).T
    out = np.stack([np.hypot(x, y) - RADIUS, np.abs(z) - HEIGHT / 2])
    return np.minimum(out.max(axis=0), 0) + np.linalg.norm(np.maximum(out, 0), axis=0)


def test_blended_link_poses_are_those_of_the_description(barrett: Gripper) -> None:
    hand, model = hand_shape(barrett), load_hand(card_path(barrett.name))
    joints = hand.lower + np.random.default_rng(0).random((10, len(hand.lower))) * (hand.upper - hand.lower)
    exact = np.array([pose_links(model, values) for values in joints])
    corners = np.concatenate([hand.corners, np.zeros_like(hand.corners[:, :1])], axis=1)
    assert np.abs(se3.apply(hand.links(joints), corners) - se3.apply(exact, corners)).max() < 4e-4


def test_fingers_on_one_drive_and_linkages_are_posed_too() -> None:
    gripper = load_gripper("kinova_kg3")
    hand, model = hand_shape(gripper), load_hand(card_path(gripper.name))
    joints = np.random.default_rng(0).uniform(hand.lower, hand.upper)
    assert np.allclose(hand.links(joints[None])[0], pose_links(model, joints), atol=4e-3)


def test_depth_of_points_in_the_hand_is_that_of_the_baked_field(barrett: Gripper) -> None:
    preshape, hand = barrett.preshapes[1], hand_shape(barrett)
    inside = np.argwhere(preshape.hand.values < -0.004)[::7]
    points = (preshape.hand.origin + preshape.hand.spacing * inside).astype(np.float32)
    _, point, depth = depths(hand, hand.links(preshape.joints[None]), points)
    deepest = np.full(len(points), -np.inf)
    np.maximum.at(deepest, point, depth)
    error = deepest + preshape.hand.values[tuple(inside.T)]
    assert np.abs(error).max() < 0.0035
    assert np.abs(error).mean() < 0.0015


def test_cost_falls_over_the_iterations(cylinder: Scene, barrett: Gripper) -> None:
    rng = np.random.default_rng(1)
    hand, target = hand_shape(barrett), target_of(cylinder)
    T, joints, _ = start_grasps(cylinder, hand, target, 6, rng)
    _, _, history = optimise(T, joints, hand, target, 10, 10, rng)
    assert history.shape == (11, 6)
    assert np.all(np.diff(history, axis=0) <= 0)
    assert np.all(history[-1] < 0.9 * history[0])


def test_best_grasp_lies_on_the_surface_and_not_in_it(grasps: GraspSet, cylinder: Scene, barrett: Gripper) -> None:
    hand = hand_shape(barrett)
    T_world_link = grasps.T_world_gripper[0] @ pose_links(load_hand(card_path(barrett.name)), grasps.grasp_joints[0])
    samples = [se3.apply(T, on.points) for T, on in zip(T_world_link, hand.samples, strict=True)]
    distance = distance_to_cylinder(np.concatenate(samples))
    assert distance.min() > -0.005
    assert np.mean(distance < 0.01) > 0.3
    touching = {
        link.name
        for link, points in zip(barrett.links, samples, strict=True)
        if np.abs(distance_to_cylinder(points)).min(initial=np.inf) < 0.005
    }
    assert sum(bool(touching & set(finger.links)) for finger in barrett.fingers) >= 2
    _, _, depth = depths(hand, T_world_link[None].astype(np.float32), cylinder.target.points.astype(np.float32))
    assert depth.max() < 0.005


def test_score_prefers_the_hand_that_fits(cylinder: Scene, barrett: Gripper) -> None:
    hand, target = hand_shape(barrett), target_of(cylinder)
    joints = np.tile(barrett.preshapes[0].joints, (3, 1))
    # Palm 4 mm off the side, 20 mm off, and out of reach.
    R = se3.rotation_facing(np.array([-1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    touching = RADIUS + 0.09
    at = np.array([[touching + away, 0.0, 0.0] for away in (0.004, 0.02, 0.2)])
    fit = complementarity(se3.from_parts(R, at).astype(np.float32)[:, None] @ hand.links(joints), hand, target)
    assert fit[0] > fit[1] > fit[2] == 0


def test_pregrasps_are_more_open_and_free_of_object_and_table(
    grasps: GraspSet, cylinder: Scene, barrett: Gripper
) -> None:
    hand, model = hand_shape(barrett), load_hand(card_path(barrett.name))
    closes = barrett.closed_joints > barrett.open_joints
    assert len(grasps) >= 3
    assert np.all(grasps.pregrasp_joints[:, closes] <= grasps.grasp_joints[:, closes])
    T_link = np.array([pose_links(model, joints) for joints in grasps.pregrasp_joints])
    for T_world_gripper in (grasps.T_world_gripper, grasps.T_world_pregrasp):
        T_world_link = (T_world_gripper[:, None] @ T_link).astype(np.float32)
        _, _, depth = depths(hand, T_world_link, cylinder.target.points.astype(np.float32))
        assert depth.max(initial=-1.0) < 0
        assert cylinder.table is not None
        assert lowest_corner(hand, T_world_link, cylinder.table.normal).min() > cylinder.table.offset


def test_grasps_come_best_first_and_every_start_is_accounted_for(grasps: GraspSet) -> None:
    assert np.all(np.diff(grasps.score) <= 0)
    assert se3.is_rigid(grasps.T_world_gripper).all()
    dropped = sum(count for reason, count in grasps.tally.items() if reason != "candidates")
    assert grasps.tally["candidates"] == len(grasps) + dropped


def test_same_seed_same_grasps_and_another_seed_others(cylinder: Scene, barrett: Gripper) -> None:
    grasps, again, other = (
        split_pso(cylinder, barrett, seed, starts=5, particles=6, iterations=4) for seed in (0, 0, 1)
    )
    assert len(grasps)
    assert np.array_equal(grasps.T_world_gripper, again.T_world_gripper)
    assert np.array_equal(grasps.grasp_joints, again.grasp_joints)
    assert not np.array_equal(grasps.T_world_gripper[0], other.T_world_gripper[0])


def test_buried_object_gives_an_empty_set_that_explains_itself(barrett: Gripper) -> None:
    profile = np.array([[0.0, 0.0], [RADIUS, 0.0], [RADIUS, 0.05], [0.0, 0.05]])
    gravel = node_positions(np.array([-0.4, -0.4, 0.01]), 0.02, (41, 41, 20))
    gravel = gravel[np.linalg.norm(gravel, axis=-1) > 0.07]
    scene = Scene.from_mesh(revolved(profile).mesh, obstacles=gravel)
    grasps = split_pso(scene, barrett, 0, **SMALL)
    assert len(grasps) == 0
    assert "touching something" in grasps.explain()


def test_hand_with_a_link_on_three_joints_is_refused_with_a_reason(barrett: Gripper) -> None:
    moves = np.array([[True, False], [True, False], [True, True], [False, True]])
    with pytest.raises(GraspmatchError, match="at most two driven joints"):
        shared_axes(moves, np.ones(4, dtype=bool), barrett)
