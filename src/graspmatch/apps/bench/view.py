"""Success from one depth image each: by object, by the side that the camera saw, and by how much it saw."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

from graspmatch.apps.bench.experiments import Task, rates, variant_of
from graspmatch.apps.bench.run import Workshop
from graspmatch.apps.bench.summary import Row, band, row_of
from graspmatch.apps.bench.tables import Section
from graspmatch.apps.bench.trials import Trial
from graspmatch.apps.speech import Speech
from graspmatch.config import ViewConfig

SECTORS = 8
SHARES = (0.0, 0.2, 0.3, 0.4, 0.5, 1.0)
"""Borders of the share of a surface that is seen: half of it is the most, but for open scans."""


def view(task: Task, workshop: Workshop, say: Speech) -> dict[str, Any]:
    """The best grasp of a plan from one depth image, lifted in the simulator; its JSON."""
    name = task.hand_name
    title, label = f"One depth image: {name}", f"view-{name}{variant_of(task.config)}"
    assert task.config.view is not None
    return rates(title, label, task, {}, workshop, say, sections=view_sections, notes=view_notes(task.config.view))


def view_sections(trials: Sequence[Trial]) -> list[Section]:
    """The trials by the side that the camera saw, and by how much of the surface it saw."""
    return [
        Section("By the camera's azimuth in the frame of the mesh", split(trials, sector_of)),
        Section("By the share of the surface that was seen", split(trials, share_of)),
        Section("Error of the centre of mass", [], _centre_errors(trials)),
    ]


def view_notes(config: ViewConfig) -> list[str]:
    """What a reader must know of the camera."""
    sensor = config.sensor
    table = "known" if config.knows_table else "found in the image"
    return [
        f"Camera: {math.degrees(config.elevation):.0f} degrees above the table, {config.distance:g} m away, 640 x 480; "
        f"the table's height is {table}. Noise {1000 * sensor.axial_noise * config.distance**2:.1f} mm, scale error "
        f"{100 * sensor.scale_error:g} %, tilt {100 * sensor.tilt_error:g} %, {100 * sensor.flying:.0f} % of the edge "
        f"flying and {100 * sensor.edge_dropout:.0f} % lost; camera pose off by "
        f"{1000 * sensor.pose_error_position:g} mm and {math.degrees(sensor.pose_error_angle):g} degrees."
    ]


def split(trials: Sequence[Trial], label: Callable[[Trial], str | None]) -> list[Row]:
    """A row for each label that some trials have, in the order of the labels."""
    groups: dict[str, list[Trial]] = {}
    for trial in trials:
        name = label(trial)
        if name is not None and trial.counts:
            groups.setdefault(name, []).append(trial)
    return [row_of(name, groups[name]) for name in sorted(groups)]


def sector_of(trial: Trial) -> str | None:
    """The eighth of a turn that the camera stood in."""
    if trial.azimuth is None:
        return None
    width = 360 / SECTORS
    middle = width * (round(math.degrees(trial.azimuth) / width) % SECTORS)
    return f"{middle:03.0f} degrees"


def share_of(trial: Trial) -> str | None:
    """How much of the object was seen."""
    return None if trial.seen is None else band(trial.seen, SHARES)


def _centre_errors(trials: Sequence[Trial]) -> str:
    errors = sorted(1000 * trial.centre_error for trial in trials if trial.centre_error is not None)
    if not errors:
        return "No scene."
    return f"Median {median(errors):.1f} mm, nine in ten below {errors[int(0.9 * (len(errors) - 1))]:.1f} mm."
