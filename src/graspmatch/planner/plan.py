"""From a scene and a gripper to ranked grasps: each line of `plan` is a stage, and each stage is a file."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import cache
from importlib.metadata import version

import numpy as np
from jaxtyping import Float

from graspmatch.config import ClosingConfig, PathConfig, PlannerConfig, RankingConfig
from graspmatch.kernels.blas import blas_on_one_thread
from graspmatch.kernels.launch import load, resolve_device
from graspmatch.kernels.warp_avoid import back_off
from graspmatch.kernels.warp_fields import sweep_along
from graspmatch.kernels.warp_hold import hold
from graspmatch.kernels.warp_stein import stein
from graspmatch.kernels.warp_steps import descend
from graspmatch.planner.advice import UNSURE, advice
from graspmatch.planner.avoid import keep_free, upload_space
from graspmatch.planner.candidates import Candidates, Graded
from graspmatch.planner.close import close_fingers
from graspmatch.planner.grade import foremost, stopped
from graspmatch.planner.match import match, prepare, terms_of
from graspmatch.planner.path import Reach, aimed, keep_executable
from graspmatch.planner.pinch import pinch_seeds
from graspmatch.planner.rank import rank
from graspmatch.planner.recording import Recording
from graspmatch.planner.refine import Judge, joined, judge_of, refine, roomiest
from graspmatch.planner.seed import pose_seeds, seed_poses
from graspmatch.planner.stopwatch import Stopwatch
from graspmatch.planner.tally import Tally
from graspmatch.ranges import check
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, GraspSet, Gripper, Provenance

KERNELS = (descend, hold, stein, back_off, sweep_along)
"""One of each module that every plan needs; what takes longest to compile comes first."""


@blas_on_one_thread()
def plan(
    scene: Scene,
    gripper: Gripper,
    config: PlannerConfig | None = None,
    *,
    starts_world_gripper: Float[np.ndarray, "n 4 4"] | None = None,
    reach: Reach | None = None,
    recording: Recording | None = None,
) -> GraspSet:
    """Ranked grasps, best first, in the frame of the scene's input; an empty set explains itself.

    `starts_world_gripper` are poses to start from (another planner's, say) in place of the configured seeds; they are
    refined where they are, without the Stein phase.
    `reach` says which ways the robot can go: a function of the poses (n, 3, 4, 4) of the gripper frame where n ways
    begin, at their grasps and where they end, with n bools as its result; an `Arm` is one.
    `recording` keeps every particle at every iteration and all that were dropped; it costs time and changes nothing.
    Raises `GraspmatchError` for a device that is not there, and for a configuration that makes no sense.
    """
    config = config or PlannerConfig()
    check(config)
    if config.closing.fewest_fingers > max(len(gripper.fingers), ClosingConfig().fewest_fingers):
        raise GraspmatchError(
            f"closing.fewest_fingers is {config.closing.fewest_fingers}; {gripper.name} has {len(gripper.fingers)}."
        )
    device = resolve_device(config.device)
    load(KERNELS, device)
    rng = np.random.default_rng(config.seed)
    watch, tally = Stopwatch(), Tally(0, recording)
    if starts_world_gripper is not None:  # what another planner chose is not scattered by the search for orientations
        config = replace(config, matching=replace(config.matching, stein_iterations=0))
    problem = prepare(scene, gripper, config.matching, rng, device)
    space = upload_space(scene, gripper, device)
    judge = judge_of(scene, gripper, space, problem, config, device, reach)
    watch.lap("prepare")
    graded = None
    for batch in range(config.seeding.batches if starts_world_gripper is None else 1):
        if starts_world_gripper is None:
            starts, matched_by = seeds_of(batch, scene, judge, rng)
        else:
            starts, matched_by = pose_seeds(starts_world_gripper, gripper), judge
        found = candidates_from(starts, matched_by, tally, watch, rng)
        graded = found if graded is None else joined(graded, found)
        if graded.confidence.max(initial=0.0) >= config.refining.enough:
            break
    assert graded is not None  # there is one batch at least
    is_sure = graded.sureness >= least_confidence(scene, config.ranking)
    graded = graded.select(tally.keep(is_sure, UNSURE, of=graded))
    order = rank(graded, graded.sureness, config.ranking, tally, "ranked lower than asked for")
    graded = stopped(graded.select(order), judge.target, gripper, config.grip, device)
    watch.lap("rank")
    provenance = Provenance(
        gripper=gripper.name,
        gripper_hash=gripper.content_hash,
        config=json.dumps(asdict(config)),
        seed=config.seed,
        device=device,
        version=_version(),
        source=scene.source,
        seconds=watch.seconds,
    )
    return grasp_set(graded, scene, gripper, tally, provenance, config.path)


def candidates_from(
    starts: Candidates, judge: Judge, tally: Tally, watch: Stopwatch, rng: np.random.Generator
) -> Graded:
    """All that becomes of some starts, graded and refined."""
    config, space = judge.config, judge.space
    tally.add("candidates", len(starts))
    problem = replace(judge.problem, terms=terms_of(config.matching))
    matched = match(starts, problem, config.matching, rng, tally.recording)  # Algorithm 1 of the paper
    watch.lap("match")
    free = keep_free(matched, space, config.collision, tally)  # hand and approach sweep
    watch.lap("avoid")
    closed = close_fingers(free, space, config.closing, tally)  # contacts and joint values
    closed = keep_executable(closed, judge.way, tally)  # directions, workspace, way out, reach
    watch.lap("close")
    count = max(config.grip.finalists, config.ranking.count)
    closed = foremost(closed, count, judge.trials, space, judge.target, config.grip, tally)
    closed, share = roomiest(closed, judge)  # in wider preshapes, where that makes room
    watch.lap("screen")
    # where the fingers push the object, what they hold there, how surely
    graded = judge.grade(closed, judge.first, share=share)
    watch.lap("grade")
    graded = refine(graded, judge)
    watch.lap("refine")
    return graded


def seeds_of(batch: int, scene: Scene, judge: Judge, rng: np.random.Generator) -> tuple[Candidates, Judge]:
    """Where a batch starts, and how it is matched: every other one with fingertips, where there are opposite points."""
    gripper, config = judge.gripper, judge.config.seeding
    if batch % 2:
        tips = pinch_seeds(scene, gripper, config, rng)
        if len(tips):
            return tips, for_tips(judge)
    return aimed(seed_poses(scene, gripper, config, rng), judge.way, scene.centre_of_mass), judge


def for_tips(judge: Judge) -> Judge:
    """The same, but that fingertips are matched where they start: not scattered, nor drawn to the centre of mass."""
    matching = replace(judge.config.matching, stein_iterations=0, com_weight=0.0)
    return replace(judge, config=replace(judge.config, matching=matching))


def grasp_set(
    graded: Graded,
    scene: Scene,
    gripper: Gripper,
    tally: Tally,
    provenance: Provenance,
    path: PathConfig | None = None,
) -> GraspSet:
    """The result, in the order given."""
    pregrasp = np.array([preshape.joints for preshape in gripper.preshapes])
    return GraspSet(
        joint_names=gripper.joint_names,
        preshape_names=tuple(preshape.name for preshape in gripper.preshapes),
        T_world_gripper=graded.T_world_gripper,
        T_world_pregrasp=graded.T_world_gripper @ gripper.T_gripper_pregrasp,
        preshape=graded.preshape,
        pregrasp_joints=pregrasp[graded.preshape],
        grasp_joints=graded.grasp_joints,
        score=(1 - scene.cut) * graded.sureness,
        quality=graded.margin,
        clearance=graded.clearance,
        matching_error=graded.error,
        loss=graded.final_loss,
        fingers_touching=np.sum(graded.closing_fraction <= 1, axis=-1),
        tally=tally.counts,
        provenance=provenance,
        advice="" if len(graded) else advice(tally, scene, gripper, path),
    )


@cache
def _version() -> str:
    """Of this package; reading it takes longer than some stages."""
    return version("graspmatch")


def least_confidence(scene: Scene, config: RankingConfig) -> float:
    """How sure a grasp must be to come out."""
    if config.least_confidence is not None:
        return config.least_confidence
    return 0.3 if scene.mesh is not None else 0.0
