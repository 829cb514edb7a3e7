"""What matching makes of seeds that are a little off: confidence before and after, by object.

python bench/seeds.py --gripper franka_hand
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from graspmatch.config import PlannerConfig, RankingConfig, RefiningConfig
from graspmatch.geometry import se3
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene

OBJECTS = Path(__file__).parents[1] / ".." / "shared" / "data" / "objects" / "paper"
SEEDS = 10
OFF = 0.015
"""Standard deviation along each axis [m] ..."""
TURNED = np.radians(12.0)
"""... and about it [rad]."""


def main() -> None:
    """Plan, disturb the best grasps, judge them as they are, and refined."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gripper", default="franka_hand")
    parser.add_argument("--objects", type=Path, default=OBJECTS)
    options = parser.parse_args()
    gripper, rng = load_gripper(options.gripper), np.random.default_rng(0)
    refined = PlannerConfig(ranking=RankingConfig(least_confidence=0.0))
    as_given = replace(refined, matching=replace(refined.matching, iterations=0), refining=RefiningConfig(count=0))
    for path in sorted(options.objects.glob("*/mesh.stl")):
        scene = Scene.from_mesh(path)
        best = plan(scene, gripper, PlannerConfig()).best(SEEDS).T_world_gripper
        turn = se3.rotation_exp(TURNED * rng.normal(size=(len(best), 3)))
        error = se3.about(gripper.tool_centre_point, se3.from_parts(turn, OFF * rng.normal(size=(len(best), 3))))
        before, after = (plan(scene, gripper, c, starts_world_gripper=best @ error) for c in (as_given, refined))
        surest = [f"{grasps.score.max(initial=0.0):.2f} of {len(grasps)}" for grasps in (before, after)]
        print(f"{path.parent.name:10s} {len(best)} seeds; surest as given {surest[0]}, refined {surest[1]}", flush=True)


if __name__ == "__main__":
    main()
