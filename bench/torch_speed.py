"""Our matching beside the same method in plain PyTorch: same scenes, same seeds, same starts.

Matching time is that of seeds, thinned clouds, upload (for ours the nearest-neighbour field too) and Algorithm 1; plan
time is that of the whole way to ranked grasps. Both are warm and on all cores: run this on an idle machine, since the
threads of PyTorch wait for each other at every operation. Losses are those of all particles after matching, colliding
ones included, as the root of eq. (13). They differ a little: nearest neighbours of brute force are exact, those of the
field nearly so, and small differences grow in the Stein phase.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from baselines.torch_matching import torch_match, torch_plan
from baselines.torch_problem import torch_prepare
from graspmatch.apps.bench.machine import machine
from graspmatch.config import MatchingConfig, PlannerConfig, SeedingConfig
from graspmatch.gripper.load import load_gripper
from graspmatch.kernels.blas import blas_on_one_thread
from graspmatch.kernels.launch import resolve_device, thread_count
from graspmatch.planner.candidates import Matched
from graspmatch.planner.match import match, prepare
from graspmatch.planner.plan import plan
from graspmatch.planner.seed import seed_poses
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper
from setting import PAPER_OBJECTS, RESULTS, scenes

VERSIONS = ("graspmatch", "torch")


def compare(scene: Scene, gripper: Gripper, seeds: int, device: str) -> dict[str, dict[str, float]]:
    """For each version, medians over the seeds: times [ms] and losses [mm]; under `ratio`, torch over ours."""
    runs = {name: [measure(name, scene, gripper, seed, device) for seed in range(seeds)] for name in VERSIONS}
    rows = {
        name: {key: float(np.median([run[key] for run in runs[name]])) for key in runs[name][0]} for name in VERSIONS
    }
    rows["ratio"] = {key: rows["torch"][key] / rows["graspmatch"][key] for key in rows["torch"]}
    return rows


def compare_matching(scene: Scene, gripper: Gripper, seeds: int, device: str) -> dict[str, float]:
    """Torch over ours, medians over the seeds: time of the matching, and root losses."""
    ours, other = ([timed_matching(name, scene, gripper, seed, device) for seed in range(seeds)] for name in VERSIONS)
    return {key: float(np.median([o[key] for o in other]) / np.median([o[key] for o in ours])) for key in ours[0]}


def timed_matching(name: str, scene: Scene, gripper: Gripper, seed: int, device: str) -> dict[str, float]:
    """One matching of one version: its time [ms] and its root losses [mm]."""
    begin = time.perf_counter()
    matched = matching(name, scene, gripper, MatchingConfig(), seed, device)
    seconds = time.perf_counter() - begin
    root = 1000 * np.sqrt(np.sort(matched.loss))
    figures = {"lowest_mm": root[0], "ten_lowest_mm": root[:10].mean(), "median_mm": np.median(root)}
    return {"matching_ms": 1000 * seconds} | {key: float(value) for key, value in figures.items()}


def measure(name: str, scene: Scene, gripper: Gripper, seed: int, device: str) -> dict[str, float]:
    """One matching and one plan of one version."""
    figures = timed_matching(name, scene, gripper, seed, device)
    begin = time.perf_counter()
    planning(name, scene, gripper, seed, device)
    return {**figures, "plan_ms": 1000 * (time.perf_counter() - begin)}


def matching(name: str, scene: Scene, gripper: Gripper, config: MatchingConfig, seed: int, device: str) -> Matched:
    """Algorithm 1; random numbers are drawn in the same order by both versions."""
    rng = np.random.default_rng(seed)
    starts = seed_poses(scene, gripper, SeedingConfig(), rng)
    if name == "torch":
        return torch_match(starts, torch_prepare(scene, gripper, config, rng, device), config, rng)
    with blas_on_one_thread():  # as `plan` has it
        return match(starts, prepare(scene, gripper, config, rng, device), config, rng)


def planning(name: str, scene: Scene, gripper: Gripper, seed: int, device: str) -> None:
    """The whole way with the defaults."""
    if name == "torch":
        torch_plan(scene, gripper, seed, device=device)
    else:
        plan(scene, gripper, PlannerConfig(seed=seed, device=device))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=Path, default=PAPER_OBJECTS)
    parser.add_argument("--grippers", nargs="+", default=["franka_hand", "barrett_bh282"])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    device, objects = resolve_device(arguments.device), scenes(arguments.objects)
    torch.set_num_threads(thread_count())
    where = {**machine(), "torch": version("torch"), "threads": str(thread_count())}
    report: dict = {"machine": where, "device": device, "seeds": arguments.seeds, "grippers": {}}
    for name in arguments.grippers:
        gripper = load_gripper(name)
        first = next(iter(objects.values()))
        measure("graspmatch", first, gripper, 0, device)  # compiles kernels, uploads the hand, starts threads
        matching("torch", first, gripper, MatchingConfig(iterations=1), 0, device)
        rows = {label: compare(scene, gripper, arguments.seeds, device) for label, scene in objects.items()}
        report["grippers"][name] = rows
        show(name, rows)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "torch.json").write_text(json.dumps(report, indent=1) + "\n")


COLUMNS: dict[str, tuple[str, Callable[[float], str]]] = {
    "matching_ms": ("matching (ms)", lambda ms: f"{ms:.0f}"),
    "plan_ms": ("plan (ms)", lambda ms: f"{ms:.0f}"),
    "lowest_mm": ("lowest (mm)", lambda mm: f"{mm:.1f}"),
    "ten_lowest_mm": ("ten lowest (mm)", lambda mm: f"{mm:.1f}"),
    "median_mm": ("median (mm)", lambda mm: f"{mm:.1f}"),
}
"""Title and form of each figure."""


def show(gripper: str, rows: dict[str, dict[str, dict[str, float]]]) -> None:
    """Print one gripper's table: ours / torch, and for times how many times as long torch takes."""
    total = {key: float(np.median([row["ratio"][key] for row in rows.values()])) for key in COLUMNS}
    table = Table(title=f"{gripper}: ours / torch, torch over ours in the last line (medians)")
    for title in ("object", *(title for title, _ in COLUMNS.values())):
        table.add_column(title, justify="left" if title == "object" else "right")
    for label, row in rows.items():
        ours, other = row["graspmatch"], row["torch"]
        table.add_row(label, *(f"{form(ours[key])} / {form(other[key])}" for key, (_, form) in COLUMNS.items()))
    table.add_section()
    table.add_row("ratio", *(f"{total[key]:.2f}" for key in COLUMNS))
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
