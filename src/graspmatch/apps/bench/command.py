"""`graspmatch bench`: options to an experiment."""

from __future__ import annotations

import json
import math
from dataclasses import replace

from graspmatch.apps.bench.clutter import clutter
from graspmatch.apps.bench.experiments import Task, ablation, paper, quick
from graspmatch.apps.bench.machine import usable_cores
from graspmatch.apps.bench.objects import folder_sources, household_sources
from graspmatch.apps.bench.run import Workshop
from graspmatch.apps.bench.trials import TrialConfig
from graspmatch.apps.bench.view import view
from graspmatch.apps.options import Bench
from graspmatch.apps.report import finite_or_null
from graspmatch.apps.speech import Speech
from graspmatch.config import LiftConfig, fast
from graspmatch.errors import GraspmatchError
from graspmatch.ranges import check, check_ranges

TRIALS = {"paper": 50, "ablation": 5, "quick": 3, "view": 10, "clutter": 20}
"""Per object, or piles, where none are given."""


def bench(command: Bench, say: Speech) -> int:
    """Run the experiment that is asked for; the result is the exit status."""
    config, workshop = _trial_config(command), _workshop(command)
    sources = household_sources() if command.what == "quick" else folder_sources(command.objects)
    planner = fast(command.config) if command.fast else command.config
    task = Task(command.gripper, command.description, sources, config, planner, command.pile)
    experiments = {"paper": paper, "ablation": ablation, "quick": quick, "view": view, "clutter": clutter}
    result = experiments[command.what](task, workshop, say)
    if say.as_json:
        print(json.dumps(finite_or_null(result), allow_nan=False))
    return 0


def _trial_config(command: Bench) -> TrialConfig:
    check(command.config)
    check_ranges(
        [  # name, value, least, most
            ("--trials", command.trials, 1, 1e6),
            ("--friction", command.friction, 0, 10),
            ("--mass", command.mass, 1e-3, 100),
            ("--pose-error-mm", command.pose_error_mm, 0, 1000),
            ("--pose-error-deg", command.pose_error_deg, 0, 180),
            ("--pile", command.pile, 1, 50),
            ("--camera.elevation", command.camera.elevation, 0.05, math.pi / 2),
            ("--camera.distance", command.camera.distance, 0.2, 3),
            ("--processes", command.processes, 1, 1024),
        ]
    )
    return TrialConfig(
        lift=replace(LiftConfig(), friction=command.friction, mass=command.mass),
        trials=command.trials or TRIALS[command.what],
        seed=command.config.seed,
        pose_error_mm=command.pose_error_mm,
        pose_error_deg=command.pose_error_deg,
        view=command.camera if command.what in ("view", "clutter") else None,
        fast=command.fast,
    )


def _workshop(command: Bench) -> Workshop:
    try:
        command.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GraspmatchError(f"Cannot make the folder {command.output}: {error.strerror}.") from error
    processes = command.processes or usable_cores()
    return Workshop(command.output, processes, fresh=command.fresh, quiet=command.quiet)
