"""Rates as a table for the terminal and for Markdown, as JSON, and as a plot."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from graspmatch.apps.bench.machine import described
from graspmatch.apps.bench.summary import Row
from graspmatch.apps.report import finite_or_null
from graspmatch.formats.files import write_atomically

Published = dict[str, tuple[float, float]]
"""Rate and seconds per plan by object, as a publication prints them."""


@dataclass(frozen=True)
class Section:
    """The same trials, split in another way."""

    title: str
    rows: Sequence[Row]
    text: str = ""


def cells(row: Row, published: Published) -> list[str]:
    """One row of the table: object, rate, interval, held of trials, published rate, times, reasons."""
    printed = published.get(row.name)
    if row.trials:
        rate, interval = f"{100 * row.rate:.1f} %", f"{100 * row.low:.0f} - {100 * row.high:.0f} %"
    else:
        rate, interval = "-", "-"
    reasons = "; ".join(f"{count} {reason}" for reason, count in row.reasons.items())
    return [
        row.name,
        rate,
        interval,
        f"{row.held}/{row.trials}",
        f"{100 * printed[0]:.1f} %" if printed else "-",
        _seconds(row.plan_seconds),
        f"{printed[1]:.2f}" if printed else "-",
        _seconds(row.simulation_seconds),
        reasons,
    ]


HEADINGS = ("object", "held", "95 %", "trials", "paper", "plan s", "paper s", "lift s", "failures")


def rich_table(title: str, rows: Sequence[Row], published: Published) -> Table:
    """The table for a terminal; the mean is apart from the objects."""
    table = Table(title=title, title_justify="left")
    for heading in HEADINGS:
        table.add_column(heading, justify="left" if heading in ("object", "failures") else "right")
    for index, row in enumerate(rows):
        is_last_object = index + 1 < len(rows) and rows[index + 1].name == "mean"
        table.add_row(*cells(row, published), end_section=is_last_object)
    return table


def markdown(
    title: str, rows: Sequence[Row], published: Published, notes: Sequence[str], sections: Sequence[Section] = ()
) -> str:
    """The same as Markdown, with notes below it, and then the same trials split in other ways."""
    lines = [f"# {title}", "", *_markdown_table(rows, published), "", *(f"- {note}" for note in notes), ""]
    for section in sections:
        lines += [f"## {section.title}", ""]
        lines += [*_markdown_table(section.rows, published), ""] if section.rows else []
        lines += [section.text, ""] if section.text else []
    return "\n".join(lines)


def _markdown_table(rows: Sequence[Row], published: Published) -> list[str]:
    head = ["| " + " | ".join(HEADINGS) + " |", "| --- |" + " ---: |" * (len(HEADINGS) - 2) + " --- |"]
    return head + ["| " + " | ".join(cells(row, published)) + " |" for row in rows]


def notes_on(about: dict[str, str], settings: dict[str, Any], processes: int, extra: Sequence[str] = ()) -> list[str]:
    """What a reader must know of the figures: protocol, friction, mass, seed, machine."""
    lift = settings["lift"]
    mass = "300 kg/m3, 50 to 500 g" if lift["mass"] is None else f"{1000 * lift['mass']:.0f} g"
    error = f"{settings['pose_error_mm']:g} mm, {settings['pose_error_deg']:g} degrees"
    return [
        f"Protocol `lift` version 1: friction {lift['friction']:g}, mass {mass}, pose error {error}, "
        f"seed {settings['seed']}; only the top-ranked grasp of each plan is tried"
        f"{'; planned with `--fast`' * settings['fast']}.",
        "The mean is over the objects' rates, its interval over all trials. Times are medians, with "
        f"{processes} trial{'s' * (processes != 1)} at a time on all cores.",
        described(about),
        *extra,
    ]


def write_json(path: Path, content: dict[str, Any]) -> None:
    """A result that other programs read; what is not a number is null."""
    text = json.dumps(finite_or_null(content), indent=1, allow_nan=False) + "\n"
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_text(path: Path, text: str) -> None:
    """A whole file or none."""
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def record(rows: Sequence[Row], published: Published) -> list[dict[str, Any]]:
    """The rows as JSON, with the published figures."""
    return [
        {**asdict(row), "published": dict(zip(("rate", "seconds"), published[row.name], strict=True))}
        if row.name in published
        else asdict(row)
        for row in rows
    ]


def _seconds(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"
