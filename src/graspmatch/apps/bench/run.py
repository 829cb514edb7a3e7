"""A benchmark from objects and planners to trials, with a progress bar, resumable."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from inspect import isfunction
from pathlib import Path
from typing import Any

from graspmatch.apps.bench.machine import machine
from graspmatch.apps.bench.objects import ObjectSource
from graspmatch.apps.bench.records import read_records, recorded
from graspmatch.apps.bench.trials import Job, Planner, Trial, TrialConfig, run_trials
from graspmatch.apps.speech import Speech


@dataclass(frozen=True)
class Benchmark:
    """One planner with one hand on some objects."""

    label: str
    """Names the file of its trials."""
    planner: Planner
    gripper: str
    sources: Sequence[ObjectSource]
    config: TrialConfig
    description: Path | None = None


@dataclass(frozen=True)
class Workshop:
    """Where and how trials are run."""

    output: Path
    """Folder for their records."""
    processes: int
    fresh: bool = False
    """Forget earlier trials."""
    quiet: bool = False


def run_benchmark(benchmark: Benchmark, workshop: Workshop) -> list[Trial]:
    """All its trials, by object and number; those that an earlier run has written down are not run again."""
    path = workshop.output / f"{benchmark.label}.trials.jsonl"
    header = _header(benchmark)
    if workshop.fresh:
        path.unlink(missing_ok=True)
    wanted = [(source, trial) for source in benchmark.sources for trial in range(benchmark.config.trials)]
    known = {(trial.object, trial.trial): trial for trial in read_records(path, header)}
    todo = [(source, trial) for source, trial in wanted if (source.name, trial) not in known]
    jobs = [
        Job(source, benchmark.gripper, benchmark.description, benchmark.planner, trial, benchmark.config)
        for source, trial in todo
    ]
    say = Speech(quiet=workshop.quiet)
    new = list(dict.fromkeys(source for source, _ in todo))
    with say.progress(f"{benchmark.label}: preparing objects", total=len(new)) as done:
        for source in new:
            source.load()  # once, here: the processes find its convex parts in the cache
            done()
    with say.progress(f"{benchmark.label}: trials", total=len(jobs)) as done:
        for trial in recorded(run_trials(jobs, processes=workshop.processes), path, header, done=len(known)):
            known[trial.object, trial.trial] = trial
            done()
    return [known[source.name, trial] for source, trial in wanted]


def _header(benchmark: Benchmark) -> dict[str, Any]:
    """What the results depend on, as JSON reads it back. The number of trials is not of it: more can be added."""
    from graspmatch.gripper.description import content_hash
    from graspmatch.gripper.kinematics import load_hand
    from graspmatch.gripper.zoo import card_path

    settings = asdict(benchmark.config)
    del settings["trials"]
    hand, planner, about = load_hand(card_path(benchmark.gripper), benchmark.description), benchmark.planner, machine()
    header = {
        "gripper": hand.card.name,
        "gripper_hash": content_hash(hand.card, hand.description),
        "planner": f"{planner.__module__}.{planner.__qualname__}" if isfunction(planner) else repr(planner),
        "settings": settings,
        "objects": {source.name: source.content_hash() for source in benchmark.sources},
        "versions": {name: about[name] for name in ("graspmatch", "commit", "mujoco", "warp")},
    }
    return json.loads(json.dumps(header))
