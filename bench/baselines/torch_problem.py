"""Scene, hand and poses as PyTorch tensors, for `torch_matching`, and the algebra of rotations.

Poses are those of the preshapes' tool centre points in the object frame (world axes, origin at the centre of mass).
Axes of tensors: p preshapes, k particles of each, m samples of the inner surface, r points of the target R, c points of
the surroundings C; single precision. Quaternions are wxyz.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspmatch.config import MatchingConfig
from graspmatch.geometry.cloud import voxel_downsample
from graspmatch.geometry.se3 import quaternion_from_matrix
from graspmatch.geometry.thin import thinned
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.match import target_spacing
from graspmatch.planner.seed import asked_for
from graspmatch.planner.upload import inverse_inertia
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper

FAR = 1.0
"""Distance [m] in the padding of the hands' fields: outside every hand."""
LONGEST_TURN = 0.5
"""Of one update [rad]."""


@dataclass(frozen=True)
class Hand:
    """All preshapes, padded to one shape; matching works about each preshape's pivot, its tool centre point."""

    count: Int[np.ndarray, "p"]
    """Samples of each preshape."""
    pivots: Float[np.ndarray, "p 3"]
    """[m], gripper frame."""
    samples: Float[Tensor, "p m 3"]
    """S [m]."""
    weights: Float[Tensor, "p m"]
    """Zero in the padding."""
    inverse_inertia: Float[Tensor, "p 3 3"]
    """Rotational block of A of eq. (3) [1/m2]."""
    distance: Float[Tensor, "p x y z"]
    """G at the nodes of a grid [m], negative inside."""
    nearest_sample: Int[Tensor, "p x y z"]
    origin: Float[Tensor, "p 3"]
    """Of the grids [m]."""
    spacing: float
    outline: Float[Tensor, "p v 3"]
    """Corners of the links' convex hulls [m]."""
    is_outline: Bool[Tensor, "p v"]
    """False in the padding."""


@dataclass(frozen=True)
class Problem:
    """Scene and hand as tensors, object frame."""

    hand: Hand
    shuffled: tuple[Int[np.ndarray, "_"], ...]
    """For each preshape its samples in random order: a window of them is a mini-batch."""
    centre_of_mass: Float[np.ndarray, "3"]
    """Origin of the object frame in the world [m]."""
    target: Float[Tensor, "r 3"]
    """R [m]."""
    surroundings: Float[Tensor, "c 3"]
    """C but for the table: points of the target, then those of obstacles [m]."""
    targets: int
    """How many of the surroundings are the target's."""
    table: tuple[Float[Tensor, "3"], float] | None
    """Normal and offset [m] of a plane."""


@dataclass(frozen=True)
class Poses:
    """theta: position [m] and unit quaternion of each particle."""

    position: Float[Tensor, "*b 3"]
    rotation: Float[Tensor, "*b 4"]

    def reshape(self, *shape: int) -> Poses:
        """The same poses in other leading axes."""
        return Poses(self.position.reshape(*shape, 3), self.rotation.reshape(*shape, 4))

    def moved(self, move: Float[Tensor, "*b 3"], turn: Float[Tensor, "*b 3"]) -> Poses:
        """t + move [m], exp(turn) q [rad], the turn no longer than the longest."""
        turn = shortened(turn, LONGEST_TURN)
        half = 0.5 * turn.norm(dim=-1, keepdim=True)
        by = torch.cat([half.cos(), 0.5 * torch.sinc(half / torch.pi) * turn], dim=-1)
        return Poses(self.position + move, torch.nn.functional.normalize(multiply(by, self.rotation), dim=-1))

    def where(self, mask: Bool[Tensor, "*b"], other: Poses) -> Poses:
        """These poses where the mask says so, the others elsewhere."""
        mask = mask[..., None]
        return Poses(torch.where(mask, self.position, other.position), torch.where(mask, self.rotation, other.rotation))


def torch_prepare(
    scene: Scene, gripper: Gripper, config: MatchingConfig, rng: np.random.Generator, device: str
) -> Problem:
    """Thin the clouds as `graspmatch.planner.match.prepare` does, and upload everything."""
    points = scene.target.points - scene.centre_of_mass
    target, _ = voxel_downsample(points, target_spacing(points, config.voxel_size), origin=np.zeros(3))
    hand = torch_hand(gripper, device)
    own, others = (thinned(cloud.points, config.collision_points) for cloud in (scene.target, scene.obstacles))
    table = None
    if scene.table is not None:
        offset = scene.table.offset - float(scene.table.normal @ scene.centre_of_mass)
        table = tensor(scene.table.normal, device), offset
    return Problem(
        hand=hand,
        shuffled=tuple(rng.permutation(count) for count in hand.count),
        centre_of_mass=scene.centre_of_mass,
        target=tensor(target, device),
        surroundings=tensor(np.concatenate([own, others]) - scene.centre_of_mass, device),
        targets=len(own),
        table=table,
    )


@lru_cache(maxsize=4)
def torch_hand(gripper: Gripper, device: str) -> Hand:
    """Samples, fields and outlines of the preshapes that the card asks for, which come first, uploaded once per gripper
    and device, and kept."""
    preshapes = [gripper.preshapes[i] for i in asked_for(gripper)]
    pivots = [preshape.tool_centre_point for preshape in preshapes]
    samples = [p.samples.points - p.tool_centre_point for p in preshapes]
    outline = padded([p.outline - p.tool_centre_point for p in preshapes], np.nan)
    return Hand(
        count=np.array([len(part) for part in samples]),
        pivots=np.array(pivots),
        samples=tensor(padded(samples, 0.0), device),
        weights=tensor(padded([p.weights for p in preshapes], 0.0), device),
        inverse_inertia=tensor(
            [inverse_inertia(s, p.weights) for s, p in zip(samples, preshapes, strict=True)], device
        ),
        distance=tensor(padded([p.hand.values for p in preshapes], FAR), device),
        nearest_sample=torch.as_tensor(padded([p.nearest_sample for p in preshapes], 0), device=device).long(),
        origin=tensor([p.hand.origin - p.tool_centre_point for p in preshapes], device),
        spacing=preshapes[0].hand.spacing,
        outline=tensor(np.nan_to_num(outline), device),
        is_outline=torch.as_tensor(~np.isnan(outline[..., 0]), device=device),
    )


def tensor(values: np.ndarray | Sequence[np.ndarray], device: str) -> Tensor:
    """Single precision on the device."""
    return torch.as_tensor(np.array(values), dtype=torch.float32, device=device)


def padded(parts: Sequence[np.ndarray], value: float) -> np.ndarray:
    """Arrays of different shapes as one, filled up at their ends."""
    shape = np.max([part.shape for part in parts], axis=0)
    result = np.full((len(parts), *shape), value, dtype=parts[0].dtype)
    for row, part in zip(result, parts, strict=True):
        row[tuple(slice(size) for size in part.shape)] = part
    return result


def poses_of(candidates: Candidates, problem: Problem) -> Poses:
    """Candidates in the world as poses of their pivots in the object frame."""
    rotation = candidates.T_world_gripper[:, :3, :3]
    lever = np.einsum("nij,nj->ni", rotation, problem.hand.pivots[candidates.preshape])
    position = candidates.T_world_gripper[:, :3, 3] + lever - problem.centre_of_mass
    device = str(problem.target.device)
    return Poses(tensor(position, device), tensor(quaternion_from_matrix(rotation), device))


def shortened(v: Float[Tensor, "*b 3"], most: float) -> Float[Tensor, "*b 3"]:
    """The vectors, no longer than `most`."""
    return v * (most / v.norm(dim=-1, keepdim=True).clamp(min=1e-9)).clamp(max=1.0)


def multiply(a: Float[Tensor, "*#b 4"], b: Float[Tensor, "*#b 4"]) -> Float[Tensor, "*b 4"]:
    """Hamilton product."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a.unbind(-1), b.unbind(-1)
    w, x = aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by
    y, z = aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw
    return torch.stack([w, x, y, z], dim=-1)


def conjugate(q: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """The inverse of a unit quaternion."""
    return torch.cat([q[..., :1], -q[..., 1:]], dim=-1)


def rotation_matrix(q: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """R(q)."""
    w, x, y, z = q.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
