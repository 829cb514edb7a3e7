"""Plots of benchmarks, in one style."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graspmatch.apps.bench.summary import Row
from graspmatch.apps.bench.tables import Published
from graspmatch.formats.files import write_atomically

OURS, THEIRS, GRID = "#3b6ea5", "#c9783f", "#dfe3e8"
STYLE: Any = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "font.size": 10,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


@dataclass(frozen=True)
class Series:
    """One line of a plot: success and time against a number."""

    label: str
    x: Sequence[float]
    rows: Sequence[Row]


def plot_rates(path: Path, title: str, rows: Sequence[Row], published: Published) -> None:
    """Success rates with their intervals, and what was published beside them."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(max(6.0, 0.7 * len(rows) + 2), 3.6))
        axes = figure.add_subplot()
        place = range(len(rows))
        heights = [100 * row.rate if row.trials else 0.0 for row in rows]
        low = [max(h - 100 * row.low, 0.0) for h, row in zip(heights, rows, strict=True)]
        high = [max(100 * row.high - h, 0.0) if row.trials else 0.0 for h, row in zip(heights, rows, strict=True)]
        axes.bar(place, heights, color=OURS, width=0.6, label="graspmatch")
        axes.errorbar(place, heights, yerr=[low, high], fmt="none", ecolor="#22384f", capsize=3, lw=1)
        printed = [(i, 100 * published[row.name][0]) for i, row in enumerate(rows) if row.name in published]
        if printed:
            axes.plot(*zip(*printed, strict=True), "D", color=THEIRS, ms=5, label="paper")
        axes.set_xticks(list(place), [row.name for row in rows], rotation=30, ha="right")
        axes.set_ylabel("held [%]")
        axes.set_ylim(0, 105)
        axes.grid(axis="x", visible=False)
        axes.set_title(title, loc="left")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
        _save(figure, path)


def plot_against_count(path: Path, title: str, xlabel: str, series: Sequence[Series]) -> None:
    """Success and time against a number, side by side."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.6, 3.4))
        success, seconds = figure.subplots(1, 2)
        for line, colour in zip(series, (OURS, THEIRS, "#5a9367", "#8a6fae"), strict=False):
            means = [row.rate for row in line.rows]
            success.plot(line.x, [100 * m for m in means], "o-", color=colour, label=line.label)
            bounds = [[100 * row.low for row in line.rows], [100 * row.high for row in line.rows]]
            success.fill_between(line.x, *bounds, color=colour, alpha=0.15, lw=0)
            seconds.plot(line.x, [row.plan_seconds for row in line.rows], "o-", color=colour, label=line.label)
        success.set_ylabel("held [%]")
        success.set_ylim(0, 105)
        seconds.set_ylabel("s per plan")
        seconds.set_ylim(bottom=0)
        for axes in (success, seconds):
            axes.set_xlabel(xlabel)
        success.legend(loc="lower right")
        figure.suptitle(title, x=0.01, ha="left")
        _save(figure, path)


def _save(figure, path: Path) -> None:
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=130, format="png"))
