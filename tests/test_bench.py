"""Trials, their records and what they come to."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from graspmatch.apps.bench import trials as trials_module
from graspmatch.apps.bench.command import bench
from graspmatch.apps.bench.experiments import variant_of
from graspmatch.apps.bench.objects import ObjectSource, folder_sources, household_sources
from graspmatch.apps.bench.plots import Series, plot_against_count, plot_rates
from graspmatch.apps.bench.records import read_records, recorded
from graspmatch.apps.bench.run import Benchmark, Workshop, run_benchmark
from graspmatch.apps.bench.summary import summary, wilson
from graspmatch.apps.bench.tables import markdown
from graspmatch.apps.bench.trials import NO_GRASP, TOPPLES, Job, PlanWith, Trial, TrialConfig, run_trial, run_trials
from graspmatch.apps.bench.view import view_sections
from graspmatch.apps.options import Bench
from graspmatch.apps.speech import Speech
from graspmatch.config import LiftConfig, PlannerConfig, SensorConfig, ViewConfig, fast
from graspmatch.errors import GraspmatchError
from graspmatch.gripper.load import load_gripper
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet, Gripper

SHORT = TrialConfig(lift=LiftConfig(hold_seconds=0.5), trials=2)
BOX = ObjectSource("box", None)


def job(trial: int = 0, config: TrialConfig = SHORT, planner: object = PlanWith(), source: ObjectSource = BOX) -> Job:
    return Job(source, "kinova_kg3", None, planner, trial, config)  # type: ignore[arg-type]


def outcome(trial: Trial) -> dict:
    """All but the wall times."""
    return {name: value for name, value in asdict(trial).items() if not name.endswith("seconds")}


def a_trial(name: str, held: bool, reason: str = "", seconds: float = 1.0) -> Trial:
    return Trial(name, 0, held, reason, seconds, 0.5, 20, "close_0", 0.5, 0.0, 0.0)


def test_a_trial_is_the_same_each_time_and_another_one_each_number() -> None:
    first, again, other = run_trial(job(0)), run_trial(job(0)), run_trial(job(1))
    assert outcome(first) == outcome(again)
    assert (first.score, first.slip) != (other.score, other.slip)
    assert first.held
    assert first.grasps > 0


def test_any_number_of_processes_gives_the_same_results() -> None:
    jobs = [job(i, source=source) for source in (BOX, ObjectSource("can", None)) for i in range(2)]
    by_count = {}
    for count in (1, 2):
        results = run_trials(jobs, processes=count)
        by_count[count] = sorted(map(outcome, results), key=lambda o: (o["object"], o["trial"]))
    assert by_count[1] == by_count[2]


class Onlooker:
    """A planner that keeps what it is given and finds nothing."""

    seen: list[tuple[np.ndarray, int]]

    def __init__(self) -> None:
        self.seen = []

    def __call__(self, scene: Scene, gripper: Gripper, seed: int) -> GraspSet:
        self.seen.append((scene.mesh.vertices.copy() if scene.mesh else np.zeros((0, 3)), seed))
        return PlanWith()(scene, gripper, seed).best(0)


def test_the_planner_sees_the_object_where_it_stands_and_never_the_same_twice() -> None:
    planner = Onlooker()
    reasons = [run_trial(job(i, planner=planner)).reason for i in range(3)]
    assert reasons == [NO_GRASP] * 3
    assert len({seed for _, seed in planner.seen}) == 3
    for vertices, _ in planner.seen:
        assert abs(vertices[:, 2].min()) < 1e-3  # on the table
    centres = [vertices.mean(axis=0)[:2] for vertices, _ in planner.seen]
    assert np.linalg.norm(centres[0] - centres[1]) > 1e-3


def test_a_pose_error_moves_the_hand_and_nothing_else() -> None:
    exact, wrong = run_trial(job(0)), run_trial(job(0, replace(SHORT, pose_error_mm=3.0, pose_error_deg=3.0)))
    assert exact.score == wrong.score
    assert exact.slip != wrong.slip
    lost = run_trial(job(0, replace(SHORT, pose_error_mm=300.0)))
    assert not lost.held


def test_an_object_that_falls_over_is_reported_and_not_counted(tmp_path: Path) -> None:
    import trimesh

    stick = trimesh.creation.box(extents=(0.01, 0.01, 0.3))
    stick.apply_transform(trimesh.transformations.rotation_matrix(0.4, (1, 0, 0)))
    stick.export(tmp_path / "stick.stl")
    (source,) = folder_sources(tmp_path)
    trial = run_trial(job(source=source))
    assert trial.reason == TOPPLES
    row = summary([trial])[0]
    assert (row.trials, row.reasons) == (0, {TOPPLES: 1})


def test_a_benchmark_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    workshop = Workshop(tmp_path, processes=1, quiet=True)
    benchmark = Benchmark("box", PlanWith(), "kinova_kg3", [BOX], SHORT)
    first = run_benchmark(benchmark, workshop)
    file = tmp_path / "box.trials.jsonl"
    file.write_text(file.read_text() + '{"object": "box", "tri')  # stopped while writing
    ran: list[int] = []
    monkeypatch.setattr(
        trials_module, "run_trial", lambda j: (ran.append(j.trial), replace(first[0], trial=j.trial))[1]
    )
    more = run_benchmark(replace(benchmark, config=replace(SHORT, trials=3)), workshop)
    assert ran == [2]
    assert more[:2] == first
    assert [trial.trial for trial in more] == [0, 1, 2]
    again = run_benchmark(replace(benchmark, config=replace(SHORT, trials=3)), workshop)
    assert ran == [2]
    assert again == more
    other = replace(benchmark, config=replace(SHORT, seed=1))
    with pytest.raises(GraspmatchError, match=r"other settings \(settings\).*--fresh"):
        run_benchmark(other, workshop)
    assert len(run_benchmark(other, replace(workshop, fresh=True))) == 2


def test_records_of_nothing_are_nothing(tmp_path: Path) -> None:
    path = tmp_path / "trials.jsonl"
    assert read_records(path, {}, Trial) == []
    assert list(recorded([], path, {"a": 1}, done=0)) == []
    assert read_records(path, {"a": 1}, Trial) == []


@pytest.mark.parametrize("n", [1, 20, 50])
def test_wilson_intervals_agree_with_their_closed_forms(n: int) -> None:
    z2 = 1.959964**2
    assert wilson(n, n) == pytest.approx((n / (n + z2), 1.0))
    assert wilson(0, n) == pytest.approx((0.0, z2 / (n + z2)))
    low, high = wilson(n // 2, n)
    mirrored_low, mirrored_high = wilson(n - n // 2, n)
    assert (low, high) == pytest.approx((1 - mirrored_high, 1 - mirrored_low))
    assert low <= n // 2 / n <= high
    assert wilson(0, 0) == (0.0, 1.0)


def test_the_mean_is_over_objects_and_its_interval_over_trials() -> None:
    trials = [a_trial("a", True)] * 3 + [a_trial("b", False, "missed")] + [a_trial("c", False, TOPPLES)]
    a, b, c, every = summary(trials)
    assert (a.rate, b.rate, every.rate) == (1.0, 0.0, 0.5)
    assert np.isnan(c.rate)
    assert (every.held, every.trials) == (3, 4)
    assert (every.low, every.high) == wilson(3, 4)
    assert every.reasons == {"missed": 1, TOPPLES: 1}


def test_tables_and_plots_show_every_object(tmp_path: Path) -> None:
    rows = summary([a_trial("Mug", True), a_trial("Shark", False, "missed")])
    text = markdown("Table", rows, {"Mug": (0.96, 2.32)}, ["a note"])
    assert "| Mug | 100.0 % |" in text
    assert "96.0 %" in text
    assert "1 missed" in text
    assert "- a note" in text
    plot_rates(tmp_path / "rates.png", "Rates", rows, {"Mug": (0.96, 2.32)})
    plot_against_count(tmp_path / "count.png", "Count", "n", [Series("a", [1, 2, 3], rows)])
    for name in ("rates.png", "count.png"):
        pixels = np.asarray(Image.open(tmp_path / name))
        assert pixels.std() > 10  # something is drawn


def test_objects_come_from_folders_of_either_kind_or_from_code(tmp_path: Path) -> None:
    (tmp_path / "mug").mkdir()
    (tmp_path / "mug" / "mesh.stl").write_text("")
    (tmp_path / "can.obj").write_text("")
    (tmp_path / "notes.txt").write_text("")
    assert [source.name for source in folder_sources(tmp_path)] == ["can", "mug"]
    assert len(household_sources()) == 12
    with pytest.raises(GraspmatchError, match="No folder"):
        folder_sources(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(GraspmatchError, match="no object"):
        folder_sources(tmp_path / "empty")


def test_real_objects_stand_as_they_are_given(shared_data: Path) -> None:
    from graspmatch.simulate.settle import settle

    by_name = {source.name: source for source in folder_sources(shared_data / "objects" / "paper")}
    for name in ("Mug", "Shoe", "Shark"):  # those that come with their convex parts
        rest = settle(by_name[name].load(), 0.6)
        assert not rest.topples
        assert rest.levelled <= 0.005


def test_the_header_of_a_benchmark_names_what_results_depend_on(tmp_path: Path) -> None:
    config = PlannerConfig()
    planner = PlanWith(replace(config, ranking=replace(config.ranking, count=3)))
    run_benchmark(
        Benchmark("box", planner, "kinova_kg3", [BOX], replace(SHORT, trials=1)), Workshop(tmp_path, 1, quiet=True)
    )
    header = json.loads((tmp_path / "box.trials.jsonl").read_text().splitlines()[0])
    assert "count=3" in header["planner"]
    assert header["settings"]["lift"]["friction"] == 0.6
    assert header["gripper"] == load_gripper("kinova_kg3").name


def test_fast_plans_are_measured_in_a_file_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "objects").mkdir()
    trimesh.creation.box((0.05, 0.05, 0.08)).export(tmp_path / "objects" / "block.stl")
    asked = Bench(
        what="paper", gripper="kinova_kg3", objects=tmp_path / "objects", trials=1, fast=True, output=tmp_path
    )
    assert bench(asked, Speech(quiet=True)) == 0
    assert "planned with `--fast`" in (tmp_path / "paper-kinova_kg3-fast.md").read_text()
    header = json.loads((tmp_path / "paper-kinova_kg3-fast.trials.jsonl").read_text().splitlines()[0])
    assert header["planner"] == repr(PlanWith(fast(PlannerConfig())))


def test_views_are_split_by_the_side_and_the_share_that_was_seen() -> None:
    seen = [
        replace(a_trial("a", held), azimuth=np.radians(azimuth), seen=share, centre_error=0.004)
        for held, azimuth, share in ((True, -2.0, 0.45), (False, 358.0, 0.1), (True, 88.0, 0.45), (True, -91.0, 0.62))
    ]
    by_side, by_share, centre = view_sections(seen)
    assert [(row.name, row.held, row.trials) for row in by_side.rows] == [
        ("000 degrees", 1, 2),
        ("090 degrees", 1, 1),
        ("270 degrees", 1, 1),
    ]
    assert [(row.name, row.held, row.trials) for row in by_share.rows] == [
        ("00 to 20 %", 0, 1),
        ("40 to 50 %", 2, 2),
        ("50 to 100 %", 1, 1),
    ]
    assert centre.text.startswith("Median 4.0 mm")
    assert "## By the share" in markdown("Views", [], {}, [], [by_share])
    assert view_sections([a_trial("a", True)])[0].rows == []


def test_a_trial_can_be_planned_from_one_depth_image() -> None:
    seen = run_trial(job(0, replace(SHORT, view=ViewConfig())))
    assert seen.held
    assert seen.azimuth is not None
    assert seen.seen is not None
    assert 0.1 < seen.seen < 0.7
    assert seen.centre_error is not None
    assert seen.centre_error < 0.015
    blind = run_trial(job(0, replace(SHORT, view=ViewConfig(completes=False))))
    assert blind.azimuth == seen.azimuth  # the same place, the same image
    assert blind.centre_error is not None
    assert blind.centre_error > 2 * seen.centre_error


def test_variants_of_the_camera_have_files_of_their_own() -> None:
    usual = variant_of(TrialConfig(view=ViewConfig()))
    low = variant_of(TrialConfig(view=ViewConfig(elevation=0.5)))
    off = variant_of(TrialConfig(view=ViewConfig(sensor=SensorConfig(pose_error_position=0.005))))
    assert usual == ""
    assert low == "-elevation-0.5"
    assert off == "-pose-error-position-0.005"
