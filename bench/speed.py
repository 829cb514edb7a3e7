"""How fast planning is: the table of targets, the stages of a plan, memory, start-up, and PyTorch beside it.

Times are of whole `plan` calls, warm, every repeat with another seed and the parameters of Table I: the median over the
objects of each one's median. Run this on an idle machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from footprint import footprint
from graspmatch.apps.bench.machine import machine
from graspmatch.config import PlannerConfig, fast
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.many import plan_many
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper
from setting import PAPER_OBJECTS, RESULTS, scenes

GRIPPERS = ("franka_hand", "barrett_bh282", "kinova_kg3", "robotiq_2f85")
TARGETS: dict[str, tuple[str, str, Callable[[float], bool]]] = {
    "franka_cpu_ms": ("Franka, two CPU cores", "<= 100 ms", lambda ms: ms <= 100),
    "barrett_cpu_ms": ("Barrett, two CPU cores", "<= 40 ms", lambda ms: ms <= 40),
    "franka_gpu_ms": ("Franka, one GPU", "<= 5 ms", lambda ms: ms <= 5),
    "barrett_gpu_ms": ("Barrett, one GPU", "<= 4 ms", lambda ms: ms <= 4),
    "many_cpu_ratio": ("100 scenes in one call, by one by one", "<= 1.05, linear", lambda ratio: ratio <= 1.05),
    "many_gpu_per_s": ("100 scenes in one call, one GPU", ">= 1000 plans/s", lambda rate: rate >= 1000),
    "torch_ratio_cpu": ("matching in plain PyTorch takes", ">= 30 times as long", lambda ratio: ratio >= 30),
    "torch_loss_ratio": ("its median root loss, by ours", ">= 1, within 1 %", lambda ratio: ratio >= 0.99),
    "peak_mb": ("peak memory above the imports", "<= 300 MB", lambda mb: mb <= 300),
    "import_s": ("import graspmatch", "<= 0.2 s", lambda s: s <= 0.2),
    "help_s": ("graspmatch --help", "<= 0.6 s", lambda s: s <= 0.6),
    "first_plan_s": ("first plan, kernels compiled", "<= 30 s", lambda s: s <= 30),
}
"""What each figure is, its target, and whether a value meets it."""
MANY = 100
"""Scenes in one call."""
TORCH_SEEDS = 5
"""Times that each object is matched, with ours and then with plain PyTorch."""


def measure(scene: Scene, gripper: Gripper, repeats: int, config: PlannerConfig) -> dict:
    """Median time of a plan and of its stages [ms], every repeat with another seed."""
    plan(scene, gripper, config)
    times, stages, counts = [], [], []
    for seed in range(repeats):
        begin = time.perf_counter()
        grasps = plan(scene, gripper, replace(config, seed=seed))
        times.append(time.perf_counter() - begin)
        stages.append(grasps.provenance.seconds)
        counts.append(grasps.tally["candidates"])
    return {
        "ms": 1000 * float(np.median(times)),
        "spread_ms": [1000 * float(np.min(times)), 1000 * float(np.max(times))],
        "particles": counts[0],
        "stages_ms": {name: 1000 * float(np.median([stage[name] for stage in stages])) for name in stages[0]},
    }


def measure_many(objects: dict[str, Scene], gripper: Gripper, count: int, device: str) -> dict[str, float]:
    """How many plans a second many scenes in one call are, and their time by that of one by one, half of which are
    planned for before and half after: machines have slow and quick minutes."""
    many = [scene for _, scene in zip(range(count), cycle(objects.values()), strict=False)]
    config = PlannerConfig(device=device)

    def seconds(work: Callable[[], object]) -> float:
        begin = time.perf_counter()
        work()
        return time.perf_counter() - begin

    before = seconds(lambda: [plan(scene, gripper, config) for scene in many[: count // 2]])
    together = seconds(lambda: plan_many(many, gripper, config))
    after = seconds(lambda: [plan(scene, gripper, config) for scene in many[count // 2 :]])
    kind = "cpu" if device == "cpu" else "gpu"
    return {f"many_{kind}_per_s": count / together, f"many_{kind}_ratio": together / (before + after)}


def beside_torch(gripper: Gripper, objects: dict[str, Scene], device: str) -> dict[str, float]:
    """How many times as long the same matching takes in plain PyTorch, and how its loss compares; where it is there."""
    try:
        import torch
    except ModuleNotFoundError:
        print("No PyTorch here, so there is nothing to compare with: pip install graspmatch[torch].", file=sys.stderr)
        return {}
    from graspmatch.kernels.launch import thread_count
    from torch_speed import MatchingConfig, compare_matching, matching

    torch.set_num_threads(thread_count())
    matching("torch", next(iter(objects.values())), gripper, MatchingConfig(iterations=1), 0, device)  # starts threads
    ratios = [compare_matching(scene, gripper, TORCH_SEEDS, device) for scene in objects.values()]
    return {
        "torch_ratio_cpu": float(np.median([row["matching_ms"] for row in ratios])),
        "torch_loss_ratio": float(np.median([row["median_mm"] for row in ratios])),
    }


def has_gpu() -> bool:
    """Whether there is a CUDA device."""
    import warp as wp

    return wp.is_cuda_available()


def run(arguments: argparse.Namespace, out: Console) -> dict:
    """All figures, with the tables of single objects on the way."""
    objects = scenes(arguments.objects, 3 if arguments.short else None)
    repeats = arguments.repeats or (5 if arguments.short else 20)
    grippers = arguments.grippers or (GRIPPERS[:2] if arguments.short else GRIPPERS)
    report: dict = {"machine": machine(), "repeats": repeats, "objects": list(objects), "details": {}}
    for device in ("cpu", "cuda") if has_gpu() else ("cpu",):
        for name in grippers:
            gripper, config = load_gripper(name), PlannerConfig(device=device)
            for way, planned in (("", config), ("_fast", fast(config))):
                rows = {label: measure(scene, gripper, repeats, planned) for label, scene in objects.items()}
                title = f"{name} on {device}{way.replace('_', ', --')}"
                report["details"][title] = rows
                figure = f"{name.split('_')[0]}_{'cpu' if device == 'cpu' else 'gpu'}{way}_ms"
                report[figure] = float(np.median([row["ms"] for row in rows.values()]))
                show(title, rows, out)
        report |= measure_many(objects, load_gripper(grippers[0]), 10 if arguments.short else MANY, device)
    if arguments.torch:
        report |= beside_torch(load_gripper(grippers[0]), dict(list(objects.items())[: arguments.torch]), "cpu")
    return report | footprint(grippers[0], 3 if arguments.short else 9, fresh=not arguments.short)


def show(title: str, rows: dict[str, dict], out: Console) -> None:
    """Print one gripper's objects and stages."""
    table = Table(title=f"{title}: median {np.median([row['ms'] for row in rows.values()]):.0f} ms")
    stages = list(next(iter(rows.values()))["stages_ms"])
    for column in ("object", "particles", "median [ms]", "from - to", *stages):
        table.add_column(column, justify="left" if column == "object" else "right")
    for label, row in rows.items():
        low, high = row["spread_ms"]
        stage_times = [f"{row['stages_ms'][stage]:.1f}" for stage in stages]
        table.add_row(label, str(row["particles"]), f"{row['ms']:.0f}", f"{low:.0f} - {high:.0f}", *stage_times)
    middle = [f"{np.median([row['stages_ms'][stage] for row in rows.values()]):.1f}" for stage in stages]
    table.add_row("median", "", f"{np.median([row['ms'] for row in rows.values()]):.0f}", "", *middle)
    out.print(table)


def show_targets(report: dict, out: Console) -> None:
    """Print the table of targets."""
    table = Table(title="Targets")
    for column in ("figure", "target", "value", "met"):
        table.add_column(column, justify="right" if column == "value" else "left")
    for key, (label, target, is_met) in TARGETS.items():
        if key in report:
            table.add_row(label, target, f"{report[key]:.3g}", "yes" if is_met(report[key]) else "no")
        else:
            table.add_row(label, target, "not measured", "")
    out.print(table)
    quick = [f"{key.removesuffix('_fast_ms')} {report[key]:.0f} ms" for key in report if key.endswith("_fast_ms")]
    out.print(f"With `--fast`, which refines nothing: {', '.join(quick)}.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object, the tables on the error stream")
    parser.add_argument("--short", action="store_true", help="three objects, two hands, five repeats")
    parser.add_argument("--torch", type=int, default=1, help="so many objects are also matched with plain PyTorch")
    parser.add_argument("--objects", type=Path, default=PAPER_OBJECTS)
    parser.add_argument("--grippers", nargs="+")
    parser.add_argument("--repeats", type=int)
    arguments = parser.parse_args()
    out = Console(width=110, stderr=arguments.json)
    report = run(arguments, out)
    show_targets(report, out)
    if arguments.json:
        print(json.dumps(report))
    if not arguments.short:
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "speed.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
