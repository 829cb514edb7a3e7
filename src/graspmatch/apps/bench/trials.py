"""Trials: an object at a random place on the table is planned for, and the best grasp is tried in the simulator."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from graspmatch.apps.bench.glimpse import glimpse_of, scene_of
from graspmatch.apps.bench.objects import ObjectSource
from graspmatch.apps.bench.processes import in_processes
from graspmatch.config import LiftConfig, PlannerConfig, ViewConfig
from graspmatch.errors import GraspmatchError
from graspmatch.geometry import se3
from graspmatch.geometry.cloud import narrowest_width
from graspmatch.geometry.mesh import transformed
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet, Gripper

if TYPE_CHECKING:
    from graspmatch.simulate.rigid_body import RigidBody

Array = np.ndarray
Planner = Callable[[Scene, Gripper, int], GraspSet]
"""Scene, hand and seed to grasps, best first. It is sent to other processes, so it must be a module's own."""

NO_GRASP = "no grasp found"
TOPPLES = "the object does not stand"
DOES_NOT_FIT = "no grasp found: wider than the hand opens, every way"
SPREAD = 0.05
"""Objects are put down at most this far from the origin along each axis [m]."""


@dataclass(frozen=True)
class TrialConfig:
    """What all trials of a benchmark have in common."""

    lift: LiftConfig = field(default_factory=LiftConfig)
    trials: int = 50
    """Per object."""
    seed: int = 0
    pose_error_mm: float = 0.0
    """Standard deviation of the hand's position along each axis."""
    pose_error_deg: float = 0.0
    """Of its rotation about each axis."""
    view: ViewConfig | None = None
    """The planner gets one depth image; none: it gets the mesh."""
    fast: bool = False
    """The planner is configured as `--fast` does."""


@dataclass(frozen=True)
class Job:
    """One trial, to be run in any process."""

    source: ObjectSource
    gripper: str
    description: Path | None
    planner: Planner
    trial: int
    config: TrialConfig


@dataclass(frozen=True)
class Trial:
    """What came of one trial."""

    object: str
    trial: int
    held: bool
    reason: str
    """Empty where the object was held."""
    plan_seconds: float
    simulation_seconds: float
    grasps: int
    """How many the plan had."""
    preshape: str
    score: float | None
    slip: float
    """[m]"""
    turn: float
    """[rad]"""
    azimuth: float | None = None
    """Of the camera in the frame of the mesh, counter-clockwise from x [rad]; none: there was no camera."""
    seen: float | None = None
    """Share of the object's surface that the camera saw."""
    centre_error: float | None = None
    """How far the scene's centre of mass is from the true one [m]; none: there was no scene."""

    @property
    def key(self) -> tuple[str, int]:
        """Object and number."""
        return self.object, self.trial

    @property
    def counts(self) -> bool:
        """Whether the trial says something of the planner."""
        return self.reason not in (TOPPLES, DOES_NOT_FIT)


@dataclass(frozen=True)
class PlanWith:
    """The planner of this package with a configuration."""

    config: PlannerConfig = field(default_factory=PlannerConfig)

    def __call__(self, scene: Scene, gripper: Gripper, seed: int) -> GraspSet:
        """Grasps for the scene."""
        from graspmatch.planner.plan import plan

        return plan(scene, gripper, replace(self.config, seed=seed))


def run_trials(jobs: Iterable[Job], *, processes: int) -> Iterator[Trial]:
    """The trials as they end, in any order; their results depend on the jobs alone."""
    return in_processes(run_trial, jobs, processes=processes)


def run_trial(job: Job) -> Trial:
    """Settle, place, look, plan, lift."""
    from graspmatch.simulate.judge import try_grasp

    settled, world, gripper = stage(job.source, job.gripper, job.description, job.config.lift)
    name = job.source.name
    trial = Trial(name, job.trial, False, TOPPLES, 0.0, 0.0, 0, "", None, 0.0, 0.0)
    if settled.topples:
        return trial
    rng = np.random.default_rng([job.config.seed, zlib.crc32(name.encode()), job.trial])
    T_world_object = random_place(rng) @ settled.T_world_object
    planner_seed = int(rng.integers(2**31))
    error = _pose_error(rng, job.config)
    mesh = transformed(settled.target.mesh, T_world_object)
    glimpse = None if job.config.view is None else glimpse_of([mesh], T_world_object, job.config.view, rng)
    if glimpse is not None:
        trial = replace(trial, azimuth=glimpse.azimuth, seen=glimpse.seen)
    begin = time.perf_counter()
    try:
        scene = Scene.from_mesh(mesh, table=0.0) if glimpse is None else scene_of(glimpse)
        trial = replace(trial, centre_error=_centre_error(scene, settled.target, T_world_object))
        grasps, reason = job.planner(scene, gripper, planner_seed), NO_GRASP
    except GraspmatchError as refusal:  # one object that a planner refuses does not end the benchmark
        grasps, reason = None, f"refused: {refusal}"
    trial = replace(trial, plan_seconds=time.perf_counter() - begin)
    if not grasps:
        return replace(trial, reason=_why_none(reason, settled.target, gripper))
    begin = time.perf_counter()
    verdict = try_grasp(world, _displaced(grasps, error), 0, T_world_object, job.config.lift)
    preshape = int(grasps.preshape[0])
    return replace(
        trial,
        held=verdict.held,
        reason=verdict.reason,
        simulation_seconds=time.perf_counter() - begin,
        grasps=len(grasps),
        preshape=grasps.preshape_names[preshape] if preshape >= 0 else "",
        score=float(grasps.score[0]) if np.isfinite(grasps.score[0]) else None,
        slip=verdict.slip,
        turn=verdict.turn,
    )


def _why_none(reason: str, target: RigidBody, gripper: Gripper) -> str:
    """The reason why there is no grasp, or that no hand of this width could have one."""
    from graspmatch.planner.advice import is_too_wide

    too_wide = reason == NO_GRASP and is_too_wide(narrowest_width(target.mesh.vertices), gripper)
    return DOES_NOT_FIT if too_wide else reason


def _centre_error(scene: Scene, target: RigidBody, T_world_object: Float[Array, "4 4"]) -> float:
    """[m]"""
    true = se3.apply(T_world_object, target.centre_of_mass[None])[0]
    return float(np.linalg.norm(scene.centre_of_mass - true))


@lru_cache(maxsize=8)
def stage(source: ObjectSource, gripper_name: str, description: Path | None, config: LiftConfig):
    """The settled object, the world with the hand, and the hand as the planner knows it."""
    from graspmatch.gripper.kinematics import load_hand
    from graspmatch.gripper.load import load_gripper
    from graspmatch.gripper.zoo import card_path
    from graspmatch.simulate.judge import world_of
    from graspmatch.simulate.settle import settle

    settled = settle(source.load(mass=config.mass), config.friction)
    hand = load_hand(card_path(gripper_name), description)
    return settled, world_of(settled.target, hand, config), load_gripper(gripper_name, description=description)


def random_place(rng: np.random.Generator) -> Float[Array, "4 4"]:
    """A turn about the vertical and a place on the table."""
    turn = se3.rotation_exp(np.array([0.0, 0.0, rng.uniform(0, 2 * np.pi)]))
    return se3.from_parts(turn, np.r_[rng.uniform(-SPREAD, SPREAD, 2), 0.0])


def _pose_error(rng: np.random.Generator, config: TrialConfig) -> Float[Array, "4 4"]:
    """T_gripper_displaced; drawn even where it is zero, so that all else stays as it is without it."""
    turn, shift = rng.normal(size=3), rng.normal(size=3)
    rotation = se3.rotation_exp(np.radians(config.pose_error_deg) * turn)
    return se3.from_parts(rotation, 1e-3 * config.pose_error_mm * shift)


def _displaced(grasps: GraspSet, T_gripper_displaced: Float[Array, "4 4"]) -> GraspSet:
    return replace(
        grasps,
        T_world_gripper=grasps.T_world_gripper @ T_gripper_displaced,
        T_world_pregrasp=grasps.T_world_pregrasp @ T_gripper_displaced,
    )
