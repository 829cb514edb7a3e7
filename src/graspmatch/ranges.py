"""What the values of a configuration may be."""

from __future__ import annotations

import math
from collections.abc import Sequence

from graspmatch.config import PlannerConfig
from graspmatch.errors import GraspmatchError


def check(config: PlannerConfig) -> None:
    """Raise `GraspmatchError` for a value that planning cannot work with."""
    seeding, matching, collision = config.seeding, config.matching, config.collision
    rules: list[tuple[str, float | None, float, float]] = [  # name, value, least, most
        ("seed", config.seed, 0, math.inf),
        ("seeding.points", seeding.points, 0, 1e6),
        ("seeding.above", seeding.above, 0, 1e6),
        ("seeding.fingertips", seeding.fingertips, 0, 1e6),
        ("seeding.batches", seeding.batches, 1, 1000),
        ("matching.iterations", matching.iterations, 0, 1e6),
        ("matching.stein_iterations", matching.stein_iterations, 0, 1e6),
        ("matching.learning_rate", matching.learning_rate, 1e-6, 2),
        ("matching.voxel_size", matching.voxel_size, 1e-4, 0.1),
        ("matching.collision_points", matching.collision_points, 1, 1e6),
        ("matching.com_weight", matching.com_weight, 0, 1e6),
        ("matching.annealing_cycles", matching.annealing_cycles, 1, 1e6),
        ("matching.annealing_exponent", matching.annealing_exponent, 0, 100),
        ("matching.repulsion", matching.repulsion, 0, 1e6),
        ("matching.longest_step", matching.longest_step, 1e-6, 10),
        ("matching.prior_translation", matching.prior_translation, 1e-6, 1e6),
        ("matching.prior_concentration", matching.prior_concentration, 0, 1e6),
        ("matching.convergence", matching.convergence, 0, 1),
        ("collision.clearance", collision.clearance, 0, 0.02),
        ("collision.largest_retreat", collision.largest_retreat, 0, 0.15),
        ("closing.fewest_fingers", config.closing.fewest_fingers, 0, 100),
        ("path.lift_height", config.path.lift_height, 0, 2),
        ("path.approach_angle", config.path.approach_angle, 0, 3.1416),
        *(("grip.frictions", friction, 0, 10) for friction in config.grip.frictions),
        ("grip.torsional_friction", config.grip.torsional_friction, 0, 1),
        ("grip.mass", config.grip.mass, 0, 100),
        ("grip.patch_depth", config.grip.patch_depth, 0, 0.05),
        ("grip.finalists", config.grip.finalists, 1, 1e6),
        ("grip.first_trials", config.grip.first_trials, 1, config.grip.trials),
        ("grip.leaders", config.grip.leaders, 0, 1e6),
        ("grip.trials", config.grip.trials, 1, 1e4),
        ("grip.position_error", config.grip.position_error, 0, 0.1),
        ("grip.angle_error", config.grip.angle_error, 0, 1),
        ("grip.ways_in", config.grip.ways_in, 1, 1e4),
        ("grip.way_position_error", config.grip.way_position_error, 0, 0.1),
        ("grip.way_angle_error", config.grip.way_angle_error, 0, 1),
        ("grip.way_clearance", config.grip.way_clearance, 0, 0.02),
        ("grip.inexact", config.grip.inexact, 0, 1),
        ("grip.points", config.grip.points, 1, 1e6),
        ("grip.reachable_points", config.grip.reachable_points, 1, 1e6),
        ("grip.step", config.grip.step, 1e-5, 0.05),
        ("grip.closing_steps", config.grip.closing_steps, 0, 1e4),
        ("grip.lifting_steps", config.grip.lifting_steps, 0, 1e4),
        ("grip.balanced", config.grip.balanced, 0, 10),
        ("refining.count", config.refining.count, 0, 1e6),
        ("refining.rounds", config.refining.rounds, 0, 1e3),
        ("refining.trials", config.refining.trials, 1, config.grip.trials),
        ("refining.searches", config.refining.searches, 1, 1000),
        ("refining.enough", config.refining.enough, 0, 1),
        ("refining.step", config.refining.step, 0, 0.1),
        ("refining.angle", config.refining.angle, 0, 2),
        ("ranking.count", config.ranking.count, 1, 1e6),
        ("ranking.least_confidence", config.ranking.least_confidence, 0, 1),
        ("ranking.distinct_distance", config.ranking.distinct_distance, 0, 10),
        ("ranking.distinct_angle", config.ranking.distinct_angle, 0, 7),
    ]
    check_ranges(rules)


def check_ranges(rules: Sequence[tuple[str, float | None, float, float]]) -> None:
    """Raise `GraspmatchError` for the first value that is given and not between its least and its most."""
    for name, value, least, most in rules:
        if value is not None and not least <= value <= most:  # NaN is not either
            raise GraspmatchError(f"{name} is {value}; it must be from {least:g} to {most:g}.")
