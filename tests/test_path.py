"""The way of the hand: directions, workspace, the way out with the object, and what a robot reaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspmatch.config import BakingConfig, PathConfig, PlannerConfig, SeedingConfig
from graspmatch.geometry import se3
from graspmatch.geometry.grid import interpolate
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.advice import advice
from graspmatch.planner.avoid import upload_space
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.path import (
    BLOCKED,
    LOADED,
    OUT_OF_REACH,
    OUTSIDE_BOX,
    OUTSIDE_CONE,
    Way,
    aimed,
    is_executable,
    keep_executable,
    keeps_direction,
    lift_clearance,
    way_of,
)
from graspmatch.planner.plan import plan
from graspmatch.planner.seed import seed_poses
from graspmatch.planner.tally import Tally
from graspmatch.planner.waypoints import waypoints
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, Gripper
from test_planner import SMALL, box_points
from toy_hand import COARSE, write_toy

DOWN = np.diag([1.0, -1.0, -1.0])
BOX = box_points((0.05, 0.03, 0.06), (0, 0, 0.03))


def scene_with(obstacles=None) -> Scene:
    return Scene.from_cloud(BOX, obstacles=obstacles, table=0.0)


def way_in(toy: Gripper, scene: Scene, path: PathConfig | None = None, reach=None, device: str = "cpu") -> Way:
    return way_of(scene, upload_space(scene, toy, device), PlannerConfig(path=path or PathConfig()), reach)


def above(*offsets) -> Candidates:
    """Hands that look down, the palm 10 cm above the table, moved by offsets."""
    T = np.stack([se3.from_parts(DOWN, np.array([0.0, 0.0, 0.1]) + offset) for offset in np.array(offsets)])
    return Candidates(np.zeros(len(T), dtype=int), T)


def test_only_directions_in_the_cone_are_kept(toy):
    way = way_in(toy, scene_with(), PathConfig(approach_angle=0.5))
    tilts = np.array([0.0, 0.4, 0.49, 0.51, 1.5, 3.1])
    R = se3.rotation_exp(tilts[:, None] * np.array([1.0, 0, 0])) @ DOWN
    hands = Candidates(np.zeros(len(tilts), dtype=int), se3.from_parts(R, np.zeros(3)))
    np.testing.assert_array_equal(keeps_direction(hands, way), tilts <= 0.5)


@pytest.mark.parametrize("along", [(0.3, 0.1, -1.0), (0.0, 0.0, 1.0)])
def test_starts_are_turned_into_the_cone_about_the_object(toy, along):
    scene = scene_with()
    way = way_in(toy, scene, PathConfig(approach_along=along, approach_angle=0.4 if along[2] < 0 else 2.0))
    starts = seed_poses(scene, toy, SeedingConfig(), np.random.default_rng(0))
    turned = aimed(starts, way, scene.centre_of_mass)
    inside = keeps_direction(starts, way)
    assert 0 < inside.sum() < len(starts)
    assert keeps_direction(turned, way).all()
    np.testing.assert_array_equal(turned.T_world_gripper[inside], starts.T_world_gripper[inside])
    before, after = (
        se3.apply(se3.inverse(c.T_world_gripper), scene.centre_of_mass[None])[:, 0] for c in (starts, turned)
    )
    np.testing.assert_allclose(after, before, atol=1e-9)  # the hand still faces the object as it did


def test_every_grasp_of_a_plan_keeps_cone_and_workspace(toy):
    box = (-0.2, -0.2, 0.0, 0.2, 0.2, 0.25)
    path = PathConfig(approach_angle=0.6, workspace=box)
    grasps = plan(scene_with(), toy, replace(SMALL, path=path))
    assert len(grasps) > 0, grasps.explain()
    assert np.arccos(-(grasps.T_world_gripper[:, :3, :3] @ toy.approach)[:, 2]).max() <= 0.6 + 1e-6
    for T in (grasps.T_world_gripper, grasps.T_world_pregrasp):
        corners = se3.apply(T, toy.preshapes[0].outline)
        assert (corners >= np.array(box[:3])).all()
        assert (corners <= np.array(box[3:]) + 1e-9).all()
    assert grasps.tally[OUTSIDE_CONE] > 0


@pytest.mark.parametrize("limits", [(0, 0, 0, 1, -1, 1), (0, 0, 0, 0, 1, 1)])
def test_a_box_without_room_is_an_error(toy, limits):
    with pytest.raises(GraspmatchError, match="least x, y, z and then the largest"):
        plan(scene_with(), toy, replace(SMALL, path=PathConfig(workspace=limits)))


def test_the_lift_finds_what_is_above_the_hand(toy, device):
    """Against the least distance over many small steps, with obstacles here and there."""
    rng = np.random.default_rng(1)
    cloud = rng.uniform([-0.2, -0.2, 0.02], [0.2, 0.2, 0.35], (300, 3))
    scene, height = scene_with(cloud), 0.15
    way = replace(way_in(toy, scene, PathConfig(lift_height=height), device=device), is_covered=False, clearance=0.01)
    R = se3.rotation_exp(rng.normal(size=(20, 3)) * 0.4) @ DOWN
    hands = Candidates(
        np.zeros(20, dtype=int), se3.from_parts(R, rng.uniform([-0.1, -0.1, 0.1], [0.1, 0.1, 0.3], (20, 3)))
    )
    found = lift_clearance(hands, way)
    steps = np.linspace(0, height, 301)
    for T, clearance in zip(hands.T_world_gripper, found, strict=True):
        moved = cloud[:, None] - steps[:, None] * np.array([0, 0, 1.0])
        local = se3.apply(se3.inverse(T), moved.reshape(-1, 3))
        expected = min(float(interpolate(toy.preshapes[0].hand, local).min()), 0.01)
        assert clearance == pytest.approx(expected, abs=0.0008)  # a quarter of a cell of the grid, and the steps


def test_a_shelf_above_the_hand_blocks_the_lift_but_not_the_way_back(toy):
    shelf = box_points((0.4, 0.4, 0.01), (0, 0, 0.2))
    down, level = DOWN, se3.rotation_facing(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    T = np.stack([se3.from_parts(down, np.array([0, 0, 0.1])), se3.from_parts(level, np.array([-0.06, 0, 0.05]))])
    hands, tally = Candidates(np.zeros(2, dtype=int), T), Tally(2)
    way = way_in(toy, scene_with(shelf))
    kept = keep_executable(hands, way, tally)
    np.testing.assert_array_equal(is_executable(hands, way), [False, True])  # down there is the shelf on the way back
    assert len(kept) == 1
    assert tally.counts[BLOCKED] == 1
    unasked = way_in(toy, scene_with(shelf), PathConfig(lift_height=0.0))
    assert is_executable(hands, unasked).all()


def test_what_stands_on_the_object_keeps_it_there(toy):
    load = box_points((0.03, 0.03, 0.04), (0, 0, 0.082))
    grasps = plan(scene_with(load), toy, SMALL)
    assert len(grasps) == 0
    assert grasps.tally[LOADED] > 0
    assert f"fell at this stage: {LOADED}" in grasps.explain()
    assert "--all" in grasps.advice


def test_a_taller_neighbour_does_not_keep_the_object_there(toy):
    grasps = plan(scene_with(box_points((0.05, 0.05, 0.12), (0.056, 0, 0.06))), toy, SMALL)
    assert len(grasps) > 0, grasps.explain()
    assert grasps.tally[LOADED] == 0


def test_obstacles_are_clear_of_hand_way_in_and_closing_fingers(toy):
    """Looked at with the fields of the hand, apart from the planner's kernels."""
    walls = [box_points((0.05, 0.01, 0.1), (0, side * 0.055, 0.05)) for side in (-1, 1)]
    scene = scene_with(np.concatenate(walls))
    grasps = plan(scene, toy, SMALL)
    assert len(grasps) > 0, grasps.explain()
    for T, which in zip(grasps.T_world_gripper, grasps.preshape, strict=True):
        for back in np.linspace(0, toy.approach_distance, 16):
            there = T @ se3.translation(-back * toy.approach)
            local = se3.apply(se3.inverse(there), scene.obstacles.points)
            assert interpolate(toy.preshapes[which].hand, local).min() > 0


def test_grasps_that_are_not_reached_are_dropped_with_a_reason(toy):
    calls = []

    def from_the_left(T_world_gripper):
        assert T_world_gripper.shape[1:] == (3, 4, 4)
        calls.append(len(T_world_gripper))
        return T_world_gripper[:, 0, 1, 3] > 0

    grasps = plan(scene_with(), toy, SMALL, reach=from_the_left)
    assert len(calls) > 1
    assert len(grasps) > 0, grasps.explain()
    assert grasps.T_world_pregrasp[:, 1, 3].min() > 0
    assert grasps.tally[OUT_OF_REACH] > 0
    none = plan(scene_with(), toy, SMALL, reach=lambda T: np.zeros(len(T), dtype=bool))
    assert len(none) == 0
    assert f"fell at this stage: {OUT_OF_REACH}" in none.explain()
    assert "--robot-base" in none.advice


def test_a_reach_that_returns_something_else_is_an_error(toy):
    with pytest.raises(GraspmatchError, match="one bool for each"):
        plan(scene_with(), toy, SMALL, reach=lambda T: np.ones(3))


def test_waypoints_go_in_straight_and_out_upwards(toy):
    scene = scene_with()
    grasps = plan(scene, toy, SMALL)
    ways = waypoints(grasps, scene, toy)
    pregrasp, grasp, closed, out = np.moveaxis(ways.T_world_gripper, 1, 0)
    np.testing.assert_array_equal(pregrasp, grasps.T_world_pregrasp)
    np.testing.assert_array_equal(grasp, closed)
    assert ways.goes_up.all()
    np.testing.assert_allclose(
        out - grasp, np.tile(se3.translation(np.array([0, 0, 0.2])) - np.eye(4), (len(grasps), 1, 1))
    )
    np.testing.assert_array_equal(ways.joints[:, 1], grasps.pregrasp_joints)
    np.testing.assert_array_equal(ways.joints[:, 3], grasps.grasp_joints)


def test_another_length_of_the_way_in_gives_the_same_hand_with_other_corridors(tmp_path, monkeypatch):
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "cache"))
    card = write_toy(tmp_path)
    usual = load_gripper(card, baking=COARSE)
    short = load_gripper(card, baking=replace(COARSE, approach_distance=0.08))
    assert short.T_gripper_pregrasp[2, 3] == pytest.approx(-0.08)
    assert BakingConfig.approach_distance == usual.approach_distance == 0.15
    for a, b in zip(usual.preshapes, short.preshapes, strict=True):
        np.testing.assert_array_equal(a.hand.values, b.hand.values)
        behind = np.array([[0.0, 0.0, -0.11]])  # of the palm: 8 cm back the hand is not there, 15 cm back it is
        assert interpolate(a.corridor, behind)[0] < 0 < interpolate(b.corridor, behind)[0]
    again = load_gripper(card, baking=replace(COARSE, approach_distance=0.08))
    np.testing.assert_array_equal(again.preshapes[0].corridor.values, short.preshapes[0].corridor.values)


@pytest.mark.parametrize(
    ("reason", "expected"),
    [
        ("in collision with the table", "table's height"),
        ("in collision with object or obstacles on the way in", "toy opens 60 mm wide"),
        ("in collision where their way in begins", "--approach-distance"),
        ("fingers stopped by the table or an obstacle", "before the object"),
        ("fingers that close on nothing", "50 x 30 x 60 mm"),
        (OUTSIDE_CONE, "path.approach_angle"),
        (OUTSIDE_BOX, "path.workspace"),
        (LOADED, "Pick that first"),
        (BLOCKED, "path.lift_height"),
        (OUT_OF_REACH, "--robot-base"),
        ("unlikely to hold", "ranking.least_confidence"),
    ],
)
def test_advice_is_about_the_stage_that_the_last_candidates_fell_at(toy, reason, expected):
    tally = Tally(100)
    tally.add("of an earlier stage, by far the most", 97)
    tally.add(reason, 3)
    tally.add("of a later stage, which none came to", 0)
    text = advice(tally, scene_with(), toy)
    assert text.startswith(f"The last 3 candidates fell at this stage: {reason}.")
    assert expected in text


def test_every_reason_of_a_plan_has_its_advice(toy):
    """What ranks candidates is no reason for there being none."""
    grasps = plan(scene_with(), toy, SMALL)
    ranking = {"candidates", "much like a better one", "less promising than others", "ranked lower than asked for"}
    for reason in set(grasps.tally) - ranking:
        tally = Tally(1)
        tally.add(reason, 1)
        assert len(advice(tally, scene_with(), toy)) > len(f"The last candidate fell at this stage: {reason}.") + 10
