"""Confidence against simulation: which figures foretell whether a grasp holds, and with which weights.

For every object of a development set the planner is asked for many grasps, and each is lifted by the protocol `lift`.
A logistic model of few figures is fitted to what happened, over all hands at once; what each figure is worth is shown
by leaving it out. The model is judged on objects that it was not fitted to: by cross-validation (an object is left out
with all its grasps, of all hands), and on a check set that had no part in anything. Last come the constants for
`CALIBRATION` in planner/grade.py.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from calibration_data import HOUSEHOLD, Entry, Job, Lifted, collect, concatenated, object_sets, planner_for, set_name
from calibration_fit import (
    MODEL,
    OTHERS,
    Bin,
    Model,
    calibration_error,
    cross_validated,
    firsts,
    fit,
    log_losses,
    planner_model,
    reliability,
    skill,
)
from graspmatch.apps.bench.machine import described, machine, usable_cores
from graspmatch.apps.bench.plots import OURS, STYLE, THEIRS
from graspmatch.apps.bench.tables import write_json, write_text
from graspmatch.config import LiftConfig
from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import write_atomically
from setting import RESULTS, ROOT

OBJECTS = ROOT / ".." / "shared" / "data" / "objects"


@dataclass(frozen=True)
class Judged:
    """Grasps, and confidences in them by models that were not fitted to their objects."""

    label: str
    lifted: Lifted
    confidence: Float[np.ndarray, "n"]

    @property
    def bins(self) -> list[Bin]:
        """Of like confidence."""
        return reliability(self.confidence, self.lifted.held)


@dataclass(frozen=True)
class Sheet:
    """A table for the terminal and for Markdown."""

    title: str
    headings: tuple[str, ...]
    rows: list[tuple[str, ...]]

    def shown(self) -> Table:
        """For the terminal."""
        table = Table(title=self.title, title_justify="left")
        for index, heading in enumerate(self.headings):
            table.add_column(heading, justify="right" if index else "left")
        for row in self.rows:
            table.add_row(*row)
        return table

    def written(self) -> str:
        """As Markdown."""
        rule = "| --- |" + " ---: |" * (len(self.headings) - 1)
        lines = ["| " + " | ".join(row) + " |" for row in (self.headings, *self.rows)]
        return "\n".join([f"## {self.title}", "", lines[0], rule, *lines[1:], ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hands", nargs="+", default=["franka_hand", "barrett_bh282", "kinova_kg3"])
    sets = f"`{HOUSEHOLD}`, made by code, or folders of NAME/mesh.*"
    parser.add_argument("--objects", nargs="+", default=[HOUSEHOLD, str(OBJECTS / "contactdb")], help=sets)
    parser.add_argument("--check", nargs="*", default=[str(OBJECTS / "ycb")], help="the same, not fitted to")
    parser.add_argument("--count", type=int, default=40, help="grasps of each plan")
    parser.add_argument("--hold-seconds", type=float, default=LiftConfig().hold_seconds, help="after the lift")
    parser.add_argument("--cache", type=Path, default=ROOT / "build" / "calibration", help="of what was lifted")
    parser.add_argument("--fresh", action="store_true", help="lift everything again")
    parser.add_argument("--processes", type=int, default=usable_cores())
    parser.add_argument("--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    try:
        entries = collect(jobs_of(arguments), processes=arguments.processes, fresh=arguments.fresh)
        fitted_to = {set_name(name) for name in arguments.objects}
        development = {job: entry for job, entry in entries.items() if job.set in fitted_to}
        check = {job: entry for job, entry in entries.items() if job.set not in fitted_to}
        report(development, check, arguments.output)
    except GraspmatchError as error:
        raise SystemExit(f"error: {error}") from error


def jobs_of(arguments: argparse.Namespace) -> list[Job]:
    """Every hand with every object, those of the check set too."""
    lift, planner = LiftConfig(hold_seconds=arguments.hold_seconds), planner_for(arguments.count)
    return [
        Job(hand, label, source, planner, lift, arguments.cache)
        for label, sources in object_sets([*arguments.objects, *arguments.check]).items()
        for source in sources
        for hand in arguments.hands
    ]


def report(development: dict[Job, Entry], check: dict[Job, Entry], output: Path) -> None:
    """Fit, compare and show; write `calibration` as JSON, Markdown and a plot."""
    lifted, held_out = (concatenated(entry.lifted for entry in part.values()) for part in (development, check))
    model, now = fit(lifted), planner_model()
    judged = [Judged("development", lifted, cross_validated(lifted))]
    if len(held_out):
        judged.append(Judged("check", held_out, model.confidence(held_out)))
    planned = [Judged(f"{one.label}, by the planner", one.lifted, now.confidence(one.lifted)) for one in judged]
    sheets = [ablation(lifted), models([*judged, *planned]), by_hand(judged), bins_of(judged)]
    notes = [comparison(model, now), *notes_on(development, check)]
    console = Console(width=140)
    for sheet in sheets:
        console.print(sheet.shown(), highlight=False)
    print("\n".join(notes))
    output.mkdir(parents=True, exist_ok=True)
    text = ["# Confidence against simulation", "", *(sheet.written() for sheet in sheets)]
    write_text(output / "calibration.md", "\n".join([*text, *(f"- {note}" for note in notes), ""]))
    content = {"machine": machine(), "notes": notes, "fit": asdict(model), "planner": asdict(now)}
    content["sheets"] = [asdict(sheet) for sheet in sheets]
    content["reliability"] = {one.label: [asdict(entry) for entry in one.bins] for one in judged}
    write_json(output / "calibration.json", content)
    plot_reliability(output / "calibration.png", judged)
    print(f"Wrote {output / 'calibration'}.json, .md, .png")


def ablation(lifted: Lifted) -> Sheet:
    """What each term is worth: the model without it, with it alone, and with one more, all cross-validated."""
    variants = {"the model": MODEL}
    variants |= {f"without {name}": tuple(other for other in MODEL if other != name) for name in MODEL}
    variants |= {f"only {name}": (name,) for name in MODEL}
    variants |= {f"with {name} too": (*MODEL, name) for name in OTHERS}
    base = log_losses(cross_validated(lifted), lifted)
    rows = []
    for name, terms in variants.items():
        confidence = cross_validated(lifted, terms)
        more = log_losses(confidence, lifted) - base
        error = more.std(ddof=1) / np.sqrt(len(more))
        gain = "" if terms == MODEL else f"{more.mean():+.3f} ± {error:.3f}"
        rows.append((name, *figures(confidence, lifted, gain), parameters(fit(lifted, terms))))
    return Sheet("Terms, on the development set", ("", *FIGURES, "offset and weights"), rows)


FIGURES = ("log loss", "more than the model's", "AUC", "AUC within objects", "first holds")


def figures(confidence: Float[np.ndarray, "n"], lifted: Lifted, gain: str) -> tuple[str, ...]:
    """Cells of one row."""
    of = skill(confidence, lifted)
    first = f"{of.first_held}/{of.feasible}"
    return f"{of.log_loss:.3f}", gain, f"{of.auc:.3f}", f"{of.auc_within:.3f}", first


def parameters(model: Model) -> str:
    """Offset and weights for reading."""
    return ", ".join(f"{value:g}" for value in model.constants)


def models(judged: Sequence[Judged]) -> Sheet:
    """The model fitted and the one in the planner, on both sets."""
    headings = ("", "log loss", "AUC", "AUC within objects", "first holds", "confidence is off by")
    rows = []
    for one in judged:
        log_loss, _, *others = figures(one.confidence, one.lifted, "")
        rows.append((one.label, log_loss, *others, f"{100 * calibration_error(one.bins):.1f} points"))
    return Sheet("Models, on objects", headings, rows)


def by_hand(judged: Sequence[Judged]) -> Sheet:
    """Mean confidence against what held, for all grasps and for the first of each object."""
    rows = []
    for one in judged:
        for hand in np.unique(one.lifted.hand):
            mine = one.lifted.hand == hand
            lifted, confidence = one.lifted.select(mine), one.confidence[mine]
            first = firsts(confidence, lifted.group)
            shares = [100 * float(np.mean(v)) for v in (confidence, lifted.held, confidence[first], lifted.held[first])]
            counts = (str(len(first)), str(len(lifted)))
            rows.append((f"{hand}, {one.label}", *counts, *(f"{share:.1f} %" for share in shares)))
    headings = ("", "objects", "grasps", "confidence", "held", "confidence in the first", "first held")
    return Sheet("Hands", headings, rows)


def bins_of(judged: Sequence[Judged]) -> Sheet:
    """The reliability plot in figures."""
    rows = [
        (
            f"{one.label}, {100 * b.low:.0f} to {100 * b.high:.0f} %",
            f"{100 * b.confidence:.1f} %",
            f"{100 * b.share:.1f} %",
            f"{100 * b.interval[0]:.0f} - {100 * b.interval[1]:.0f} %",
            f"{b.held}/{b.count}",
        )
        for one in judged
        for b in one.bins
    ]
    return Sheet("Reliability", ("confidence", "mean", "held", "95 %", "grasps"), rows)


def comparison(model: Model, now: Model) -> str:
    """The constants to paste, and whether the planner has them."""
    fitted = f"The fit: CALIBRATION = ({parameters(model)})"
    if model.constants == now.constants:
        return f"{fitted}, as in planner/grade.py."
    return f"{fitted}. They differ from those in planner/grade.py: ({parameters(now)})."


def notes_on(development: dict[Job, Entry], check: dict[Job, Entry]) -> list[str]:
    """What a reader must know of the figures."""
    entries = {**development, **check}
    first = next(iter(entries))
    names = [", ".join(dict.fromkeys(job.set for job in part)) or "none" for part in (development, check)]
    empty = [f"{job.hand} {job.object} ({entry.note})" for job, entry in entries.items() if entry.note]
    reasons = Counter(reason for entry in entries.values() for reason in entry.lifted.reason.tolist() if reason)
    commits = ", ".join(sorted({entry.commit for entry in entries.values()}))
    return [
        f"Development set: {names[0]}. Check set, of which the fit knows nothing: {names[1]}. One plan of up to "
        f"{first.planner.ranking.count} grasps for each hand and object, all of them lifted.",
        f"Protocol `lift` version 1 with a hold of {first.lift.hold_seconds:g} s: friction {first.lift.friction:g}, "
        "mass 300 kg/m3, 50 to 500 g.",
        "On the development set every object is judged by a model fitted without it, whatever the hand. In fits and "
        "log losses each object of each hand weighs the same; AUC and reliability count grasps, and `first holds` "
        "objects with any grasp that held. What follows ± is the "
        "standard error over hands and objects; the intervals of the reliability take grasps for independent, which "
        "those of one object are not.",
        "The grasps are the best by the model that the planner had, so that what its terms rule out is not among "
        "them, and what a term is worth is shown too small.",
        f"Failures: {'; '.join(f'{count} {reason}' for reason, count in reasons.most_common()) or 'none'}.",
        f"Without grasps: {'; '.join(empty) or 'none'}.",
        f"Lifted at commit {commits}. {described(machine())}.",
    ]


def plot_reliability(path: Path, judged: Sequence[Judged]) -> None:
    """Share that held against confidence, and how many grasps there are of each confidence."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 6.0))
        share, count = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1))
        share.plot([0, 100], [0, 100], "--", color="#9aa3ad", lw=1, label="as confident as right")
        for number, (one, colour) in enumerate(zip(judged, (OURS, THEIRS), strict=False)):
            x = np.array([100 * entry.confidence for entry in one.bins])
            y = np.array([100 * entry.share for entry in one.bins])
            bounds = 100 * np.array([entry.interval for entry in one.bins]).T
            away = np.maximum([y - bounds[0], bounds[1] - y], 0.0)
            label = f"{one.label} ({len(one.lifted)} grasps)"
            share.errorbar(x, y, yerr=away, fmt="o-", color=colour, ms=4, capsize=3, lw=1.2, label=label)
            left = [100 * entry.low + 1 + 4 * number for entry in one.bins]
            count.bar(left, [entry.count for entry in one.bins], width=4, align="edge", color=colour)
        share.set_ylabel("held [%]")
        share.set_ylim(0, 102)
        share.legend(loc="upper left")
        share.set_title("Confidence against simulation", loc="left")
        count.set_ylabel("grasps")
        count.set_xlabel("confidence [%]")
        count.set_xlim(0, 100)
        write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=130, format="png"))


if __name__ == "__main__":
    main()
