"""Several objects on a table: which stands on which, and in which order they are picked."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from depth_scenes import Box, Cylinder, K, Setting, noisy, render
from graspmatch.apps.cli import main
from graspmatch.config import PlannerConfig, RefiningConfig, SeedingConfig
from graspmatch.planner.order import Pick, plan_all
from graspmatch.planner.plan import plan
from graspmatch.scene.every import scenes_of_depth, scenes_of_view
from graspmatch.scene.scene import Scene
from graspmatch.scene.stacked import covered_share, is_stood_on, stands_on
from graspmatch.types import Plane, PointCloud
from test_planner import box_points

TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
UP = np.array([0.0, 0.0, 0.2])
QUICK = PlannerConfig(seeding=SeedingConfig(points=60, batches=1), refining=RefiningConfig(count=0))
STACK = Setting(
    (Box(-0.12, 0, (0.16, 0.14, 0.06)), Box(-0.12, 0, (0.05, 0.05, 0.08), z=0.06), Box(0.12, 0, (0.05, 0.04, 0.08)))
)


LOWER = box_points((0.1, 0.1, 0.06), (0, 0, 0.03), 0.004)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (box_points((0.04, 0.04, 0.05), (0, 0, 0.087), 0.004), True),  # on it
        (box_points((0.04, 0.04, 0.05), (0.04, 0, 0.087), 0.004), True),  # on its edge, half of it beside
        (box_points((0.05, 0.05, 0.15), (0.078, 0, 0.075), 0.004), False),  # beside it, and higher
        (box_points((0.05, 0.05, 0.15), (0.078, 0, 0.075), 0.004)[:, :] + [0, 0, 0.062], False),  # in the air beside it
        (box_points((0.04, 0.04, 0.05), (0, 0, 0.15), 0.004), False),  # in the air above it
        (np.zeros((0, 3)), False),
    ],
)
def test_only_what_is_over_an_object_and_off_the_table_stands_on_it(other, expected):
    assert stands_on(other, LOWER, TABLE) == expected
    assert not stands_on(LOWER, other, TABLE)


def test_one_of_several_parts_may_stand_on_an_object():
    beside = box_points((0.05, 0.05, 0.15), (0.2, 0, 0.075), 0.004)
    on = box_points((0.04, 0.04, 0.05), (0, 0, 0.087), 0.004)
    assert not is_stood_on(LOWER, beside, TABLE)
    assert is_stood_on(LOWER, np.concatenate([beside, on]), TABLE)
    specks = np.random.default_rng(0).uniform([-0.04, -0.04, 0.065], [0.04, 0.04, 0.075], (6, 3))
    assert not is_stood_on(LOWER, specks, TABLE)


def test_columns_meet_what_is_before_the_object_within_its_way():
    shelf = box_points((0.3, 0.3, 0.01), (0, 0, 0.2), 0.004)
    assert covered_share(LOWER, shelf, UP) > 0.9
    assert covered_share(LOWER, shelf, 0.5 * UP) == 0
    assert covered_share(LOWER, shelf, -UP) == 0
    assert covered_share(LOWER, box_points((0.05, 0.05, 0.15), (0.077, 0, 0.075), 0.004), UP) == 0  # beside it
    half = covered_share(LOWER, shelf[shelf[:, 0] > 0], UP)
    assert 0.3 < half < 0.7


def scene_of(points, others) -> Scene:
    return replace(
        Scene.from_cloud(points, table=0.0),
        obstacles=PointCloud(np.concatenate(others) if others else np.zeros((0, 3))),
    )


def test_what_is_on_top_is_picked_first_and_what_was_under_it_is_planned_for_again(toy):
    low, top = box_points((0.1, 0.04, 0.05), (0, 0, 0.025)), box_points((0.04, 0.04, 0.04), (0, 0, 0.072))
    picks = plan_all({4: scene_of(low, [top]), 7: scene_of(top, [low])}, toy, QUICK)
    assert [pick.number for pick in picks] == [7, 4]
    assert all(len(pick.grasps) for pick in picks)
    assert "stands on 4" in picks[0].reason
    assert "planned without 7" in picks[1].reason
    assert len(picks[1].scene.obstacles.points) == 0
    assert picks[1].room == np.inf


def test_of_free_objects_the_surer_one_comes_first(toy):
    good = box_points((0.08, 0.03, 0.06), (0, 0, 0.03))
    wide = box_points((0.12, 0.12, 0.06), (0.3, 0, 0.03))  # opens no hand of 6 cm
    picks = plan_all({0: scene_of(wide, [good]), 1: scene_of(good, [wide])}, toy, QUICK)
    assert picks[0].number == 1
    assert picks[0].room == pytest.approx(0.2, abs=0.01)
    confidence = [pick.grasps.score[0] if len(pick.grasps) else 0.0 for pick in picks]
    assert confidence[0] > confidence[1]


def test_what_cannot_be_grasped_comes_last_and_says_why(toy):
    good, wide = box_points((0.08, 0.03, 0.06), (0, 0, 0.03)), box_points((0.2, 0.2, 0.1), (0.4, 0, 0.05))
    strict = replace(QUICK, ranking=replace(QUICK.ranking, least_confidence=0.5))
    picks = plan_all({0: scene_of(wide, []), 1: scene_of(good, [])}, toy, strict)
    assert [pick.number for pick in picks] == [1, 0]
    assert picks[1].reason == "no grasp was found"
    assert "fell at this stage" in picks[1].grasps.explain()


def test_every_object_of_an_image_has_the_others_as_obstacles():
    setting = Setting((Box(-0.12, 0, (0.08, 0.1, 0.12), 0.3), Cylinder(0.1, 0.02, 0.03, 0.1)))
    depth, ids = render(setting)
    scenes = scenes_of_depth(depth, setting.camera, table=0.0)
    assert set(scenes) == {0, 1}
    alone = Scene.from_depth(depth, setting.camera, object=1, table=0.0)
    np.testing.assert_array_equal(scenes[1].target.points, alone.target.points)
    np.testing.assert_array_equal(scenes[1].obstacles.points, alone.obstacles.points)
    marked = scenes_of_depth(depth, setting.camera, mask=np.choose(ids + 1, [0, 5, 9]), table=0.0)
    assert set(marked) == {5, 9}


def test_what_stands_behind_another_is_cut_and_less_sure(toy):
    front, back = Box(0.0, -0.03, (0.05, 0.04, 0.14)), Box(0.025, 0.06, (0.06, 0.04, 0.12))
    alone, hidden = (Setting(things) for things in ((back,), (front, back)))
    images = [noisy(render(setting)[0], np.random.default_rng(0)) for setting in (alone, hidden)]
    mask = render(hidden)[1] + 1
    behind = Scene.from_depth(images[1], hidden.camera, mask=mask, object=2, table=0.0)
    before = Scene.from_depth(images[1], hidden.camera, mask=mask, object=1, table=0.0)
    free = Scene.from_depth(images[0], alone.camera, object=0, table=0.0)
    assert free.cut < 0.05
    assert before.cut < 0.05
    assert 0.15 < behind.cut < 0.6
    grasps, whole = plan(behind, toy, QUICK), plan(replace(behind, cut=0.0), toy, QUICK)
    np.testing.assert_allclose(grasps.score, (1 - behind.cut) * whole.score)


def test_without_a_choice_the_target_is_one_on_which_nothing_stands():
    depth, ids = render(STACK)
    image = noisy(depth, np.random.default_rng(0))
    mask = np.where(ids == 2, 0, ids + 1)  # the stack alone: a large box under a small one
    assert np.count_nonzero(mask == 1) > np.count_nonzero(mask == 2)
    scene = Scene.from_depth(image, STACK.camera, mask=mask, table=0.0)
    assert scene.seen_points[:, 2].min() > 0.05
    lower = Scene.from_depth(image, STACK.camera, mask=mask, object=1, table=0.0)
    assert lower.seen_points[:, 2].max() < 0.07


def test_a_stack_that_a_camera_sees_is_picked_from_the_top(toy):
    depth, ids = render(STACK)
    scenes = scenes_of_depth(noisy(depth, np.random.default_rng(0)), STACK.camera, mask=ids + 1)
    picks = plan_all(scenes, toy, QUICK)
    order = [pick.number for pick in picks]
    assert order.index(2) < order.index(1)
    assert "stands on 1" in reason_of(picks, 2)


def reason_of(picks: tuple[Pick, ...], number: int) -> str:
    return next(pick.reason for pick in picks if pick.number == number)


def test_clouds_of_scenes_have_the_same_objects():
    setting = Setting((Box(-0.12, 0, (0.08, 0.1, 0.12), 0.3), Cylinder(0.1, 0.02, 0.03, 0.1)))
    depth, _ = render(setting)
    v, u = np.nonzero(depth)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))], axis=-1)
    scenes = scenes_of_view(depth[v, u][:, None] * rays, T_world_cloud=setting.camera.pose)
    centres = np.array([scenes[number].centre_of_mass[:2] for number in sorted(scenes)])
    np.testing.assert_allclose(centres, [[-0.12, 0.0], [0.1, 0.02]], atol=0.05)


def test_all_on_the_command_line_writes_files_for_each_object(tmp_path: Path, toy, capsys, monkeypatch):
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "cache"))
    setting = Setting((Box(-0.12, 0, (0.05, 0.1, 0.06), 0.3), Cylinder(0.1, 0.02, 0.02, 0.08)))
    Image.fromarray(np.round(1000 * render(setting)[0]).astype(np.uint16)).save(tmp_path / "depth.png")
    np.savetxt(tmp_path / "pose.txt", setting.camera.pose)
    words = ["plan", str(tmp_path / "depth.png"), "--intrinsics", "460,460,319.5,239.5", "--all", "--fast", "--json"]
    words += ["--camera-pose", str(tmp_path / "pose.txt"), "--gripper", "robotiq_2f85", "--device", "cpu"]
    assert main([*words, "-o", str(tmp_path / "grasps.yaml")]) == 0
    picks = json.loads(capsys.readouterr().out)["picks"]
    assert sorted(pick["object"] for pick in picks) == [0, 1]
    assert all(pick["grasps"] and pick["reason"] for pick in picks)
    assert [step["name"] for step in picks[0]["grasps"][0]["way"]] == ["pregrasp", "grasp", "closed", "out"]
    assert {path.name for path in tmp_path.glob("*.yaml")} == {"grasps-0.yaml", "grasps-1.yaml"}
    assert main([*words, "--object", "1"]) == 2
    assert main([*words, "--seeds", "x.npz"]) == 2
