"""The fit of confidence to simulation: its mathematics on made-up grasps, and its data on a box."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import calibration
import calibration_data
import guesses
from calibration_data import (
    Entry,
    Job,
    Lifted,
    collect,
    concatenated,
    object_sets,
    planner_for,
    read_entry,
    write_entry,
)
from calibration_fit import (
    MODEL,
    OTHERS,
    TERMS,
    Model,
    auc,
    calibration_error,
    cross_validated,
    firsts,
    fit,
    folds,
    log_losses,
    planner_model,
    reliability,
    skill,
)
from graspmatch.apps.bench.objects import ObjectSource
from graspmatch.apps.bench.summary import wilson
from graspmatch.config import LiftConfig, SeedingConfig
from graspmatch.errors import GraspmatchError
from graspmatch.planner.grade import confidence

TRUE = Model(MODEL, 0.0, (1.5, 2.0, -0.8, 1.0, 0.2))


def made_up(rng: np.random.Generator, objects: int = 24, each: int = 50, model: Model = TRUE) -> Lifted:
    """Grasps of two hands that hold as often as a model says."""
    n = objects * each
    number = np.repeat(np.arange(objects), each)
    lifted = Lifted(
        hand=np.where(number % 2 == 0, "left", "right"),
        object=np.array([f"set/{i // 2:02d}" for i in number]),
        margin=rng.normal(0.0, 0.5, n),
        held_share=rng.integers(0, 7, n) / 6,
        standing=rng.normal(0.0, 0.4, n),
        clear_share=rng.uniform(0.0, 1.0, n),
        loss=rng.uniform(0.0, 0.1, n) ** 2,
        contacts=rng.uniform(0.0, 12.0, n),
        planned_margin=rng.normal(0.0, 0.5, n),
        pushed=rng.uniform(0.0, 0.03, n),
        slipped=rng.uniform(0.0, 0.03, n),
        clearance=rng.uniform(0.002, 0.01, n),
        moment_arm=rng.uniform(0.0, 2.0, n),
        score=rng.uniform(0.0, 1.0, n),
        reason=np.full(n, ""),
    )
    held = rng.uniform(size=n) < model.confidence(lifted)
    return replace(lifted, reason=np.where(held, "", "missed"))


def flipped(lifted: Lifted, where: np.ndarray) -> Lifted:
    """The grasps with the opposite outcome there."""
    return replace(lifted, reason=np.where(lifted.held ^ where, "", "missed"))


def test_a_fit_finds_the_model_that_the_outcomes_come_from() -> None:
    found = fit(made_up(np.random.default_rng(0), each=1500))
    assert found.offset == pytest.approx(TRUE.offset, abs=0.15)
    assert found.weights == pytest.approx(TRUE.weights, abs=0.1)


def test_a_fit_finds_no_use_for_terms_that_have_none() -> None:
    lifted = made_up(np.random.default_rng(1), each=500)
    for name in OTHERS:
        weight = fit(lifted, (*MODEL, name)).weights[-1]
        assert abs(weight) * TERMS[name](lifted).std() < 0.1


def test_an_object_weighs_the_same_however_many_grasps_it_has() -> None:
    lifted = made_up(np.random.default_rng(2))
    one = lifted.object == "set/00"
    more = concatenated([lifted, *[lifted.select(one)] * 9])
    assert fit(more).weights == pytest.approx(fit(lifted).weights, abs=1e-2)
    # ten times the grasps of one object would move the fit, were they counted one by one
    strange = flipped(lifted, one & (lifted.hand == "left"))
    assert fit(strange).weights != pytest.approx(fit(lifted).weights, abs=1e-2)


def test_a_fit_needs_both_outcomes() -> None:
    lifted = made_up(np.random.default_rng(3))
    with pytest.raises(GraspmatchError, match="held and grasps that did not"):
        fit(lifted.select(lifted.held))


def test_what_an_object_did_with_any_hand_has_no_part_in_its_own_confidence() -> None:
    lifted = made_up(np.random.default_rng(4))
    one = lifted.object == "set/03"
    assert set(lifted.hand[one]) == {"left", "right"}
    before, after = cross_validated(lifted), cross_validated(flipped(lifted, one))
    assert np.array_equal(before[one], after[one])
    assert np.abs(before - after)[~one].max() > 0.01


def test_folds_split_no_object_and_need_two() -> None:
    objects = np.array([f"{name}{i}" for i in range(10) for name in ("a/x", "b/x")] * 3)
    fold = folds(objects)
    for name in np.unique(objects):
        assert len(set(fold[objects == name])) == 1
    assert len(set(fold)) > 1
    with pytest.raises(GraspmatchError, match="two objects or more, not 1"):
        folds(np.array(["a/x", "a/x"]))


def test_bins_hold_the_grasps_of_their_confidence() -> None:
    confidences = np.array([0.0, 0.05, 0.1, 0.55, 0.95, 1.0, 0.91])
    held = np.array([False, True, True, False, True, True, False])
    low, next_one, middle, top = reliability(confidences, held)
    assert (low.low, low.high, low.count, low.held) == (0.0, 0.1, 2, 1)
    assert low.confidence == pytest.approx(0.025)
    assert (next_one.count, next_one.held) == (1, 1)  # a border belongs to the bin above it
    assert (middle.count, middle.share) == (1, 0.0)
    assert (top.high, top.count, top.held) == (1.0, 3, 2)
    assert top.interval == wilson(2, 3)
    assert calibration_error([low, top]) == pytest.approx((2 * abs(0.025 - 0.5) + 3 * abs(2.86 / 3 - 2 / 3)) / 5)


def test_confidences_that_are_right_lie_on_the_diagonal() -> None:
    lifted = made_up(np.random.default_rng(5), each=1000)
    bins = reliability(TRUE.confidence(lifted), lifted.held)
    assert len(bins) == 10
    for entry in bins:
        spread = np.sqrt(entry.confidence * (1 - entry.confidence) / entry.count)
        assert abs(entry.share - entry.confidence) < 4 * spread


@pytest.mark.parametrize(("score", "expected"), [([1, 2, 3, 4], 0.75), ([4, 3, 2, 1], 0.25), ([1, 1, 1, 1], 0.5)])
def test_auc_is_the_share_of_pairs_in_order(score: list[float], expected: float) -> None:
    held = np.array([False, True, False, True])
    assert auc(np.array(score, dtype=float), held) == pytest.approx(expected)
    assert np.isnan(auc(np.array(score, dtype=float), np.ones(4, dtype=bool)))


def test_the_first_grasp_of_each_hand_and_object_is_what_counts_on_top() -> None:
    group = np.array([1, 0, 1, 0, 1])
    assert firsts(np.array([0.2, 0.3, 0.9, 0.1, 0.5]), group).tolist() == [1, 2]
    lifted = made_up(np.random.default_rng(6))
    never = flipped(lifted, (lifted.group == 0) & lifted.held)  # an object that nothing lifts
    sure = skill(np.where(never.held, 0.9, 0.1), never)
    assert (sure.first_held, sure.feasible, sure.auc, sure.auc_within) == (23, 23, 1.0, 1.0)
    assert sure.log_loss == pytest.approx(-np.log(0.9))
    unsure = skill(np.full(len(never), 0.5), never)
    assert unsure.log_loss == pytest.approx(np.log(2))
    assert len(log_losses(np.full(len(never), 0.5), never)) == 24


def test_the_model_of_the_planner_is_the_one_that_is_fitted() -> None:
    lifted = made_up(np.random.default_rng(7))
    expected = confidence(lifted.margin, lifted.held_share, lifted.loss, lifted.standing, lifted.contacts)
    assert planner_model().confidence(lifted) == pytest.approx(expected)


def a_job(cache: Path, set_: str = "household", count: int = 3) -> Job:
    planner = replace(planner_for(count), seeding=SeedingConfig(points=24, above=2))
    return Job("kinova_kg3", set_, ObjectSource("box", None), planner, LiftConfig(hold_seconds=0.2), cache)


def test_what_was_lifted_is_kept_and_not_lifted_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = a_job(tmp_path)
    (made,) = collect([job], processes=1).values()
    assert 0 < len(made.lifted) <= 3
    assert set(made.lifted.object) == {"household/box"}
    assert made.lifted.held.any()
    assert (np.diff(made.lifted.score) <= 0).all()  # in the planner's order
    ran: list[Job] = []
    monkeypatch.setattr(calibration_data, "lift_all", lambda j: (ran.append(j), (made.lifted, ""))[1])
    (kept,) = collect([job], processes=1).values()
    assert ran == []
    for name, values in vars(made.lifted).items():
        assert np.array_equal(getattr(kept.lifted, name), values)
    collect([a_job(tmp_path, count=2)], processes=1)  # other settings
    collect([a_job(tmp_path, count=2)], processes=1, fresh=True)
    assert [j.planner.ranking.count for j in ran] == [2, 2]


def test_objects_of_one_name_in_two_sets_are_two_objects(tmp_path: Path) -> None:
    jobs = [a_job(tmp_path, "household"), a_job(tmp_path, "others")]
    for job, text in zip(jobs, ("first", "second"), strict=True):
        write_entry(job, Entry(calibration_data.NOTHING, text, "abc"))
    assert [entry.note for job in jobs if (entry := read_entry(job))] == ["first", "second"]
    (tmp_path / "household").mkdir()
    with pytest.raises(GraspmatchError, match="one name"):
        object_sets(["household", str(tmp_path / "household")])


def test_a_report_has_tables_constants_and_a_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = made_up(np.random.default_rng(8))
    development = {a_job(tmp_path): Entry(part, "", "abc")}
    check = {a_job(tmp_path, "others"): Entry(made_up(np.random.default_rng(9)), "", "abc")}
    calibration.report(development, check, tmp_path)
    content = json.loads((tmp_path / "calibration.json").read_text())
    assert content["fit"]["weights"] == pytest.approx(fit(part).weights)
    assert {"development", "check"} == content["reliability"].keys()
    text = (tmp_path / "calibration.md").read_text()
    assert f"CALIBRATION = ({', '.join(f'{value:g}' for value in fit(part).constants)})" in text
    assert "They differ from those in planner/grade.py" in capsys.readouterr().out
    for name in MODEL:
        assert f"| without {name} |" in text
    assert np.asarray(Image.open(tmp_path / "calibration.png")).std() > 10
    same = calibration.comparison(planner_model(), planner_model())
    assert "as in planner/grade.py" in same


def test_grasps_on_guesses_are_counted_by_how_far_from_what_was_seen_they_touch() -> None:
    far = np.array([0.001, 0.002, 0.010, 0.030, 0.050, 0.004])
    score = np.array([0.5, 0.7, 0.9, 0.4, 0.3, 0.05])
    found = guesses.Tried(
        np.array([0, 0, 1, 1, 0, 0], dtype=bool), far, score, np.array([1, 0, 1, 1, 0, 1], dtype=bool)
    )
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in guesses.table(found).splitlines()[2:]]
    assert rows[0] == ["0 to 8 mm", "50 % (1/2)", "0.60", "-", "-", "100 %"]  # what was given up does not count
    assert rows[1][1:5] == ["-", "-", "100 % (1/1)", "0.90"]
    assert rows[2][1:] == ["-", "-", "-", "-", "-"]
    assert rows[4] == ["more than 35 mm", "0 % (0/1)", "0.30", "-", "-", "0 %"]
    assert guesses.joined([found, found]).held.tolist() == [*found.held, *found.held]
