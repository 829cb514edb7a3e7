"""Matching methods from the same seeds: how low the loss gets, and how many distinct basins are found.

For each object and seed every method gets the same starting poses. A basin counts when a particle ends in it with at
most twice the lowest loss that plain ICP found there; two particles are in one basin when they are less than 1 cm and
15 degrees apart. Losses are those of all particles after matching, colliding ones included, as the root of eq. (13).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from graspmatch.apps.bench.machine import machine
from graspmatch.config import MatchingConfig, RankingConfig, SeedingConfig
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.candidates import Matched
from graspmatch.planner.match import match, prepare
from graspmatch.planner.rank import rank
from graspmatch.planner.seed import seed_poses
from graspmatch.planner.tally import Tally
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper
from setting import PAPER_OBJECTS, RESULTS, scenes

VARIANTS = {
    "icp": MatchingConfig(method="icp"),
    "sgd-icp": MatchingConfig(method="sgd-icp"),
    "stein-icp": MatchingConfig(method="stein-icp"),
    "annealed-stein-icp": MatchingConfig(),
    "  batch from object": MatchingConfig(batch_from="object"),
    "  CoM gradient as printed": MatchingConfig(com_gradient="paper"),
    "  without repulsion": MatchingConfig(repulsion=0.0),
    "  repulsion x 3": MatchingConfig(repulsion=3.0),
}


def compare(scene: Scene, gripper: Gripper, seed: int) -> dict[str, list[float]]:
    """For each variant: lowest, mean of the ten lowest and median root loss [mm], basins, share without collision."""
    results: dict[str, Matched] = {}
    free: dict[str, float] = {}
    for name, config in VARIANTS.items():
        rng = np.random.default_rng(seed)
        starts = seed_poses(scene, gripper, SeedingConfig(), rng)
        problem = prepare(scene, gripper, config, rng, "cpu")
        results[name] = match(starts, problem, config, rng)
        free[name] = float(np.mean(results[name].is_free))
    limit = 2 * results["icp"].loss.min()
    rows = {}
    for name, matched in results.items():
        root = 1000 * np.sqrt(np.sort(matched.loss))
        good = matched.select(matched.loss <= limit)
        basins = len(rank(good, -good.loss, RankingConfig(count=len(matched)), Tally(0), "worse"))
        rows[name] = [root[0], root[:10].mean(), float(np.median(root)), float(basins), free[name]]
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=Path, default=PAPER_OBJECTS)
    parser.add_argument("--grippers", nargs="+", default=["franka_hand", "barrett_bh282", "kinova_kg3"])
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    objects = scenes(arguments.objects)
    report: dict = {"machine": machine(), "objects": list(objects), "seeds": arguments.seeds, "grippers": {}}
    for name in arguments.grippers:
        gripper = load_gripper(name)
        runs = [compare(scene, gripper, seed) for scene in objects.values() for seed in range(arguments.seeds)]
        report["grippers"][name] = {
            variant: np.mean([run[variant] for run in runs], axis=0).tolist() for variant in VARIANTS
        }
        show(name, report["grippers"][name])
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "matching.json").write_text(json.dumps(report, indent=1) + "\n")


def show(gripper: str, rows: dict[str, list[float]]) -> None:
    """Print one gripper's table."""
    table = Table(title=gripper)
    for column in ("method", "lowest [mm]", "ten lowest [mm]", "median [mm]", "basins", "free"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for variant, (lowest, ten, median, basins, free) in rows.items():
        table.add_row(variant, f"{lowest:.1f}", f"{ten:.1f}", f"{median:.1f}", f"{basins:.1f}", f"{100 * free:.0f} %")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
