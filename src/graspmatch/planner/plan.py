"""From a scene and a gripper to ranked grasps: each line of `plan` is a stage, and each stage is a file."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from importlib.metadata import version

import numpy as np
from jaxtyping import Float

from graspmatch.config import CollisionConfig, PlannerConfig, RankingConfig, check
from graspmatch.geometry import se3
from graspmatch.geometry.cloud import narrowest_width
from graspmatch.kernels.launch import resolve_device
from graspmatch.planner.avoid import keep_free, upload_space
from graspmatch.planner.candidates import Candidates, Graded
from graspmatch.planner.close import close_fingers
from graspmatch.planner.grade import foremost, stopped
from graspmatch.planner.match import match, prepare, terms_of
from graspmatch.planner.pinch import pinch_seeds
from graspmatch.planner.rank import rank
from graspmatch.planner.refine import Judge, joined, judge_of, refine
from graspmatch.planner.seed import pose_seeds, seed_poses
from graspmatch.planner.stopwatch import Stopwatch
from graspmatch.planner.tally import Tally
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, GraspSet, Gripper, Provenance


def plan(
    scene: Scene,
    gripper: Gripper,
    config: PlannerConfig | None = None,
    *,
    starts_world_gripper: Float[np.ndarray, "n 4 4"] | None = None,
) -> GraspSet:
    """Ranked grasps, best first, in the frame of the scene's input; an empty set explains itself.

    `starts_world_gripper` are poses to start from (another planner's, say) in place of the configured seeds; they are
    refined where they are, without the Stein phase.
    Raises `GraspmatchError` for a device that is not there, and for a configuration that makes no sense.
    """
    config = config or PlannerConfig()
    check(config)
    if config.closing.fewest_fingers > len(gripper.fingers):
        raise GraspmatchError(
            f"closing.fewest_fingers is {config.closing.fewest_fingers}; {gripper.name} has {len(gripper.fingers)}."
        )
    device = resolve_device(config.device)
    rng = np.random.default_rng(config.seed)
    watch, tally = Stopwatch(), Tally(0)
    if starts_world_gripper is not None:  # what another planner chose is not scattered by the search for orientations
        config = replace(config, matching=replace(config.matching, stein_iterations=0))
    problem = prepare(scene, gripper, config.matching, rng, device)
    space = upload_space(scene, gripper, device)
    judge = judge_of(scene, gripper, space, problem, config, device)
    watch.lap("prepare")
    graded = None
    for batch in range(config.seeding.batches if starts_world_gripper is None else 1):
        tips = pinch_seeds(scene, gripper, config.seeding, rng) if batch % 2 else None
        if starts_world_gripper is not None:
            starts = pose_seeds(starts_world_gripper, gripper)
        else:
            starts = tips or seed_poses(scene, gripper, config.seeding, rng)
        found = candidates_from(starts, for_tips(judge) if tips else judge, tally, watch, rng)
        graded = found if graded is None else joined(graded, found)
        if graded.confidence.max(initial=0.0) >= config.refining.enough:
            break
    assert graded is not None  # there is one batch at least
    graded = graded.select(tally.keep(graded.confidence >= least_confidence(scene, config.ranking), UNSURE))
    order = rank(graded, graded.confidence, config.ranking, tally, "ranked lower than asked for")
    graded = stopped(graded.select(order), judge.target, gripper, config.grip, device)
    watch.lap("rank")
    provenance = Provenance(
        gripper=gripper.name,
        gripper_hash=gripper.content_hash,
        config=json.dumps(asdict(config)),
        seed=config.seed,
        device=device,
        version=version("graspmatch"),
        source=scene.source,
        seconds=watch.seconds,
    )
    return grasp_set(graded, scene, gripper, tally, provenance)


def candidates_from(
    starts: Candidates, judge: Judge, tally: Tally, watch: Stopwatch, rng: np.random.Generator
) -> Graded:
    """All that becomes of some starts, graded and refined."""
    gripper, config, space = judge.gripper, judge.config, judge.space
    tally.add("candidates", len(starts))
    problem = replace(judge.problem, terms=terms_of(config.matching))
    matched = match(starts, problem, config.matching, rng)  # Algorithm 1 of the paper
    watch.lap("match")
    free = keep_free(matched, space, config.collision, tally)  # hand and approach sweep
    watch.lap("avoid")
    closed = close_fingers(free, space, config.closing, tally)  # contacts and joint values
    watch.lap("close")
    count = max(config.grip.finalists, config.ranking.count)
    closed = foremost(closed, count, judge.target, gripper, config.grip, judge.device, tally)
    watch.lap("screen")
    graded = judge.grade(closed, judge.first)  # where the fingers push the object, what they hold there, how surely
    watch.lap("grade")
    graded = refine(graded, judge)
    watch.lap("refine")
    return graded


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
) -> GraspSet:
    """The result, in the order given."""
    pregrasp = np.array([preshape.joints for preshape in gripper.preshapes])
    back = se3.translation(-gripper.approach_distance * gripper.approach)
    return GraspSet(
        joint_names=gripper.joint_names,
        preshape_names=tuple(preshape.name for preshape in gripper.preshapes),
        T_world_gripper=graded.T_world_gripper,
        T_world_pregrasp=graded.T_world_gripper @ back,
        preshape=graded.preshape,
        pregrasp_joints=pregrasp[graded.preshape],
        grasp_joints=graded.grasp_joints,
        score=graded.confidence,
        quality=graded.margin,
        clearance=graded.clearance,
        matching_error=graded.error,
        loss=graded.final_loss,
        fingers_touching=np.sum(graded.closing_fraction <= 1, axis=-1),
        tally=tally.counts,
        provenance=provenance,
        advice="" if len(graded) else advice(tally, scene, gripper),
    )


def least_confidence(scene: Scene, config: RankingConfig) -> float:
    """How sure a grasp must be to come out."""
    if config.least_confidence is not None:
        return config.least_confidence
    return 0.5 if scene.mesh is not None else 0.0


UNSURE = "more likely to fail than to hold"


def is_too_wide(width: float, gripper: Gripper) -> bool:
    """Whether a width leaves no room beside it between the open fingers [m]."""
    return width > gripper.opening - 2 * CollisionConfig().clearance


def advice(tally: Tally, scene: Scene, gripper: Gripper) -> str:
    """What would help: that the object is too wide, if it is, else by the reason that dropped most candidates."""
    width = narrowest_width(scene.target.points)
    if is_too_wide(width, gripper):
        return (
            f"The object is at least {1000 * width:.0f} mm wide in every direction; {gripper.name} opens "
            f"{1000 * gripper.opening:.0f} mm wide and finds no part of it to hold."
        )
    reasons = {reason: count for reason, count in tally.counts.items() if reason != "candidates"}
    worst = max(reasons, key=lambda reason: reasons[reason], default="")
    if not reasons.get(worst):
        return ""
    hints = {
        "in collision with the table": "The hand meets the table: is the table's height right, the object too flat?",
        "in collision with object or obstacles on the way in": (
            f"The hand does not fit around the object: {gripper.name} opens {gripper.opening * 1000:.0f} mm wide."
        ),
        "fingers that close on nothing": "The fingers do not reach the object: is its size in metres?",
        "fingers stopped by the table or an obstacle": "The fingers meet the table or an obstacle before the object.",
        UNSURE: "The object slips out of the fingers; ranking.least_confidence = 0 gives the grasps all the same.",
    }
    return hints.get(worst, "")
