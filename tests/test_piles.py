"""Piles, and what the hand does among other objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspmatch.apps.bench import glimpse
from graspmatch.apps.bench.clutter import by_hidden, by_object, cleared
from graspmatch.apps.bench.objects import ObjectSource
from graspmatch.apps.bench.piles import PileJob, PileTrial, run_pile
from graspmatch.apps.bench.records import read_records, recorded
from graspmatch.apps.bench.trials import NO_GRASP, PlanWith, TrialConfig
from graspmatch.config import LiftConfig, ViewConfig
from graspmatch.geometry.se3 import from_parts, translation
from graspmatch.gripper.kinematics import load_hand
from graspmatch.gripper.zoo import card_path
from graspmatch.simulate.pile import Pile, drop, settled, try_in_pile

BOX = ObjectSource("box", None)
SHORT = LiftConfig(hold_seconds=0.3)
STRAIGHT_DOWN = np.diag([1.0, -1.0, -1.0])


def two_boxes(apart: float) -> Pile:
    box = BOX.load()
    lowest = min(part.vertices[:, 2].min() for part in box.parts)
    poses = [translation(np.array([0.0, y, -lowest])) for y in (0.0, apart)]
    return settled(Pile((box, box), np.array(poses)), SHORT)


def pinch(pile: Pile, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Straight down onto an object, the Franka Hand open."""
    centre = pile.T_world_object[index][:3, :3] @ pile.objects[index].centre_of_mass + pile.T_world_object[index][:3, 3]
    narrow = int(np.argmin(np.ptp(pile.objects[index].mesh.vertices, axis=0)[:2]))
    turn = np.pi / 2 if narrow == 0 else 0.0  # the fingers close along y of the hand
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]) @ STRAIGHT_DOWN
    top = (pile.objects[index].mesh.vertices @ pile.T_world_object[index][2, :3]).max() + pile.T_world_object[index][
        2, 3
    ]
    grasp = from_parts(R, np.array([centre[0], centre[1], top - 0.02 + 0.1034]))
    return grasp @ translation(np.array([0, 0, -0.15])), grasp, np.array([0.04])


def test_a_pile_comes_to_rest_on_the_table_and_is_the_same_for_the_same_seed() -> None:
    objects = [BOX.load(), ObjectSource("can", None).load(), BOX.load()]
    pile, again = (drop(objects, SHORT, np.random.default_rng(2)) for _ in range(2))
    np.testing.assert_array_equal(pile.T_world_object, again.T_world_object)
    for body, T in zip(pile.objects, pile.T_world_object, strict=True):
        lowest = min((part.vertices @ T[2, :3]).min() + T[2, 3] for part in body.parts)
        assert lowest > -0.002
    later = settled(pile, SHORT)
    assert np.abs(later.T_world_object - pile.T_world_object).max() < 0.01
    touching = [
        min((p.vertices @ T[2, :3]).min() + T[2, 3] for p in b.parts) < 0.002
        for b, T in zip(pile.objects, pile.T_world_object, strict=True)
    ]
    assert any(touching)


def test_one_object_is_lifted_and_the_others_stay() -> None:
    hand = load_hand(card_path("franka_hand"), None)
    pile = two_boxes(0.25)
    verdict, after = try_in_pile(pile, 1, hand, *pinch(pile, 1), SHORT)
    assert verdict.held, verdict.reason
    assert after.T_world_object[1][2, 3] > pile.T_world_object[1][2, 3] + 0.15
    np.testing.assert_allclose(after.T_world_object[0], pile.T_world_object[0], atol=2e-3)
    assert len(after.without(1)) == 1


def test_a_hand_that_comes_down_on_another_object_collides() -> None:
    hand = load_hand(card_path("franka_hand"), None)
    alone = two_boxes(0.25)
    width = np.ptp(alone.objects[0].mesh.vertices, axis=0)[1]
    close = two_boxes(float(width) + 0.004)
    grasp = pinch(close, 0)
    R = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    centre = grasp[1][:3, 3]
    turned = tuple(np.r_[np.c_[R @ T[:3, :3], centre + R @ (T[:3, 3] - centre)], [[0, 0, 0, 1]]] for T in grasp[:2])
    across = turned if np.argmin(np.ptp(close.objects[0].mesh.vertices, axis=0)[:2]) == 0 else grasp[:2]
    verdict, _ = try_in_pile(close, 0, hand, across[0], across[1], grasp[2], SHORT)
    assert not verdict.held
    assert "collision" in verdict.reason


def test_a_pile_is_looked_at_and_cleared() -> None:
    config = TrialConfig(lift=SHORT, trials=1, seed=1, view=ViewConfig(distance=0.7))
    trial = run_pile(PileJob((BOX, ObjectSource("can", None)), "kinova_kg3", None, PlanWith(), 0, config))
    assert trial.objects == ["box", "can"]
    assert trial.tries[0].left == 2
    assert all(attempt.hidden is None or 0 <= attempt.hidden <= 1 for attempt in trial.tries)
    assert trial.cleared >= 1
    assert len(trial.tries) <= 2 + 3 * 2


def test_what_has_rolled_out_of_the_image_is_not_attempted(monkeypatch: pytest.MonkeyPatch) -> None:
    config = TrialConfig(lift=SHORT, trials=1, seed=1, view=ViewConfig(distance=0.7))
    monkeypatch.setattr(glimpse, "AIM", np.array([5.0, 0.0, 0.0]))  # the camera looks at another table
    trial = run_pile(PileJob((BOX,), "kinova_kg3", None, PlanWith(), 0, config))
    assert trial.tries == []
    assert trial.cleared == 0


def attempt(name: str, held: bool, hidden: float | None, reason: str = "") -> dict:
    return {
        "object": name,
        "held": held,
        "reason": reason,
        "left": 2,
        "found": 2,
        "hidden": hidden,
        "score": 0.5,
        "plan_seconds": 1.0,
        "simulation_seconds": 1.0,
    }


def test_attempts_and_cleared_objects_are_counted(tmp_path: Path) -> None:
    trials = [
        PileTrial(
            0, ["a", "b"], [attempt("a", False, 0.3, "missed"), attempt("a", True, 0.0), attempt("b", True, 0.0)]
        ),
        PileTrial(1, ["a", "b"], [attempt("b", True, 0.1), *[attempt("", False, None, NO_GRASP)] * 3]),
    ]
    rows = {row.name: row for row in by_object(trials)}
    assert (rows["a"].held, rows["a"].trials) == (1, 2)
    assert (rows["all attempts"].held, rows["all attempts"].trials) == (3, 7)
    assert rows["all attempts"].rate == pytest.approx(3 / 7)
    assert [(row.name, row.held, row.trials) for row in by_hidden(trials)] == [
        ("00 to 5 %", 2, 2),
        ("05 to 20 %", 1, 1),
        ("20 to 40 %", 0, 1),
    ]
    assert cleared(trials).startswith("3 of 4 objects were cleared: 75.0 %")
    assert "left behind: 1 a" in cleared(trials)
    path = tmp_path / "piles.jsonl"
    assert list(recorded(trials, path, {}, done=0)) == trials
    assert read_records(path, {}, PileTrial) == trials
