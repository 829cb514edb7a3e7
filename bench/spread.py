"""How long plans take for whatever is put before a hand, what nothing holds included: not nine objects, but all.

    python bench/spread.py --seeds 2

Every object of ../shared/data/objects, each planned for with the hands of `bench/speed.py`, warm, on the CPU.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from graspmatch.apps.bench.machine import described, machine
from graspmatch.config import PlannerConfig
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper
from setting import PAPER_OBJECTS, RESULTS, scenes
from speed import GRIPPERS

SETS = ("paper", "contactdb", "ycb")
SHARES = (50, 90, 99, 100)
"""Of the plans, those that take no longer than the times in the table [%]."""
SLOWEST = 5


def measure(objects: dict[str, Scene], gripper: Gripper, seeds: int) -> list[dict[str, Any]]:
    """Each plan's time, and how many grasps came of it."""
    plan(next(iter(objects.values())), gripper, PlannerConfig(device="cpu"))  # uploads the hand
    rows = []
    for name, scene in objects.items():
        for seed in range(seeds):
            begin = time.perf_counter()
            grasps = plan(scene, gripper, PlannerConfig(device="cpu", seed=seed))
            ms = 1000 * (time.perf_counter() - begin)
            rows.append({"gripper": gripper.name, "object": name, "seed": seed, "ms": ms, "grasps": len(grasps.score)})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    folders = [PAPER_OBJECTS.parent / name for name in SETS]
    objects = {f"{folder.name}/{name}": scene for folder in folders for name, scene in scenes(folder).items()}
    rows = [row for name in GRIPPERS for row in measure(objects, load_gripper(name), arguments.seeds)]
    about = machine()
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "spread.json").write_text(json.dumps({"machine": about, "plans": rows}, indent=1) + "\n")
    show(rows, len(objects), described(about))


def show(rows: list[dict[str, Any]], objects: int, about: str) -> None:
    """Print how the times are spread for each hand, and which plans took longest."""
    table = Table(title=f"plans for {objects} objects [ms]", caption=about)
    columns = ("hand", "plans", *(f"{share} %" for share in SHARES), "no grasp", "longest without a grasp")
    for column in columns:
        table.add_column(column, justify="left" if column == "hand" else "right")
    for name in (*GRIPPERS, "all"):
        own = [row for row in rows if name in (row["gripper"], "all")]
        empty = [row["ms"] for row in own if not row["grasps"]]
        times = [f"{ms:.0f}" for ms in np.percentile([row["ms"] for row in own], SHARES)]
        table.add_row(name, str(len(own)), *times, str(len(empty)), f"{max(empty):.0f}" if empty else "")
    Console(width=110).print(table)
    for row in sorted(rows, key=lambda row: -row["ms"])[:SLOWEST]:
        print(f"{row['ms']:.0f} ms: {row['object']}, {row['gripper']}, seed {row['seed']}, {row['grasps']} grasps")


if __name__ == "__main__":
    main()
