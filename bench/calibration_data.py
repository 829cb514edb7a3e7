"""Many grasps of each object: the figures that the planner gives them, and whether they held in the simulator.

One file for each hand and object, so that a run that was stopped goes on where it was.
"""

from __future__ import annotations

import json
import sys
import time
import zlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from graspmatch.apps.bench.machine import machine, usable_cores
from graspmatch.apps.bench.objects import ObjectSource, folder_sources, household_sources
from graspmatch.apps.bench.processes import use_threads
from graspmatch.apps.bench.trials import NO_GRASP, TOPPLES, random_place, stage
from graspmatch.config import LiftConfig, PlannerConfig
from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import write_atomically
from graspmatch.geometry.mesh import transformed
from graspmatch.gripper.description import content_hash
from graspmatch.gripper.kinematics import load_hand
from graspmatch.gripper.load import load_gripper
from graspmatch.gripper.zoo import card_path
from graspmatch.planner.avoid import upload_space
from graspmatch.planner.candidates import Candidates, Closed
from graspmatch.planner.grade import draw_trials, grade, middling
from graspmatch.planner.hold import Held, Touchable, hold, touchable
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.simulate.judge import try_grasp
from graspmatch.types import GraspSet, Gripper

Array = np.ndarray

HOUSEHOLD = "household"
"""The set of objects made by code."""


@dataclass(frozen=True)
class Lifted:
    """n grasps that were tried; those of one hand and object in the planner's order, best first."""

    hand: Shaped[Array, "n"]
    object: Shaped[Array, "n"]
    """SET/NAME: sets share names."""
    margin: Float[Array, "n"]
    """Mean over the trials of the planner."""
    held_share: Float[Array, "n"]
    """Of those trials."""
    standing: Float[Array, "n"]
    """Mean margin before the object turns, see `Graded`."""
    clear_share: Float[Array, "n"]
    """Of arrivals, in which the hand meets nothing on its way in."""
    loss: Float[Array, "n"]
    """Eq. (13) [m2]."""
    contacts: Float[Array, "n"]
    """Of fingers and palm in the end, the mean over those trials."""
    planned_margin: Float[Array, "n"]
    """The hand where it was planned."""
    pushed: Float[Array, "n"]
    """How far the fingers push the object then [m] ..."""
    slipped: Float[Array, "n"]
    """... and how far it slips as it is lifted [m]."""
    clearance: Float[Array, "n"]
    """[m]"""
    moment_arm: Float[Array, "n"]
    """Distance of the tool centre point from the centre of mass, by the object's size."""
    score: Float[Array, "n"]
    """The planner's, which counts small errors of the pose; here the pose is exact."""
    reason: Shaped[Array, "n"]
    """Why it did not hold; empty where it held."""

    def __len__(self) -> int:
        return len(self.reason)

    @property
    def held(self) -> Bool[Array, "n"]:
        """Whether the object was lifted and stayed in the hand."""
        return self.reason == ""

    def select(self, keep: Array) -> Lifted:
        """The grasps of a mask or an index array."""
        return Lifted(**{entry.name: getattr(self, entry.name)[keep] for entry in fields(self)})

    @property
    def group(self) -> Int[Array, "n"]:
        """Number of the hand and object of each grasp, from zero."""
        names = [f"{hand} {name}" for hand, name in zip(self.hand, self.object, strict=True)]
        return np.unique(names, return_inverse=True)[1] if names else np.zeros(0, dtype=int)


FIGURES = (
    "margin",
    "held_share",
    "standing",
    "clear_share",
    "loss",
    "contacts",
    "planned_margin",
    "pushed",
    "slipped",
    "clearance",
    "moment_arm",
    "score",
)
NOTHING = Lifted(
    **{name: np.zeros(0, dtype="<U1") for name in ("hand", "object", "reason")},
    **{name: np.zeros(0) for name in FIGURES},
)


@dataclass(frozen=True)
class Job:
    """One plan of one hand for one object, of which every grasp is tried."""

    hand: str
    set: str
    """Which objects the object is of."""
    source: ObjectSource
    planner: PlannerConfig
    lift: LiftConfig
    cache: Path

    @property
    def object(self) -> str:
        """What tells the object from those of other sets."""
        return f"{self.set}/{self.source.name}"

    @property
    def path(self) -> Path:
        """Where its entry is kept."""
        return self.cache / f"{self.hand}-{self.set}-{self.source.name}.npz"


@dataclass(frozen=True)
class Entry:
    """What came of a job."""

    lifted: Lifted
    note: str
    """Why there are no grasps; empty where there are."""
    commit: str
    """Of the planner and the simulator that made it."""


def set_name(objects: str) -> str:
    """What to call `household`, or a folder."""
    return objects if objects == HOUSEHOLD else Path(objects).resolve().name


def object_sets(names: Sequence[str]) -> dict[str, list[ObjectSource]]:
    """The objects of `household` and of folders, by the name of the set."""
    labels = [set_name(name) for name in names]
    if len(set(labels)) < len(labels):
        raise GraspmatchError(f"Two sets of objects have one name ({', '.join(labels)}): rename a folder.")
    return {
        label: household_sources() if name == HOUSEHOLD else folder_sources(Path(name))
        for label, name in zip(labels, names, strict=True)
    }


def planner_for(count: int) -> PlannerConfig:
    """The planner, asked for so many grasps, all of them after all trials."""
    config = PlannerConfig()
    every = max(config.grip.finalists, count)  # more than are asked for, as some are too like better ones
    grip = replace(config.grip, leaders=every)
    return replace(config, ranking=replace(config.ranking, count=count), grip=grip)


def collect(jobs: Sequence[Job], *, processes: int, fresh: bool = False) -> dict[Job, Entry]:
    """What comes of all jobs, with progress on stderr; what the cache has, made with the same settings, is not redone.

    `fresh` redoes all.
    """
    kept = {} if fresh else {job: entry for job in jobs if (entry := read_entry(job))}
    todo = [job for job in jobs if job not in kept]
    if todo:
        _say(f"{len(kept)} of {len(jobs)} plans are in the cache; preparing the hands and objects of the others.")
    for hand in dict.fromkeys(job.hand for job in todo):
        load_gripper(hand)
    for source in dict.fromkeys(job.source for job in todo):
        source.load()  # once, here: the processes find its convex parts in the cache
    begin = time.perf_counter()
    for number, (job, entry) in enumerate(_run(todo, processes), 1):
        kept[job] = entry
        outcome = entry.note or f"{entry.lifted.held.sum()} of {len(entry.lifted)} held"
        _say(f"[{number}/{len(todo)}] {time.perf_counter() - begin:.0f} s: {job.hand} {job.object}: {outcome}")
    return {job: kept[job] for job in jobs}


def lift_all(job: Job) -> tuple[Lifted, str]:
    """Settle, place, plan, and lift every grasp; and why there are none."""
    settled, world, gripper = stage(job.source, job.hand, None, job.lift)
    if settled.topples:
        return NOTHING, TOPPLES
    rng = np.random.default_rng([job.planner.seed, zlib.crc32(job.object.encode())])
    T_world_object = random_place(rng) @ settled.T_world_object
    scene = Scene.from_mesh(transformed(settled.target.mesh, T_world_object), table=0.0)
    try:
        grasps = plan(scene, gripper, replace(job.planner, seed=int(rng.integers(2**31))))
    except GraspmatchError as error:  # one object that the planner refuses does not end the collection
        return NOTHING, f"refused: {error}"
    if not len(grasps):
        return NOTHING, NO_GRASP
    reasons = [try_grasp(world, grasps, index, T_world_object, job.lift).reason for index in range(len(grasps))]
    return with_figures(job, grasps, scene, gripper, np.array(reasons)), ""


def with_figures(job: Job, grasps: GraspSet, scene: Scene, gripper: Gripper, reason: Shaped[Array, "n"]) -> Lifted:
    """The grasps with the figures that the planner judged them by.

    Those that a grasp set lacks come from closing the fingers again, as the planner did; that they are the same is
    checked by the confidence that follows from them.
    """
    config, device = job.planner.grip, grasps.provenance.device
    target = touchable(scene, config.points, device)
    closed, planned = closed_again(grasps, target, gripper, job.planner)
    trials = draw_trials(config, grasps.provenance.seed)
    space = upload_space(scene, gripper, device)
    graded = grade(closed, grasps.matching_error, grasps.loss, trials, space, target, config)
    if not np.allclose(graded.sureness, grasps.score, atol=1e-4):
        raise GraspmatchError(f"{job.hand} {job.object}: the figures do not give the score of the plan.")
    R_world_gripper = grasps.T_world_gripper[:, :3, :3]
    grip_centre = R_world_gripper @ gripper.tool_centre_point + grasps.T_world_gripper[:, :3, 3]
    return Lifted(
        hand=np.full(len(grasps), job.hand),
        object=np.full(len(grasps), job.object),
        margin=graded.margin,
        held_share=graded.held_share,
        standing=graded.standing,
        clear_share=graded.clear_share,
        loss=grasps.loss,
        contacts=graded.contacts,
        planned_margin=planned.margin,
        pushed=planned.pushed,
        slipped=planned.slipped,
        clearance=grasps.clearance,
        moment_arm=np.linalg.norm(grip_centre - scene.centre_of_mass, axis=-1) / target.length,
        score=grasps.score,
        reason=reason,
    )


def closed_again(grasps: GraspSet, target: Touchable, gripper: Gripper, planner: PlannerConfig) -> tuple[Closed, Held]:
    """Grasps as the planner grades them, and what comes of them where they were planned, with middling friction."""
    n, config = len(grasps), planner.grip
    candidates = Candidates(grasps.preshape, grasps.T_world_gripper)
    planned = hold(candidates, np.full(n, middling(config)), target, gripper, config, grasps.provenance.device)
    closed = Closed(
        **vars(candidates),
        matching_error=grasps.matching_error,
        loss=grasps.loss,
        is_free=np.ones(n, dtype=bool),
        matched_preshape=grasps.preshape,
        clearance=grasps.clearance,
        retreat=np.zeros(n),
        closing_fraction=planned.fraction,
        grasp_joints=grasps.grasp_joints,
    )
    return closed, planned


def concatenated(parts: Iterable[Lifted]) -> Lifted:
    """All grasps of several."""
    parts = [NOTHING, *parts]
    return Lifted(
        **{entry.name: np.concatenate([getattr(part, entry.name) for part in parts]) for entry in fields(Lifted)}
    )


def read_entry(job: Job) -> Entry | None:
    """What an earlier run with the same settings made; None where there is nothing, or it was made with others."""
    if not job.path.is_file():
        return None
    with np.load(job.path, allow_pickle=False) as file:
        header = json.loads(str(file["header"]))
        if header["settings"] != _settings(job):
            return None
        lifted = Lifted(**{entry.name: file[entry.name] for entry in fields(Lifted)})
    return Entry(lifted, header["note"], header["commit"])


def write_entry(job: Job, entry: Entry) -> None:
    """Keep what came of a job."""
    header = json.dumps({"settings": _settings(job), "note": entry.note, "commit": entry.commit})
    job.path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(job.path, lambda temporary: np.savez_compressed(temporary, header=header, **vars(entry.lifted)))


def _settings(job: Job) -> dict[str, Any]:
    """What a job's grasps depend on, besides the code, as JSON reads it back."""
    settings = {
        "hand": _hand_hash(job.hand),
        "object": [job.object, job.source.content_hash()],
        "planner": asdict(job.planner),
        "lift": asdict(job.lift),
        "figures": [entry.name for entry in fields(Lifted)],
    }
    return json.loads(json.dumps(settings))


@lru_cache
def _hand_hash(name: str) -> str:
    hand = load_hand(card_path(name))
    return content_hash(hand.card, hand.description)


def _run(jobs: Sequence[Job], processes: int) -> Iterator[tuple[Job, Entry]]:
    """The jobs as they end, in any order."""
    if processes == 1:
        yield from ((job, _run_one(job)) for job in jobs)
        return
    # Fresh interpreters with one thread each, as trials are run.
    threads = str(max(1, usable_cores() // processes))
    with ProcessPoolExecutor(processes, get_context("spawn"), initializer=use_threads, initargs=(threads,)) as pool:
        futures = {pool.submit(_run_one, job): job for job in jobs}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            for future in futures:
                future.cancel()


def _run_one(job: Job) -> Entry:
    lifted, note = lift_all(job)
    entry = Entry(lifted, note, machine()["commit"])
    write_entry(job, entry)
    return entry


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)
