"""Piles cleared from one depth image after another: attempts that succeed, and how much of the piles is cleared."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from graspmatch.apps.bench.experiments import Task, variant_of
from graspmatch.apps.bench.machine import machine
from graspmatch.apps.bench.piles import Attempt, PileJob, PileTrial, run_piles
from graspmatch.apps.bench.run import Workshop, resumed
from graspmatch.apps.bench.summary import Row, band, row_of, wilson
from graspmatch.apps.bench.tables import Section, markdown, notes_on, record, rich_table, write_json, write_text
from graspmatch.apps.bench.trials import PlanWith, Trial
from graspmatch.apps.bench.view import view_notes
from graspmatch.apps.speech import Speech
from graspmatch.errors import GraspmatchError

HIDDEN = (0.0, 0.05, 0.2, 0.4, 1.0)
"""Borders of the share of an object that others hide."""


def clutter(task: Task, workshop: Workshop, say: Speech) -> dict[str, Any]:
    """Piles of objects drawn from those of the task; its JSON."""
    if task.pile > len(task.sources):
        raise GraspmatchError(f"A pile of {task.pile} needs as many objects; there are {len(task.sources)}.")
    assert task.config.view is not None
    name = task.hand_name
    label, title = f"clutter-{name}{variant_of(task.config)}", f"Piles of {task.pile}: {name}"
    benchmark = task.with_planner(label, PlanWith(task.planner))
    trials = resumed(_jobs(task), PileTrial, run_piles, lambda job: job.sources, benchmark, workshop)
    rows, sections = by_object(trials), [Section("By the share of the object that others hide", by_hidden(trials))]
    about, settings = machine(), asdict(task.config)
    notes = [cleared(trials), *view_notes(task.config.view), *notes_on(about, settings, workshop.processes)]
    say.show(rich_table(title, rows, {}))
    for section in sections:
        say.show(rich_table(section.title, section.rows, {}))
    for note in notes:
        say.show(note)
    content = {"title": title, "machine": about, "settings": settings, "rows": record(rows, {})}
    content |= {"piles": [asdict(trial) for trial in trials], "summary": notes[0]}
    content |= {"sections": {section.title: record(section.rows, {}) for section in sections}}
    write_json(workshop.output / f"{label}.json", content)
    write_text(workshop.output / f"{label}.md", markdown(title, rows, {}, notes, sections))
    say.show(f"Wrote {workshop.output / label}.json, .md")
    return content


def by_object(trials: Sequence[PileTrial]) -> list[Row]:
    """Attempts by what the hand was at, and the share of all attempts that succeeded."""
    attempts = [as_trial(attempt) for trial in trials for attempt in trial.tries]
    names = sorted({attempt.object for attempt in attempts})
    rows = [row_of(name, [attempt for attempt in attempts if attempt.object == name]) for name in names]
    return [*rows, row_of("all attempts", attempts)]


def by_hidden(trials: Sequence[PileTrial]) -> list[Row]:
    """Attempts by how much of the object was hidden."""
    groups: dict[str, list[Trial]] = {}
    for attempt in (attempt for trial in trials for attempt in trial.tries):
        if attempt.hidden is not None:
            groups.setdefault(band(attempt.hidden, HIDDEN), []).append(as_trial(attempt))
    return [row_of(name, groups[name]) for name in sorted(groups)]


def cleared(trials: Sequence[PileTrial]) -> str:
    """The figures of all piles in one sentence."""
    lifted, objects = sum(trial.cleared for trial in trials), sum(len(trial.objects) for trial in trials)
    low, high = wilson(lifted, objects)
    whole = sum(trial.cleared == len(trial.objects) for trial in trials)
    left = Counter(name for trial in trials for name in _left(trial))
    stay = f"; left behind: {', '.join(f'{count} {name}' for name, count in left.most_common())}" if left else ""
    return (
        f"{lifted} of {objects} objects were cleared: {100 * lifted / objects:.1f} % ({100 * low:.0f} - "
        f"{100 * high:.0f} %), {whole} of {len(trials)} piles wholly{stay}."
    )


def as_trial(attempt: Attempt) -> Trial:
    """As tables have it."""
    return Trial(
        object=attempt.object or "none",
        trial=0,
        held=attempt.held,
        reason=attempt.reason,
        plan_seconds=attempt.plan_seconds,
        simulation_seconds=attempt.simulation_seconds,
        grasps=0,
        preshape="",
        score=attempt.score,
        slip=0.0,
        turn=0.0,
    )


def _left(trial: PileTrial) -> list[str]:
    lifted = [attempt.object for attempt in trial.tries if attempt.held]
    return [name for name in trial.objects if name not in lifted]


def _jobs(task: Task) -> dict[tuple[str, int], PileJob]:
    """Each pile draws its objects without doubles."""
    jobs = {}
    for trial in range(task.config.trials):
        drawn = np.random.default_rng([task.config.seed, trial, 1]).choice(len(task.sources), task.pile, replace=False)
        sources = tuple(task.sources[int(i)] for i in drawn)
        planner = PlanWith(task.planner)
        jobs["pile", trial] = PileJob(sources, task.gripper, task.description, planner, trial, task.config)
    return jobs
