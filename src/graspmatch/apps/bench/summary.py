"""From trials to rates: per object and over all, with intervals, times and reasons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import mean, median

from graspmatch.apps.bench.trials import Trial

Z95 = 1.959964
"""Of the normal distribution, for intervals of 95 %."""


@dataclass(frozen=True)
class Row:
    """What the trials of one object, or of all, come to."""

    name: str
    held: int
    trials: int
    """That count: an object that does not stand has none."""
    rate: float
    """0 to 1; over all objects, the mean of their rates. NaN without trials."""
    low: float
    high: float
    """95 % interval of Wilson (1927), over all trials."""
    plan_seconds: float
    """Median."""
    simulation_seconds: float
    """Median."""
    reasons: dict[str, int]
    """Why the others were not held, most frequent first."""


def summary(trials: Iterable[Trial]) -> list[Row]:
    """One row per object, by name, and the last over all objects that stand."""
    by_object: dict[str, list[Trial]] = {}
    for trial in trials:
        by_object.setdefault(trial.object, []).append(trial)
    rows = [row_of(name, by_object[name]) for name in sorted(by_object)]
    counted = [row for row in rows if row.trials]
    every = row_of("mean", [trial for name in by_object for trial in by_object[name]])
    rate = mean(row.rate for row in counted) if counted else float("nan")
    return [*rows, Row(**{**vars(every), "rate": rate})]


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """95 % interval of a rate from so many successes (Wilson 1927); all of 0 to 1 without trials."""
    if trials == 0:
        return 0.0, 1.0
    rate, z2 = successes / trials, Z95**2
    centre = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z95 / (1 + z2 / trials) * (rate * (1 - rate) / trials + z2 / (4 * trials**2)) ** 0.5
    return max(0.0, centre - half), min(1.0, centre + half)


def band(value: float, borders: Sequence[float]) -> str:
    """Between which borders a share lies, in percent; those of text sort as they do."""
    low, high = next(pair for pair in pairwise(borders) if value < pair[1] or pair[1] == borders[-1])
    return f"{100 * low:02.0f} to {100 * high:.0f} %"


def row_of(name: str, trials: Sequence[Trial]) -> Row:
    """What some trials come to."""
    counted = [trial for trial in trials if trial.counts]
    held = sum(trial.held for trial in counted)
    low, high = wilson(held, len(counted))
    simulated = [trial.simulation_seconds for trial in counted if trial.simulation_seconds > 0]
    return Row(
        name=name,
        held=held,
        trials=len(counted),
        rate=held / len(counted) if counted else float("nan"),
        low=low,
        high=high,
        plan_seconds=median(trial.plan_seconds for trial in counted) if counted else float("nan"),
        simulation_seconds=median(simulated) if simulated else float("nan"),
        reasons=dict(Counter(trial.reason for trial in trials if trial.reason).most_common()),
    )
