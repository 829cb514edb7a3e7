"""A benchmark from objects and planners to trials, with a progress bar, resumable."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from inspect import isfunction
from pathlib import Path
from typing import Any, TypeVar

from graspmatch.apps.bench.machine import machine
from graspmatch.apps.bench.objects import ObjectSource
from graspmatch.apps.bench.records import Record, read_records, recorded
from graspmatch.apps.bench.trials import Job, Planner, Trial, TrialConfig, run_trials
from graspmatch.apps.speech import Speech

AnyJob = TypeVar("AnyJob")


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
    jobs = {
        (source.name, trial): Job(
            source, benchmark.gripper, benchmark.description, benchmark.planner, trial, benchmark.config
        )
        for source in benchmark.sources
        for trial in range(benchmark.config.trials)
    }
    return resumed(jobs, Trial, run_trials, lambda job: [job.source], benchmark, workshop)


def resumed(
    jobs: dict[tuple[str, int], AnyJob],
    kind: Callable[..., Record],
    run: Callable[..., Iterator[Record]],
    needed: Callable[[AnyJob], Sequence[ObjectSource]],
    benchmark: Benchmark,
    workshop: Workshop,
) -> list[Record]:
    """The records of all jobs in their order, `kind` of an earlier run or of `run`; `needed` are a job's objects."""
    path = workshop.output / f"{benchmark.label}.trials.jsonl"
    header = _header(benchmark)
    if workshop.fresh:
        path.unlink(missing_ok=True)
    known = {record.key: record for record in read_records(path, header, kind)}
    todo = [job for key, job in jobs.items() if key not in known]
    say = Speech(quiet=workshop.quiet)
    sources = list(dict.fromkeys(source for job in todo for source in needed(job)))
    with say.progress(f"{benchmark.label}: preparing objects", total=len(sources)) as done:
        for source in sources:
            source.load()  # once, here: the processes find its convex parts in the cache
            done()
    with say.progress(f"{benchmark.label}: trials", total=len(todo)) as done:
        for record in recorded(run(todo, processes=workshop.processes), path, header, done=len(known)):
            known[record.key] = record
            done()
    return [known[key] for key in jobs]


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
