"""Where the fingertips start: at opposite points of the surface, the closing axis along the line between them.

The seeds of the paper face the centre of mass, which suits hands that enclose an object. Thin, flat and small things
are held where the fingertips find opposite sides: an edge, a rim, a stem.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from graspmatch.config import SeedingConfig
from graspmatch.geometry import se3
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.seed import upright_frame
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper, Preshape

Array = np.ndarray

FIRST, SECOND = 750, 3000
"""Points of the surface for which an opposite one is looked for, and among which; at most so many."""
CONE = np.cos(np.arctan(0.7))
"""Cosine of the cone about both normals that the line between two opposite points lies in: what holds by friction, and
a little more, for matching moves them."""
ROWS = 100
"""Of the first, so many at a time stay in a core's cache."""
THINNEST = 0.0005
"""Nearer points are on the same side of the object [m]."""
TURNS = 16
"""Turns about the line between two points that are drawn, of which the first is taken that comes from where it may."""


@dataclass(frozen=True)
class Pairs:
    """n pairs of opposite points, world frame."""

    middle: Float[Array, "n 3"]
    """[m]"""
    axis: Float[Array, "n 3"]
    """Unit vector from one to the other."""
    width: Float[Array, "n"]
    """[m]"""

    def __len__(self) -> int:
        return len(self.width)


def pinch_seeds(scene: Scene, gripper: Gripper, config: SeedingConfig, rng: np.random.Generator) -> Candidates:
    """Fingertip preshapes at opposite points that fit between them; none where there are no such points, and where
    Gaussians say where hands start."""
    R_world_up = upright_frame(scene, np.array(config.robot_direction))
    tips = np.flatnonzero([preshape.is_fingertips for preshape in gripper.preshapes])
    gap = np.array([gap_of(gripper.preshapes[i], gripper) for i in tips])
    count = config.fingertips if config.pattern != "gaussians" else 0
    pairs = opposite_points(scene, count, float(gap.max(initial=0.0)), rng)
    fits = gap > pairs.width[:, None]
    chosen = np.argmax(rng.random(fits.shape) * fits, axis=1) if len(pairs) else np.zeros(0, dtype=int)
    order = np.argsort(tips[chosen], kind="stable")
    preshape = tips[chosen][order]
    R_world_canonical = _turned(pairs, config, R_world_up, rng)[order]
    R_world_gripper = R_world_canonical @ gripper.T_gripper_canonical[:3, :3].T
    tcp_gripper = np.array([gripper.preshapes[i].tool_centre_point for i in preshape]).reshape(-1, 3)
    origin = pairs.middle[order] - np.einsum("nij,nj->ni", R_world_gripper, tcp_gripper)
    return Candidates(preshape, se3.from_parts(R_world_gripper, origin))


def gap_of(preshape: Preshape, gripper: Gripper) -> float:
    """About the width between the tips [m]."""
    from_centre = preshape.samples.points - preshape.tool_centre_point
    across = from_centre - (from_centre @ gripper.approach)[:, None] * gripper.approach
    return 2 * float(np.average(np.linalg.norm(across, axis=-1), weights=preshape.weights))


def opposite_points(scene: Scene, count: int, widest: float, rng: np.random.Generator) -> Pairs:
    """Pairs of points whose normals are against each other, at most `widest` apart [m]: so many, drawn from all that
    there are; none where there is none."""
    normals = scene.target.normals
    assert normals is not None  # every scene estimates them
    some = rng.permutation(len(normals))[:SECOND]
    points = (scene.target.points[some] - scene.centre_of_mass).astype(np.float32)
    normals = normals[some].astype(np.float32)
    rows = [_opposite(points, normals, slice(at, at + ROWS), widest) for at in range(0, min(FIRST, len(some)), ROWS)]
    found = np.concatenate([np.argwhere(row) + np.array([ROWS * k, 0]) for k, row in enumerate(rows)])
    chosen = found[rng.integers(len(found), size=count)] if len(found) else found
    a, b = (points[chosen[:, k]] + scene.centre_of_mass for k in range(2))
    width = np.linalg.norm(b - a, axis=-1)
    return Pairs((a + b) / 2, (b - a) / width[:, None], width)


def _opposite(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], some: slice, widest: float
) -> Bool[Array, "k n"]:
    """Which points are opposite to some of them."""
    first, towards = points[some], normals[some]
    square = np.sum(points**2, axis=-1)
    apart = square[some, None] + square - 2 * first @ points.T
    width = np.sqrt(np.maximum(apart, 1e-12))
    leaves = np.sum(first * towards, axis=-1)[:, None] - towards @ points.T
    arrives = np.sum(points * normals, axis=-1) - first @ normals.T
    return (np.minimum(leaves, arrives) > CONE * width) & (width < widest) & (width > THINNEST)


def _turned(
    pairs: Pairs, config: SeedingConfig, R_world_up: Float[Array, "3 3"], rng: np.random.Generator
) -> Float[Array, "n 3 3"]:
    """Canonical frames (+z approach, +x closing) that come from above, and from the robot's side where the pattern of
    the other seeds does; where no turn that is drawn does, any."""
    n = len(pairs)
    frame = se3.rotation_facing(pairs.axis, rng.normal(size=(n, 3)))  # z along the axis
    angle = rng.uniform(0, 2 * np.pi, (n, TURNS))
    approach = np.cos(angle)[..., None] * frame[:, None, :, 0] + np.sin(angle)[..., None] * frame[:, None, :, 1]
    comes_from = -approach @ R_world_up
    may = comes_from[..., 2] > 0
    if config.pattern == "quarter":
        may &= comes_from[..., 0] > 0
    z = approach[np.arange(n), np.argmax(may, axis=1)]
    x = pairs.axis * rng.choice([-1.0, 1.0], size=(n, 1))
    return np.stack([x, np.cross(z, x), z], axis=-1)
