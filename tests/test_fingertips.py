"""Fingertip preshapes: what they are made of, where they start, and what they hold that the whole hand does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspmatch.config import GripConfig, PlannerConfig, SeedingConfig
from graspmatch.geometry import se3
from graspmatch.gripper.bake import ending_between_nodes
from graspmatch.gripper.card import read_card
from graspmatch.gripper.fingertips import TIP, balanced_shares
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.pinch import gap_of, opposite_points, pinch_seeds
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import convex, joined
from graspmatch.types import GraspmatchError, Gripper, Preshape
from toy_hand import CARD, COARSE, write_toy


def tips_of(hand: Gripper) -> list[Preshape]:
    return [preshape for preshape in hand.preshapes if preshape.is_fingertips]


def block(size, at) -> np.ndarray:
    """Corners of a box [m]."""
    signs = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5]), axis=-1).reshape(-1, 3)
    return np.array(at) + signs * np.array(size)


def boxes(*sizes_and_places) -> Scene:
    return Scene.from_mesh(joined([convex(block(size, at)) for size, at in sizes_and_places]).mesh)


def test_only_the_tips_have_weight_and_the_palm_has_none(toy):
    finger = 0.06  # its length; the palm is at z = 0
    assert len(tips_of(toy)) == 3
    for preshape in tips_of(toy):
        z = preshape.samples.points[:, 2]
        assert preshape.weights.mean() == pytest.approx(1.0)
        assert preshape.weights[z > (1 - TIP / 2) * finger].min() > 0
        assert preshape.weights[z < (1 - 1.1 * TIP) * finger].max() == 0
        assert np.all(np.diff((preshape.weights > 0).astype(int)) <= 0)  # what is matched comes first
        left = preshape.samples.points[:, 1] > 0
        assert preshape.weights[left].sum() == pytest.approx(preshape.weights[~left].sum())
        np.testing.assert_allclose(preshape.tool_centre_point[1], 0, atol=1e-6)
        assert (1 - TIP) * finger < preshape.tool_centre_point[2] < finger


def test_whole_hand_preshapes_stay_as_the_card_says(toy):
    asked = [preshape for preshape in toy.preshapes if not preshape.is_fingertips]
    assert [preshape.name for preshape in asked] == ["close_0", "close_30", "close_60"]
    assert all(np.all(preshape.weights == 1) for preshape in asked)


def test_gap_between_the_tips_halves(toy):
    gap = [2 * np.abs(p.samples.points[p.weights > 0, 1]).mean() for p in tips_of(toy)]
    np.testing.assert_allclose(gap, [0.06, 0.03, 0.015], atol=5e-4)


def test_card_says_how_many_fingertip_preshapes_there_are(tmp_path, monkeypatch):
    monkeypatch.setenv("GRASPMATCH_CACHE", str(tmp_path / "cache"))
    none = CARD.replace("steps = 3", "steps = 1\nfingertips = 0")
    assert not tips_of(load_gripper(write_toy(tmp_path, none), baking=COARSE))
    with pytest.raises(GraspmatchError, match=r"fingertips is 1\.5; it must be a whole number"):
        read_card(write_toy(tmp_path, CARD.replace("steps = 3", "fingertips = 1.5")))


@pytest.mark.parametrize(
    ("angles", "expected"),
    [((0, 180), (0.5, 0.5)), ((0, 180, 180), (0.5, 0.25, 0.25)), ((0, 120, 240), (1 / 3, 1 / 3, 1 / 3))],
)
def test_shares_of_the_fingers_balance(angles, expected):
    radians = np.radians(angles)
    pushes = 0.04 * np.stack([np.cos(radians), np.sin(radians), 0 * radians], axis=-1)
    np.testing.assert_allclose(balanced_shares(pushes), expected, atol=0.03)


def test_grid_ends_midway_between_nodes_at_the_fingertips():
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3))
    for approach in np.concatenate([np.eye(3), -np.eye(3)]):
        origin = ending_between_nodes(np.array([-0.13, -0.12, -0.11]), 0.003, points, approach)
        axis = int(np.argmax(np.abs(approach)))
        foremost = points[np.argmax(points @ approach), axis]
        assert ((foremost - origin[axis]) / 0.003) % 1 == pytest.approx(0.5)
        assert np.abs(origin - [-0.13, -0.12, -0.11]).max() < 0.003


def test_opposite_points_of_a_box_lie_across_its_narrow_side():
    scene = boxes(((0.1, 0.02, 0.08), (0.2, 0.1, 0.04)))
    pairs = opposite_points(scene, 200, 0.05, np.random.default_rng(0))
    assert len(pairs) == 200
    assert np.all(np.abs(pairs.axis[:, 1]) > 0.8)
    np.testing.assert_allclose(pairs.middle[:, 1], 0.1, atol=1e-4)
    np.testing.assert_allclose(pairs.width * np.abs(pairs.axis[:, 1]), 0.02, atol=2e-4)


def test_what_is_too_wide_everywhere_has_no_opposite_points(toy):
    scene = boxes(((0.1, 0.1, 0.08), (0.0, 0.0, 0.04)))
    assert len(opposite_points(scene, 200, 0.05, np.random.default_rng(0))) == 0
    assert len(pinch_seeds(scene, toy, SeedingConfig(), np.random.default_rng(0))) == 0


def test_fingertips_start_nowhere_where_the_user_says_where_hands_start(toy):
    scene = boxes(((0.1, 0.02, 0.08), (0.2, 0.1, 0.04)))
    for config in (SeedingConfig(pattern="gaussians"), SeedingConfig(fingertips=0)):
        assert len(pinch_seeds(scene, toy, config, np.random.default_rng(0))) == 0


def test_fingertips_start_around_opposite_points_from_above_and_the_robots_side(toy):
    scene = boxes(((0.1, 0.02, 0.08), (0.2, 0.1, 0.04)))
    starts = pinch_seeds(scene, toy, SeedingConfig(), np.random.default_rng(0))
    assert len(starts) == SeedingConfig().fingertips
    assert all(toy.preshapes[i].is_fingertips and gap_of(toy.preshapes[i], toy) > 0.02 for i in starts.preshape)
    assert np.all(np.diff(starts.preshape) >= 0)
    tcp_gripper = np.array([toy.preshapes[i].tool_centre_point for i in starts.preshape])
    tcp = np.array([se3.apply(T, t[None])[0] for T, t in zip(starts.T_world_gripper, tcp_gripper, strict=True)])
    np.testing.assert_allclose(tcp[:, 1], 0.1, atol=1e-4)
    closing = starts.T_world_gripper[:, :3, :3] @ toy.closing
    assert np.all(np.abs(closing[:, 1]) > 0.8)
    approach = starts.T_world_gripper[:, :3, :3] @ toy.approach
    assert np.mean((approach[:, 2] < 0) & (approach[:, 0] > 0)) > 0.95  # where one of the turns that are drawn does


def test_thin_part_away_from_the_middle_is_held_by_the_fingertips(toy):
    """A block that is too wide for the hand, with a fin near its edge; few hands start around its middle."""
    scene = boxes(((0.12, 0.12, 0.03), (0.0, 0.0, 0.015)), ((0.03, 0.006, 0.03), (0.02, 0.04, 0.04)))
    few = SeedingConfig(points=8, above=0, batches=2)
    config = PlannerConfig(seeding=few, grip=GripConfig(mass=0.05))
    grasps = plan(scene, toy, config)
    assert len(grasps) > 0, grasps.explain()
    tip = se3.apply(grasps.T_world_gripper[0], toy.tool_centre_point[None])[0]
    np.testing.assert_allclose(tip[:2], [0.02, 0.04], atol=0.02)
    whole = plan(scene, toy, replace(config, seeding=replace(few, fingertips=0)))
    assert grasps.score[0] > whole.score.max(initial=0.0)
