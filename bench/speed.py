"""Wall time of whole `plan` calls, warm, with the parameters of Table I: median, and the stages that it is made of."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from graspmatch.apps.bench.machine import machine
from graspmatch.config import PlannerConfig
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper
from setting import PAPER_OBJECTS, RESULTS, scenes

TARGET_MS = {"franka_hand": 1000.0}
"""Of the median over all objects, on two cores."""


def measure(scene: Scene, gripper: Gripper, repeats: int, device: str) -> dict:
    """Median time of a plan and of its stages [ms], every repeat with another seed."""
    plan(scene, gripper, PlannerConfig(device=device))
    times, stages, counts = [], [], []
    for seed in range(repeats):
        begin = time.perf_counter()
        grasps = plan(scene, gripper, PlannerConfig(seed=seed, device=device))
        times.append(time.perf_counter() - begin)
        stages.append(grasps.provenance.seconds)
        counts.append(grasps.tally["candidates"])
    return {
        "ms": 1000 * float(np.median(times)),
        "spread_ms": [1000 * float(np.min(times)), 1000 * float(np.max(times))],
        "particles": counts[0],
        "stages_ms": {name: 1000 * float(np.median([stage[name] for stage in stages])) for name in stages[0]},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=Path, default=PAPER_OBJECTS)
    parser.add_argument("--grippers", nargs="+", default=["franka_hand", "barrett_bh282", "kinova_kg3", "robotiq_2f85"])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    report: dict = {"machine": machine(), "device": arguments.device, "repeats": arguments.repeats, "grippers": {}}
    objects = scenes(arguments.objects)
    for name in arguments.grippers:
        gripper = load_gripper(name)
        rows = {label: measure(s, gripper, arguments.repeats, arguments.device) for label, s in objects.items()}
        report["grippers"][name] = rows
        show(name, rows)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "speed.json").write_text(json.dumps(report, indent=1) + "\n")


def show(gripper: str, rows: dict[str, dict]) -> None:
    """Print one gripper's table."""
    median = float(np.median([row["ms"] for row in rows.values()]))
    target = f", target {TARGET_MS[gripper]:.0f} ms" if gripper in TARGET_MS else ""
    table = Table(title=f"{gripper}: median {median:.0f} ms{target}")
    stages = list(next(iter(rows.values()))["stages_ms"])
    for column in ("object", "particles", "median [ms]", "from - to", *stages):
        table.add_column(column, justify="left" if column == "object" else "right")
    for label, row in rows.items():
        low, high = row["spread_ms"]
        stage_times = [f"{row['stages_ms'][stage]:.0f}" for stage in stages]
        table.add_row(label, str(row["particles"]), f"{row['ms']:.0f}", f"{low:.0f} - {high:.0f}", *stage_times)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
