"""Antipodal sampling for two-finger hands: opposite points of the surface, held along the line between them.

The classic of model-based grasp sampling: draw a contact, cast a line into the object within its friction cone, and
keep the pair when the line lies in the cone of the other contact as well. The turn of the hand about that line is
random, the fingers' pads go to its middle, and what collides is dropped. Nothing ranks the rest: its order is random.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from baselines.result import grasp_set
from graspmatch.config import ClosingConfig, CollisionConfig
from graspmatch.formats.graspnet import jaw
from graspmatch.geometry import se3
from graspmatch.kernels.launch import resolve_device
from graspmatch.planner.avoid import Space, point_clearance, table_clearance_of_way, upload_space
from graspmatch.planner.candidates import Candidates, Closed, Free
from graspmatch.planner.close import close_fingers
from graspmatch.planner.seed import asked_for
from graspmatch.planner.tally import Tally
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, GraspSet, Gripper, PointCloud

FRICTION = 0.6
CLEARANCE = CollisionConfig().clearance
"""Least distance of hand and way in to everything [m], as in the planner."""
DRAWS = 2000
"""Contacts drawn at most."""
BATCH = 200
"""So many are drawn at a time, until there are enough grasps."""
ENOUGH = 100
LINE_RADIUS = 0.0025
"""A point counts as on the line within this [m]: the spacing of a scene's points."""
THINNEST = 0.001
"""Nearer points are on the same side of the object [m]."""

NO_OPPOSITE = "no opposite surface in both friction cones and within the opening"
TABLE = "in collision with the table"
POINTS = "in collision with object or obstacles on the way in"
ADVICE = {
    NO_OPPOSITE: "No two opposite sides of the object fit into the hand: {name} opens {opening:.0f} mm wide.",
    TABLE: "The hand meets the table: is the table's height right, the object too flat?",
    POINTS: "The hand does not fit around the object: {name} opens {opening:.0f} mm wide.",
}


@dataclass(frozen=True)
class Pairs:
    """n pairs of opposite points on the object."""

    middle: Float[np.ndarray, "n 3"]
    """[m]"""
    axis: Float[np.ndarray, "n 3"]
    """Unit vector from one to the other."""
    width: Float[np.ndarray, "n"]
    """[m]"""


@dataclass(frozen=True)
class Jaws:
    """The preshapes of a hand from the narrowest to the widest jaw."""

    preshape: Int[np.ndarray, "p"]
    opening: Float[np.ndarray, "p"]
    """Clear distance between the pads [m]."""
    pad_centre: Float[np.ndarray, "p 3"]
    """Middle between the pads [m], gripper frame."""


def antipodal(scene: Scene, gripper: Gripper, seed: int) -> GraspSet:
    """At most `ENOUGH` antipodal grasps that are free, in random order."""
    if len(gripper.fingers) != 2:
        raise GraspmatchError(
            f"Antipodal grasps are for two fingers, {gripper.name} has {len(gripper.fingers)}. "
            "Possible: franka_hand, robotiq_2f85."
        )
    begin = time.perf_counter()
    rng = np.random.default_rng(seed)
    device = resolve_device("auto")
    jaws, space, tally = sorted_jaws(gripper), upload_space(scene, gripper, device), Tally(0)
    found: list[Closed] = []
    while tally.counts["candidates"] < DRAWS and sum(map(len, found)) < ENOUGH:
        tally.counts["candidates"] += BATCH
        pairs = opposite_points(scene.target, jaws.opening[-1] - 2 * CLEARANCE, rng)
        tally.counts[NO_OPPOSITE] = tally.counts.get(NO_OPPOSITE, 0) + BATCH - len(pairs.width)
        free = free_grasps(pairs, jaws, space, rng, tally)
        found.append(close_fingers(free, space, ClosingConfig(), tally))
    grasps = joined(found)
    spare = max(len(grasps) - ENOUGH, 0)
    grasps = grasps.select(np.arange(len(grasps) - spare))
    return grasp_set(
        "antipodal",
        grasps.T_world_gripper,
        grasps.preshape,
        np.array([preshape.joints for preshape in gripper.preshapes])[grasps.preshape],
        grasps.grasp_joints,
        rng.random(len(grasps)),
        gripper,
        tally.counts | {"more than asked for": spare},
        seed,
        fingers_touching=np.sum(grasps.closing_fraction <= 1, axis=-1),
        advice="" if len(grasps) else advice(tally.counts, gripper),
        source=scene.source,
        device=device,
        seconds={"antipodal": time.perf_counter() - begin},
    )


def sorted_jaws(gripper: Gripper) -> Jaws:
    """The middle of the pads is as far behind the fingertips as the hand's tool centre point, when closed, says."""
    asked = asked_for(gripper)
    jaws = [jaw(gripper.preshapes[i], gripper) for i in asked]
    opening = np.array([each.opening for each in jaws])
    order = np.argsort(opening)[: np.sum(np.isfinite(opening))]  # NaN comes last
    if len(order) == 0:
        raise GraspmatchError(f"No preshape of {gripper.name} has two pads face to face along its closing axis.")
    closed_tip = max(float((outline[-1] @ gripper.approach).max()) for outline in gripper.preshapes[0].finger_outlines)
    behind = closed_tip - float(gripper.tool_centre_point @ gripper.approach)
    centres = np.array([each.tip_centre for each in jaws]) - behind * gripper.approach
    return Jaws(asked[order], opening[order], centres[order])


def opposite_points(cloud: PointCloud, widest: float, rng: np.random.Generator) -> Pairs:
    """Pairs at most `widest` apart whose line is in the friction cones of both, from `BATCH` draws of the first."""
    points, normals = cloud.points, cloud.normals
    if normals is None:
        raise GraspmatchError("Antipodal grasps need the normals of the object's points.")
    first = rng.integers(len(points), size=BATCH)
    second = hit_by_rays(points, normals, first, directions_in_cone(-normals[first], rng), widest, rng)
    first, second = first[second >= 0], second[second >= 0]
    across = points[second] - points[first]
    width = np.linalg.norm(across, axis=-1)
    axis = across / width[:, None]
    # The point hit lies up to `LINE_RADIUS` beside the ray, so both cones are checked again on the line between them.
    cosine = 1 / np.hypot(1, FRICTION)
    leaves, enters = -np.sum(axis * normals[first], axis=-1), np.sum(axis * normals[second], axis=-1)
    good = (np.minimum(leaves, enters) >= cosine) & (width <= widest)
    return Pairs((points[first] + points[second])[good] / 2, axis[good], width[good])


def directions_in_cone(axis: Float[np.ndarray, "n 3"], rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Directions spread evenly over the friction cone about each axis."""
    cosine = rng.uniform(1 / np.hypot(1, FRICTION), 1, len(axis))[:, None]
    aside = se3.rotation_facing(axis, rng.normal(size=axis.shape))[:, :, 0]
    return cosine * axis + np.sqrt(1 - cosine**2) * aside


def hit_by_rays(
    points: Float[np.ndarray, "k 3"],
    normals: Float[np.ndarray, "k 3"],
    first: Int[np.ndarray, "n"],
    directions: Float[np.ndarray, "n 3"],
    longest: float,
    rng: np.random.Generator,
) -> Int[np.ndarray, "n"]:
    """Index of a point where each ray leaves the object within the friction cone, -1 where there is none.

    A ray that leaves more than once (a mug's wall, then the wall across) gives one of these points at random.
    """
    centred = points - points.mean(axis=0)  # the squares below are then no larger than the object
    origin = centred[first]
    along = directions @ centred.T - np.sum(directions * origin, axis=-1)[:, None]
    square = np.sum(centred**2, axis=-1) - 2 * origin @ centred.T + np.sum(origin**2, axis=-1)[:, None]
    hit = (along > THINNEST) & (along <= longest) & (square - along**2 < LINE_RADIUS**2)
    hit &= directions @ normals.T >= 1 / np.hypot(1, FRICTION)
    count, index = hit.sum(axis=-1), np.nonzero(hit)[1]
    chosen = np.cumsum(count) - count + np.floor(rng.random(len(first)) * count).astype(int)
    return np.where(count > 0, np.append(index, -1)[chosen], -1)


def free_grasps(pairs: Pairs, jaws: Jaws, space: Space, rng: np.random.Generator, tally: Tally) -> Free:
    """One grasp of each pair, turned about its line at random, in the narrowest preshape that is free; or none."""
    n, gripper = len(pairs.width), space.gripper
    turned = se3.rotation_facing(pairs.axis, rng.normal(size=(n, 3)))  # x = approach, z = closing
    R_world_gripper = turned @ se3.rotation_facing(gripper.closing, gripper.approach).T
    above_table, clearance = np.zeros(n, dtype=bool), np.full(n, -np.inf)
    preshape, T_world_gripper = np.zeros(n, dtype=int), np.tile(np.eye(4), (n, 1, 1))
    for index, opening, centre in zip(jaws.preshape, jaws.opening, jaws.pad_centre, strict=True):
        trying = np.flatnonzero((clearance < CLEARANCE) & (pairs.width + 2 * CLEARANCE <= opening))
        R = R_world_gripper[trying]
        T = se3.from_parts(R, pairs.middle[trying] - R @ centre)
        clear, is_above = clearances(Candidates(np.full(len(trying), index), T), space)
        clearance[trying], preshape[trying], T_world_gripper[trying] = clear, index, T
        above_table[trying] |= is_above
    is_clear = tally.keep(above_table, TABLE) & tally.keep(clearance >= CLEARANCE, POINTS, among=above_table)
    unknown = np.full(n, np.nan)
    grasps = Free(
        preshape=preshape,
        T_world_gripper=T_world_gripper,
        matching_error=unknown,
        loss=unknown,
        is_free=is_clear,
        matched_preshape=preshape,
        clearance=clearance,
        retreat=np.zeros(n),
    )
    return grasps.select(is_clear)


def clearances(candidates: Candidates, space: Space) -> tuple[Float[np.ndarray, "n"], np.ndarray]:
    """Distance of hand and way in to everything [m], minus infinity for what collides; and what clears the table."""
    clearance = table_clearance_of_way(candidates, space)
    is_above = clearance >= CLEARANCE
    # Most of what collides has one of a few points inside the hand; only the rest needs all of them.
    promising = np.flatnonzero(is_above)
    promising = promising[point_clearance(candidates.select(promising), replace(space, points=space.coarse)) > 0]
    clear = np.full(len(candidates), -np.inf)
    clear[promising] = np.minimum(clearance[promising], point_clearance(candidates.select(promising), space))
    return clear, is_above


def joined(parts: list[Closed]) -> Closed:
    """All of them, one behind the other."""
    return Closed(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Closed)})


def advice(counts: dict[str, int], gripper: Gripper) -> str:
    """What would help, by the reason that dropped most candidates."""
    worst = max((reason for reason in counts if reason != "candidates"), key=lambda reason: counts[reason])
    return ADVICE.get(worst, "").format(name=gripper.name, opening=1000 * gripper.opening)
