"""Trials in clutter: look at a pile, try the surest grasp of all, and again, until the table is empty."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from graspmatch.apps.bench.glimpse import Glimpse, glimpse_of, hidden_share, scenes_of
from graspmatch.apps.bench.objects import ObjectSource
from graspmatch.apps.bench.processes import in_processes
from graspmatch.apps.bench.trials import NO_GRASP, Planner, TrialConfig
from graspmatch.errors import GraspmatchError
from graspmatch.geometry.mesh import sample_surface, transformed
from graspmatch.geometry.se3 import apply
from graspmatch.types import GraspSet, Gripper

if TYPE_CHECKING:
    from graspmatch.gripper.kinematics import HandModel
    from graspmatch.simulate.pile import Pile

Array = np.ndarray

GIVES_UP = 3
"""After so many failures in a row, what is left stays."""
NEARBY = 0.06
"""Grasps so near to one that was lost are of the same place [m]."""
FEWEST_PIXELS = 100
"""Of all objects together, so many at least are something to be seen."""
SAMPLES = 1e5
"""Of a surface, per square metre: one every 3 mm, to tell which object a hand is at."""


@dataclass(frozen=True)
class PileJob:
    """One pile, to be cleared in any process."""

    sources: tuple[ObjectSource, ...]
    gripper: str
    description: Path | None
    planner: Planner
    trial: int
    config: TrialConfig


@dataclass(frozen=True)
class Attempt:
    """One grasp that was tried, or none that was found."""

    object: str
    """What the hand was at; empty where there was no grasp."""
    held: bool
    reason: str
    left: int
    """How many objects were on the table before."""
    found: int
    """How many of them the planner told apart."""
    hidden: float | None
    """Share of the object's silhouette that others hid from the camera."""
    score: float | None
    plan_seconds: float
    """For all objects that were found."""
    simulation_seconds: float


@dataclass(frozen=True)
class PileTrial:
    """What came of one pile."""

    trial: int
    objects: list[str]
    attempts: list[dict[str, Any]]
    """Each as an `Attempt`."""

    @property
    def key(self) -> tuple[str, int]:
        """As of a job."""
        return "pile", self.trial

    @property
    def tries(self) -> list[Attempt]:
        """The attempts in their order."""
        return [Attempt(**entry) for entry in self.attempts]

    @property
    def cleared(self) -> int:
        """How many objects were lifted off the table."""
        return sum(attempt.held for attempt in self.tries)


def run_piles(jobs: Iterable[PileJob], *, processes: int) -> Iterator[PileTrial]:
    """The piles as they are done, in any order; results depend on the jobs alone."""
    return in_processes(run_pile, jobs, processes=processes)


def run_pile(job: PileJob) -> PileTrial:
    """Drop, then look, plan, lift and take away."""
    from graspmatch.gripper.kinematics import load_hand
    from graspmatch.gripper.load import load_gripper
    from graspmatch.gripper.zoo import card_path
    from graspmatch.simulate.pile import drop

    rng = np.random.default_rng([job.config.seed, job.trial])
    lift = job.config.lift
    pile = drop([source.load(mass=lift.mass) for source in job.sources], lift, rng)
    hand = load_hand(card_path(job.gripper), job.description)
    gripper = load_gripper(job.gripper, description=job.description)
    attempts: list[Attempt] = []
    failures = 0
    lost: list[Array] = []
    while len(pile) and failures < GIVES_UP:
        attempt, pile = _attempt(pile, job, hand, gripper, rng, lost)
        if attempt is None:  # what is left has rolled out of the image
            break
        attempts.append(attempt)
        failures = 0 if attempt.held else failures + 1
    return PileTrial(job.trial, [source.name for source in job.sources], [asdict(attempt) for attempt in attempts])


def _attempt(
    pile: Pile, job: PileJob, hand: HandModel, gripper: Gripper, rng: np.random.Generator, lost: list[Array]
) -> tuple[Attempt | None, Pile]:
    """Look, plan, try; and the pile afterwards, without the object if it was lifted. None where there is nothing to be
    seen. Where a grasp was lost is added to `lost`."""
    from graspmatch.simulate.pile import settled, try_in_pile

    assert job.config.view is not None
    meshes = [transformed(body.mesh, T) for body, T in zip(pile.objects, pile.T_world_object, strict=True)]
    glimpse = glimpse_of(meshes, pile.T_world_object[0], job.config.view, rng)
    if np.count_nonzero((glimpse.sight.body >= 0) & (glimpse.sight.body < len(meshes))) < FEWEST_PIXELS:
        return None, pile
    seed = int(rng.integers(2**31))
    begin = time.perf_counter()
    grasps, found, reason = surest(glimpse, job.planner, gripper, seed, lost)
    attempt = Attempt("", False, reason, len(pile), found, None, None, time.perf_counter() - begin, 0.0)
    if grasps is None:
        return attempt, pile
    begin = time.perf_counter()
    index = at_which(grasps, gripper, meshes)
    tried = grasps.T_world_pregrasp[0], grasps.T_world_gripper[0], grasps.pregrasp_joints[0]
    verdict, after = try_in_pile(pile, index, hand, *tried, job.config.lift)
    if not verdict.held:
        lost.append(centre_of(grasps, gripper))
    after = settled(after.without(index) if verdict.held else after, job.config.lift)
    attempt = replace(
        attempt,
        object=pile.objects[index].name,
        held=verdict.held,
        reason=verdict.reason,
        hidden=hidden_share(glimpse, meshes, index),
        score=float(grasps.score[0]),
        simulation_seconds=time.perf_counter() - begin,
    )
    return attempt, after


def surest(
    glimpse: Glimpse, planner: Planner, gripper: Gripper, seed: int, lost: Sequence[Array] = ()
) -> tuple[GraspSet | None, int, str]:
    """The grasps for the object whose best one is surest, how many objects were told apart, and why there is none.

    What was lost lately is not tried again at once: each loss nearby halves how sure a grasp counts.
    """

    def worth(grasps: GraspSet) -> float:
        centre = centre_of(grasps, gripper)
        return float(grasps.score[0]) * 0.5 ** sum(bool(np.linalg.norm(place - centre) < NEARBY) for place in lost)

    try:
        scenes = scenes_of(glimpse)
    except GraspmatchError as refusal:
        return None, 0, f"refused: {refusal}"
    plans = [planner(scene, gripper, seed) for scene in scenes]
    best = max((plan for plan in plans if len(plan)), key=worth, default=None)
    return best, len(scenes), "" if best is not None else NO_GRASP


def centre_of(grasps: GraspSet, gripper: Gripper, rank: int = 0) -> Float[Array, "3"]:
    """Where the fingers of a grasp meet [m]."""
    centre = gripper.preshapes[grasps.preshape[rank]].tool_centre_point
    return apply(grasps.T_world_gripper[rank], centre[None])[0]


def at_which(grasps: GraspSet, gripper: Gripper, meshes: Sequence[Any], rank: int = 0) -> int:
    """The object that is nearest to where the fingers of a grasp meet."""
    place = centre_of(grasps, gripper, rank)
    rng = np.random.default_rng(0)
    clouds = [sample_surface(mesh, SAMPLES, rng)[0] for mesh in meshes]
    return int(np.argmin([np.min(np.linalg.norm(points - place, axis=-1)) for points in clouds]))
