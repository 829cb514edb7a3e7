"""What the values of a configuration may be."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from operator import attrgetter
from typing import Any

from graspmatch.config import PlannerConfig
from graspmatch.errors import GraspmatchError

LIMITS: dict[str, tuple[float, float | str]] = {
    "seed": (0, math.inf),
    "seeding.points": (0, 1e6),
    "seeding.above": (0, 1e6),
    "seeding.fingertips": (0, 1e6),
    "seeding.batches": (1, 1000),
    "matching.iterations": (0, 1e6),
    "matching.stein_iterations": (0, 1e6),
    "matching.learning_rate": (1e-6, 2),
    "matching.voxel_size": (1e-4, 0.1),
    "matching.collision_points": (1, 1e6),
    "matching.com_weight": (0, 1e6),
    "matching.annealing_cycles": (1, 1e6),
    "matching.annealing_exponent": (0, 100),
    "matching.repulsion": (0, 1e6),
    "matching.longest_step": (1e-6, 10),
    "matching.prior_translation": (1e-6, 1e6),
    "matching.prior_concentration": (0, 1e6),
    "matching.convergence": (0, 1),
    "collision.clearance": (0, 0.02),
    "collision.largest_retreat": (0, 0.15),
    "closing.fewest_fingers": (0, 100),
    "path.lift_height": (0, 2),
    "path.approach_angle": (0, 3.1416),
    "grip.frictions": (0, 10),
    "grip.torsional_friction": (0, 1),
    "grip.mass": (0, 100),
    "grip.patch_depth": (0, 0.05),
    "grip.finalists": (1, 1e6),
    "grip.first_trials": (1, "grip.trials"),
    "grip.leaders": (0, 1e6),
    "grip.trials": (1, 1e4),
    "grip.position_error": (0, 0.1),
    "grip.angle_error": (0, 1),
    "grip.ways_in": (1, 1e4),
    "grip.way_position_error": (0, 0.1),
    "grip.way_angle_error": (0, 1),
    "grip.way_clearance": (0, 0.02),
    "grip.inexact": (0, 1),
    "grip.points": (1, 1e6),
    "grip.reachable_points": (1, 1e6),
    "grip.step": (1e-5, 0.05),
    "grip.closing_steps": (0, 1e4),
    "grip.lifting_steps": (0, 1e4),
    "grip.balanced": (0, 10),
    "refining.count": (0, 1e6),
    "refining.rounds": (0, 1e3),
    "refining.trials": (1, "grip.trials"),
    "refining.enough": (0, 1),
    "refining.step": (0, 0.1),
    "refining.angle": (0, 2),
    "ranking.count": (1, 1e6),
    "ranking.least_confidence": (0, 1),
    "ranking.distinct_distance": (0, 10),
    "ranking.distinct_angle": (0, 7),
}
"""Least and most of what each value may be, or the name of the value that it may be at most."""


def check(config: PlannerConfig) -> None:
    """Raise `GraspmatchError` for a value that planning cannot work with."""

    def value(name: str) -> Any:
        return attrgetter(name)(config)

    rules: list[tuple[str, float | None, float, float]] = []
    for name, (least, limit) in LIMITS.items():
        most = value(limit) if isinstance(limit, str) else limit
        values = value(name)
        rules += [(name, each, least, most) for each in (values if isinstance(values, Iterable) else (values,))]
    check_ranges(rules)


def check_ranges(rules: Sequence[tuple[str, float | None, float, float]]) -> None:
    """Raise `GraspmatchError` for the first value that is given and not between its least and its most."""
    for name, value, least, most in rules:
        if value is not None and not least <= value <= most:  # NaN is not either
            raise GraspmatchError(f"{name} is {value}; it must be from {least:g} to {most:g}.")
