"""The benchmarks of the command line: the paper's tables, its ablation study, and a quick check of everything."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import mean
from typing import Any

from graspmatch.apps.bench.machine import described, machine
from graspmatch.apps.bench.objects import ObjectSource
from graspmatch.apps.bench.paper import PAPER, TABLES
from graspmatch.apps.bench.plots import Series, plot_against_count, plot_rates
from graspmatch.apps.bench.run import Benchmark, Workshop, run_benchmark
from graspmatch.apps.bench.summary import Row, summary
from graspmatch.apps.bench.tables import (
    Published,
    Section,
    markdown,
    notes_on,
    record,
    rich_table,
    write_json,
    write_text,
)
from graspmatch.apps.bench.trials import Planner, PlanWith, Trial, TrialConfig
from graspmatch.apps.speech import Speech
from graspmatch.config import Method, PlannerConfig, PoseGaussian, ViewConfig
from graspmatch.geometry import se3
from graspmatch.gripper.card import read_card
from graspmatch.gripper.zoo import card_path
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet, Gripper

PARTICLES = (4, 8, 16, 32, 64)
"""Initialisations of each preshape in the ablation study."""
METHODS: tuple[Method, ...] = ("icp", "sgd-icp", "stein-icp", "annealed-stein-icp")


@dataclass(frozen=True)
class Task:
    """What a benchmark is asked for."""

    gripper: str
    """Name of a known hand, or path of a card."""
    description: Path | None
    sources: Sequence[ObjectSource]
    config: TrialConfig
    planner: PlannerConfig
    pile: int = 5
    """Objects in a pile."""

    @property
    def hand_name(self) -> str:
        """The name on the hand's card."""
        return read_card(card_path(self.gripper)).name

    def with_planner(self, label: str, planner: Planner) -> Benchmark:
        """Its trials with a planner."""
        return Benchmark(label, planner, self.gripper, self.sources, self.config, self.description)


def paper(task: Task, workshop: Workshop, say: Speech) -> dict[str, Any]:
    """Table II (Franka Hand) or III (Barrett) of the paper, or the same table for another hand; its JSON."""
    name = task.hand_name
    title = f"{TABLES[name]}: {name}" if name in TABLES else name
    return rates(title, f"paper-{name}{variant_of(task.config)}", task, PAPER.get(name, {}), workshop, say)


def quick(task: Task, workshop: Workshop, say: Speech) -> dict[str, Any]:
    """The twelve objects made by code: runs anywhere."""
    begin = time.perf_counter()
    name = task.hand_name
    result = rates(f"Objects made by code: {name}", f"quick-{name}{variant_of(task.config)}", task, {}, workshop, say)
    say.show(f"Done in {time.perf_counter() - begin:.0f} s.")
    return result


def rates(
    title: str,
    label: str,
    task: Task,
    published: Published,
    workshop: Workshop,
    say: Speech,
    *,
    sections: Callable[[Sequence[Trial]], Sequence[Section]] = lambda trials: (),
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Run trials; show their table and write it as JSON, Markdown and a plot."""
    trials = run_benchmark(task.with_planner(label, PlanWith(task.planner)), workshop)
    rows, published = with_common_mean(summary(trials), trials, published)
    about, settings = machine(), asdict(task.config)
    notes = notes_on(about, settings, workshop.processes, [*notes, *_fidelity(task.sources)])
    parts = sections(trials)
    say.show(rich_table(title, rows, published))
    for part in parts:
        say.show(rich_table(part.title, part.rows, {}) if part.rows else f"{part.title}: {part.text}")
    for note in notes:
        say.show(note)
    content = {"title": title, "machine": about, "settings": settings, "rows": record(rows, published)}
    content |= {"sections": {part.title: record(part.rows, {}) or part.text for part in parts}} if parts else {}
    write_json(workshop.output / f"{label}.json", content)
    write_text(workshop.output / f"{label}.md", markdown(title, rows, published, notes, parts))
    plot_rates(workshop.output / f"{label}.png", title, rows, published)
    say.show(f"Wrote {workshop.output / label}.json, .md, .png")
    return content


def with_common_mean(rows: list[Row], trials: Sequence[Trial], published: Published) -> tuple[list[Row], Published]:
    """The rows with another mean, over the objects that a publication has too: only these compare."""
    common = sorted({trial.object for trial in trials} & published.keys())
    if not common:
        return rows, {}
    name = f"mean of {len(common)} common"
    ours = summary(trial for trial in trials if trial.object in common)[-1]
    theirs = [published[object_] for object_ in common]
    figures = (mean(rate for rate, _ in theirs), mean(seconds for _, seconds in theirs))
    return [*rows, replace(ours, name=name)], {**{object_: published[object_] for object_ in common}, name: figures}


@dataclass(frozen=True)
class PlanFromGaussians:
    """The planner started from four Gaussians around each object: above it, and three from obliquely above.

    The paper chose four means by hand; these are for an object on a table with the robot at -x.
    """

    config: PlannerConfig = field(default_factory=PlannerConfig)

    def __call__(self, scene: Scene, gripper: Gripper, seed: int) -> GraspSet:
        """Grasps for the scene."""
        from graspmatch.planner.plan import plan

        seeding = replace(self.config.seeding, pattern="gaussians", gaussians=four_gaussians(scene, gripper))
        return plan(scene, gripper, replace(self.config, seeding=seeding, seed=seed))


def four_gaussians(scene: Scene, gripper: Gripper) -> tuple[PoseGaussian, ...]:
    """Poses at the outline of the object that face its centre of mass, the closing axis level."""
    import numpy as np

    directions = np.array([(0, 0, 1), (-1, 0, 1), (-0.5, 0.87, 1), (-0.5, -0.87, 1)], dtype=float)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    means = []
    for direction in directions:
        level = np.cross((0, 0, 1), direction) if abs(direction[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
        R_world_gripper = se3.rotation_facing(-direction, level) @ gripper.T_gripper_canonical[:3, :3].T
        reach = max(float(((scene.target.points - scene.centre_of_mass) @ direction).max()), 0.0)
        position = scene.centre_of_mass + reach * direction - R_world_gripper @ gripper.tool_centre_point
        quaternion = se3.quaternion_from_matrix(R_world_gripper)
        means.append(PoseGaussian((*position.tolist(),), (*quaternion.tolist(),), sigma_angle=0.5))
    return tuple(means)


def ablation(task: Task, workshop: Workshop, say: Speech) -> dict[str, Any]:
    """Success and time against the number of initialisations, for two ways to choose them, and for the four methods."""
    name, about = f"ablation-{task.hand_name}{variant_of(task.config)}", machine()

    def run(what: str, planner: Planner) -> Row:
        row = replace(summary(run_benchmark(task.with_planner(f"{name}-{what}", planner), workshop))[-1], name=what)
        say.show(f"{what:24s} {100 * row.rate:5.1f} % held, {row.plan_seconds:.2f} s")
        return row

    fibonacci, gaussian = [], []
    for count in PARTICLES:
        fibonacci.append(run(f"fibonacci-{count}", PlanWith(_with_starts(task.planner, count))))
        gaussian.append(run(f"gaussian-{count}", PlanFromGaussians(_with_draws(task.planner, count))))
    methods = [run(method, PlanWith(_with_method(task.planner, method))) for method in METHODS]
    lines = [Series("Fibonacci", PARTICLES, fibonacci), Series("Gaussian", PARTICLES, gaussian)]
    title = f"Ablation: {task.hand_name}"
    plot_against_count(workshop.output / f"{name}.png", title, "initialisations per preshape", lines)
    content = {
        "machine": about,
        "settings": asdict(task.config),
        "objects": [source.name for source in task.sources],
        "particles": list(PARTICLES),
        "fibonacci": record(fibonacci, {}),
        "gaussian": record(gaussian, {}),
        "methods": record(methods, {}),
    }
    write_json(workshop.output / f"{name}.json", content)
    notes = notes_on(about, asdict(task.config), workshop.processes)
    write_text(workshop.output / f"{name}.md", markdown(title, [*fibonacci, *gaussian, *methods], {}, notes))
    say.show(f"Wrote {workshop.output / name}.json, .md, .png ({described(about)})")
    return content


def _with_starts(config: PlannerConfig, count: int) -> PlannerConfig:
    """A fifth of the starts above the object, at most the six of Table I, the rest on the quarter sphere."""
    above = min(config.seeding.above, max(1, count // 5))
    return replace(config, seeding=replace(config.seeding, points=4 * (count - above), above=above))


def _with_draws(config: PlannerConfig, count: int) -> PlannerConfig:
    return replace(config, seeding=replace(config.seeding, points=count))


def _with_method(config: PlannerConfig, method: Method) -> PlannerConfig:
    return replace(config, matching=replace(config.matching, method=method))


def variant_of(config: TrialConfig) -> str:
    """Names a variant of the protocol or of planning, so that its trials have a file of their own."""
    parts = []
    if config.lift.friction != 0.6:
        parts.append(f"friction-{config.lift.friction:g}")
    if config.lift.mass is not None:
        parts.append(f"mass-{config.lift.mass:g}")
    if config.pose_error_mm or config.pose_error_deg:
        parts.append(f"error-{config.pose_error_mm:g}mm-{config.pose_error_deg:g}deg")
    parts += ["fast"] if config.fast else []
    parts += [] if config.view is None else variant_of_view(config.view)
    return "".join(f"-{part}" for part in parts)


def variant_of_view(view: ViewConfig) -> list[str]:
    """The same of what the camera is like: the settings that are not the default."""
    given, usual = ({**asdict(each), **asdict(each)["sensor"]} for each in (view, ViewConfig()))
    changed = [name for name in given if name != "sensor" and given[name] != usual[name]]
    return [f"{name.replace('_', '-')}-{float(given[name]):.3g}" for name in changed]


def _fidelity(sources: Sequence[ObjectSource]) -> list[str]:
    """How far the convex parts reach beyond the meshes."""
    bulges = {source.name: source.load().bulge for source in sources}
    worst = max(bulges, key=lambda name: bulges[name])
    listed = ", ".join(f"{name} {1000 * bulge:.1f}" for name, bulge in bulges.items())
    return [f"Bulge of the convex parts beyond the mesh at 95 % of their surface [mm]: {listed} (most: {worst})."]
