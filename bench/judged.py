"""Every method in the same world with the same trials: the judge's verdict on baselines beside our own.

`antipodal` and `antipodal + ours` are the experiment of Table II (right): ten grasps of another planner, written to a
GraspNet file and read back, start the matching. Trials, objects and seeds are the same for all methods.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

from rich.console import Console

from baselines.antipodal import antipodal
from baselines.split_pso import split_pso
from graspmatch.apps.bench.experiments import variant_of
from graspmatch.apps.bench.machine import described, machine, usable_cores
from graspmatch.apps.bench.objects import folder_sources, household_sources
from graspmatch.apps.bench.run import Benchmark, Workshop, run_benchmark
from graspmatch.apps.bench.summary import Row, summary
from graspmatch.apps.bench.tables import markdown, notes_on, record, rich_table, write_json, write_text
from graspmatch.apps.bench.trials import Planner, PlanWith, TrialConfig
from graspmatch.config import LiftConfig, PlannerConfig
from graspmatch.formats.registry import read_grasps, write_grasps
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet, Gripper
from setting import PAPER_OBJECTS, RESULTS

STARTS = 10
"""Grasps of the other planner that matching starts from, as in the paper."""


def refined(scene: Scene, gripper: Gripper, seed: int) -> GraspSet:
    """Ours, started from the antipodal sampler's grasps by way of a GraspNet file."""
    other = antipodal(scene, gripper, seed).best(STARTS)
    if not len(other):
        return other
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "grasps.npy"
        write_grasps(other, path, gripper)
        starts = read_grasps(path, gripper)
    return plan(scene, gripper, PlannerConfig(seed=seed), starts_world_gripper=starts.T_world_gripper)


METHODS: dict[str, Planner] = {
    "ours": PlanWith(),
    "antipodal": antipodal,
    "antipodal + ours": refined,
    "SplitPSO": split_pso,
}
METHODS_OF = {"franka_hand": ("ours", "antipodal", "antipodal + ours"), "barrett_bh282": ("ours", "SplitPSO")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gripper", default="franka_hand")
    parser.add_argument("--methods", nargs="+", choices=METHODS)
    parser.add_argument("--objects", type=Path, default=PAPER_OBJECTS)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--friction", type=float, default=0.6)
    parser.add_argument("--pose-error-mm", type=float, default=0.0)
    parser.add_argument("--pose-error-deg", type=float, default=0.0)
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--fresh", action="store_true", help="run all trials again")
    parser.add_argument("--processes", type=int, default=usable_cores())
    arguments = parser.parse_args()
    sources = folder_sources(arguments.objects) if arguments.objects.is_dir() else household_sources()
    config = TrialConfig(
        lift=LiftConfig(friction=arguments.friction),
        trials=arguments.trials,
        pose_error_mm=arguments.pose_error_mm,
        pose_error_deg=arguments.pose_error_deg,
    )
    workshop = Workshop(arguments.output, arguments.processes, arguments.fresh)
    variant = variant_of(config)
    console, tables, means = Console(width=140), {}, []
    for method in arguments.methods or METHODS_OF.get(arguments.gripper, ("ours",)):
        label = f"judged-{arguments.gripper}-{method.replace(' ', '')}{variant}"
        rows = summary(run_benchmark(Benchmark(label, METHODS[method], arguments.gripper, sources, config), workshop))
        console.print(rich_table(f"{method}, {arguments.gripper}", rows, {}))
        tables[method] = record(rows, {})
        means.append(replace(rows[-1], name=method))
    report(arguments.gripper, means, tables, config, arguments.output, arguments.processes)


def report(gripper: str, means: list[Row], tables: dict, config: TrialConfig, output: Path, processes: int) -> None:
    """Write all tables as JSON, and the means as Markdown."""
    about = machine()
    name = f"judged-{gripper}{variant_of(config)}"
    write_json(output / f"{name}.json", {"machine": about, "settings": asdict(config), "methods": tables})
    text = markdown(f"Methods in the judge: {gripper}", means, {}, notes_on(about, asdict(config), processes))
    write_text(output / f"{name}.md", text)
    print(f"Wrote {output / name}.json, .md ({described(about)})")


if __name__ == "__main__":
    main()
