"""How the time of a plan grows with particles, points and preshapes: each varied alone, stage by stage, and plotted."""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from graspmatch.apps.bench.machine import machine
from graspmatch.config import PlannerConfig, SeedingConfig
from graspmatch.geometry.sphere import fibonacci_directions
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.plan import plan
from graspmatch.planner.seed import asked_for
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper, PointCloud
from setting import RESULTS

PARTICLES = (30, 100, 300, 1000, 3000, 10000, 30000)
POINTS = (200, 2000, 20000, 200000)
PRESHAPES = (1, 2, 4, 8, 16, 32, 64)
HALF_AXES = np.array([0.03, 0.035, 0.09])
"""Of the ellipsoid that is grasped [m]."""


def ellipsoid(points: int) -> Scene:
    """An ellipsoid on a table, with so many points."""
    directions = fibonacci_directions(points)
    normals = directions / HALF_AXES
    cloud = PointCloud(
        directions * HALF_AXES + [0, 0, HALF_AXES[2]], normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    )
    return replace(Scene.from_cloud(cloud.points), target=cloud)


def with_preshapes(gripper: Gripper, count: int) -> Gripper:
    """The hand with so many preshapes: those that its card asks for, over and over."""
    own = [gripper.preshapes[i] for i in asked_for(gripper)]
    return replace(gripper, preshapes=tuple(itertools.islice(itertools.cycle(own), count)))


def with_particles(gripper: Gripper, count: int) -> SeedingConfig:
    """About so many particles over all preshapes."""
    return SeedingConfig(pattern="sphere", points=max(round(count / len(asked_for(gripper))) - 6, 1))


def cases(gripper: Gripper, most_particles: int) -> dict[str, dict[int, Callable[[int], dict[str, float]]]]:
    """What is varied, its values, and for each the stages' times [s] of a plan with some seed."""
    scene = ellipsoid(10000)
    config = PlannerConfig(device="cpu")

    def seconds(scene: Scene, gripper: Gripper, seeding: SeedingConfig, seed: int) -> dict[str, float]:
        return plan(scene, gripper, replace(config, seeding=seeding, seed=seed)).provenance.seconds

    usual = SeedingConfig()
    particles = [n for n in PARTICLES if n <= most_particles]
    return {
        "particles": {n: partial(seconds, scene, gripper, with_particles(gripper, n)) for n in particles},
        "points": {n: partial(seconds, ellipsoid(n), gripper, usual) for n in POINTS},
        "preshapes": {n: partial(seconds, scene, with_preshapes(gripper, n), usual) for n in PRESHAPES},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gripper", default="franka_hand")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--short", action="store_true", help="3,000 particles at most")
    arguments = parser.parse_args()
    report: dict = {"machine": machine(), "gripper": arguments.gripper, "ms": {}}
    for varied, runs in cases(load_gripper(arguments.gripper), 3000 if arguments.short else PARTICLES[-1]).items():
        report["ms"][varied] = {}
        for value, run in runs.items():
            run(0)  # uploads the hand
            times = [run(seed) for seed in range(arguments.repeats)]
            report["ms"][varied][value] = {name: 1000 * float(np.median([t[name] for t in times])) for name in times[0]}
        show(varied, report["ms"][varied])
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "scaling.json").write_text(json.dumps(report, indent=1) + "\n")
    draw(report["ms"])


def show(varied: str, rows: dict[int, dict[str, float]]) -> None:
    """Print the stages' times for each value."""
    stages = list(next(iter(rows.values())))
    table = Table(title=f"{varied} [ms]")
    for column in (varied, *stages, "plan"):
        table.add_column(column, justify="right")
    for value, times in rows.items():
        table.add_row(f"{value:,}", *(f"{times[stage]:.1f}" for stage in stages), f"{sum(times.values()):.1f}")
    Console(width=110).print(table)


def draw(ms: dict[str, dict[int, dict[str, float]]]) -> None:
    """One panel for each thing varied, a line for each stage."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(ms), figsize=(4 * len(ms), 3.6), sharey=True, layout="constrained")
    for panel, (varied, rows) in zip(panels, ms.items(), strict=True):
        for stage in next(iter(rows.values())):
            panel.loglog(list(rows), [times[stage] for times in rows.values()], marker=".", linewidth=1, label=stage)
        panel.loglog(list(rows), [sum(times.values()) for times in rows.values()], "k.-", label="plan")
        panel.set_xlabel(varied)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("ms")
    panels[-1].legend(fontsize="small")
    figure.savefig(RESULTS / "scaling.png", dpi=150)


if __name__ == "__main__":
    main()
