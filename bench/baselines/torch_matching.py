"""The paper's matching in plain PyTorch: Algorithm 1 on batched tensors, with brute force for the nearest neighbours.

No kernels and no nearest-neighbour field, else the same choices as `graspmatch.planner.match` (see docs/method.md), the
same starts and the same mini-batches, so that time and loss can be compared. Frames and axes as in `torch_problem`.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from importlib.metadata import version

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from baselines.torch_problem import (
    Hand,
    Poses,
    Problem,
    conjugate,
    multiply,
    poses_of,
    rotation_matrix,
    shortened,
    torch_prepare,
)
from graspmatch.config import MatchingConfig, PlannerConfig
from graspmatch.geometry.se3 import from_parts
from graspmatch.kernels.launch import resolve_device, thread_count
from graspmatch.planner.avoid import keep_free, upload_space
from graspmatch.planner.candidates import Candidates, Matched
from graspmatch.planner.close import close_fingers
from graspmatch.planner.grade import draw_trials, foremost, grade, stopped
from graspmatch.planner.hold import touchable
from graspmatch.planner.match import annealing, batch_share, full_batch_from, mini_batch, stein_phase
from graspmatch.planner.plan import grasp_set
from graspmatch.planner.rank import rank
from graspmatch.planner.seed import seed_poses
from graspmatch.planner.stopwatch import Stopwatch
from graspmatch.planner.tally import Tally
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, GraspSet, Gripper, Provenance

CHUNK = {"cpu": 512, "cuda": 65536}
"""Queries that brute force compares with the whole target at a time, so few on a CPU that the distances stay in its
cache: twice as fast as a few thousand."""


def torch_plan(scene: Scene, gripper: Gripper, seed: int, *, device: str = "cpu") -> GraspSet:
    """`graspmatch.planner.plan.plan` with the defaults, but without opening and refining; matching and its loss by
    PyTorch, on as many threads."""
    config, device = PlannerConfig(seed=seed, device=device), resolve_device(device)
    torch.set_num_threads(thread_count())
    rng = np.random.default_rng(seed)
    watch = Stopwatch()
    starts = seed_poses(scene, gripper, config.seeding, rng)
    tally = Tally(len(starts))
    problem = torch_prepare(scene, gripper, config.matching, rng, device)
    space = upload_space(scene, gripper, device)
    watch.lap("prepare")
    matched = torch_match(starts, problem, config.matching, rng)
    watch.lap("match")
    free = keep_free(matched, space, config.collision, tally)
    watch.lap("avoid")
    closed = close_fingers(free, space, config.closing, tally)
    watch.lap("close")
    target = touchable(scene, config.grip.points, device)
    count = max(config.grip.finalists, config.ranking.count)
    trials = draw_trials(config.grip, seed)
    closed = foremost(closed, count, trials, space, target, config.grip, tally)
    final = Candidates(closed.matched_preshape, closed.T_world_gripper)
    error, loss = torch_measure(final, problem, config.matching)
    graded = grade(closed, error, loss, trials, space, target, config.grip)
    watch.lap("grade")
    order = rank(graded, graded.sureness, config.ranking, tally, "ranked lower than asked for")
    graded = stopped(graded.select(order), target, gripper, config.grip, device)
    watch.lap("rank")
    provenance = Provenance(
        gripper=gripper.name,
        gripper_hash=gripper.content_hash,
        config=json.dumps({"baseline": "torch", **asdict(config)}),
        seed=seed,
        device=device,
        version=version("graspmatch"),
        source=scene.source,
        seconds=watch.seconds,
    )
    return grasp_set(graded, scene, gripper, tally, provenance)


@dataclass(frozen=True)
class Found:
    """What one pass over all particles finds: A g by position and by rotation vector, and the loss."""

    by_position: Float[Tensor, "p k 3"]
    by_rotation: Float[Tensor, "p k 3"]
    matching_error: Float[Tensor, "p k"]
    """Eq. (14) [m2]."""
    loss: Float[Tensor, "p k"]
    """Eq. (13) [m2]."""
    is_free: Bool[Tensor, "p k"]


def torch_match(starts: Candidates, problem: Problem, config: MatchingConfig, rng: np.random.Generator) -> Matched:
    """Algorithm 1: every start, matched to the target. Each preshape must have as many starts as the others."""
    if config.method == "icp":
        raise GraspmatchError("The torch version has the methods 'sgd-icp', 'stein-icp' and 'annealed-stein-icp'.")
    seeds = grouped(starts, problem)
    poses = best = seeds
    loss = torch.zeros_like(seeds.position[..., 0])
    lowest, is_converged = torch.full_like(loss, torch.inf), torch.zeros_like(loss, dtype=torch.bool)
    for k in range(1, config.iterations + 1):
        found = gradients(poses, problem, *draw_batch(problem, batch_share(k, config), config, rng), config)
        if k <= stein_phase(config):
            poses = stein_step(poses, seeds, found, problem.hand, annealing(k, config), config)  # eqs. (7), (8)
        else:
            if k >= full_batch_from(config):
                is_better = found.is_free & (found.loss < lowest)
                best, lowest = poses.where(is_better, best), torch.where(is_better, found.loss, lowest)
                is_converged |= found.is_free & ((loss - found.loss).abs() <= config.convergence * loss)
            eta = config.learning_rate
            poses = poses.where(is_converged, poses.moved(-eta * found.by_position, -eta * found.by_rotation))  # (3)
        loss = found.loss
    whole = problem.target, *whole_hand(problem.hand)
    last = gradients(poses, problem, *whole, config)
    has_best = torch.isfinite(lowest) & ~(last.is_free & (last.loss < lowest))
    answer = best.where(has_best, poses)
    return in_world(answer, gradients(answer, problem, *whole, config), starts, problem)


def torch_measure(
    candidates: Candidates, problem: Problem, config: MatchingConfig
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Matching error (14) and loss (13) of poses as they are [m2]."""
    poses, hand = poses_of(candidates, problem), problem.hand
    preshape = torch.as_tensor(candidates.preshape, device=hand.samples.device)
    samples, weights = hand.samples[preshape], hand.weights[preshape]
    error, _, _ = matching(poses, rotation_matrix(poses.rotation), samples, weights, problem.target)
    loss = error + config.com_weight * poses.position.square().sum(-1)
    return error.double().cpu().numpy(), loss.double().cpu().numpy()


def gradients(
    poses: Poses,
    problem: Problem,
    target: Float[Tensor, "r 3"],
    samples: Float[Tensor, "p m 3"],
    weights: Float[Tensor, "p m"],
    config: MatchingConfig,
) -> Found:
    """Eqs. (16), (17), or (18) where the hand collides, times A: the inverse of the Gauss-Newton matrix."""
    R = rotation_matrix(poses.rotation)
    error, by_t, by_w = matching(poses, R, samples[:, None], weights[:, None], target)
    loss = error + config.com_weight * poses.position.square().sum(-1)  # eqs. (13), (15): the CoM is the origin
    com_weight = torch.full_like(weights[:, :1, None], config.com_weight)
    if config.com_gradient == "paper":  # one pair among all those that were summed
        com_weight = com_weight / torch.count_nonzero(weights, dim=1)[:, None, None]
    by_t = (by_t + com_weight * poses.position) / (1 + com_weight)  # poses turn about the TCP: (17) has no CoM term
    collision_by_t, collision_by_w, colliding = collisions(poses, R, problem)
    is_free = colliding == 0
    return Found(
        by_position=torch.where(is_free[..., None], by_t, collision_by_t),
        by_rotation=turned(problem.hand, R, torch.where(is_free[..., None], by_w, collision_by_w)),
        matching_error=error,
        loss=loss,
        is_free=is_free,
    )


def matching(
    poses: Poses,
    R: Float[Tensor, "*b 3 3"],
    samples: Float[Tensor, "*#b m 3"],
    weights: Float[Tensor, "*#b m"],
    target: Float[Tensor, "r 3"],
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """Eqs. (1), (14), (4) and (5): error, and gradients by position and by rotation vector, over weighted samples."""
    lever = samples @ R.mT
    moved = lever + poses.position[..., None, :]
    is_sample = (weights > 0).expand(moved.shape[:-1])
    residual = torch.zeros_like(moved)
    residual[is_sample] = moved[is_sample] - nearest(moved[is_sample], target)
    weight = (weights / weights.sum(dim=-1, keepdim=True))[..., None]
    error = (weight * residual.square()).sum(dim=(-2, -1))
    return error, (weight * residual).sum(dim=-2), (weight * torch.linalg.cross(lever, residual)).sum(dim=-2)


def nearest(points: Float[Tensor, "n 3"], target: Float[Tensor, "r 3"]) -> Float[Tensor, "n 3"]:
    """Eq. (1) by brute force: the nearest target point r has the largest x . r - |r|^2 / 2, a matrix product.

    `torch.cdist` says the same and takes twice as long, for the roots.
    """
    offset, chunks = -0.5 * target.square().sum(-1), points.split(CHUNK[points.device.type])
    return torch.cat([target[torch.addmm(offset, x, target.T).max(dim=-1).indices] for x in chunks])


def collisions(
    poses: Poses, R: Float[Tensor, "p k 3 3"], problem: Problem
) -> tuple[Float[Tensor, "p k 3"], Float[Tensor, "p k 3"], Int[Tensor, "p k"]]:
    """Eqs. (12) and (18): mean gradients of what is inside the hand, and how much is."""
    by_t, by_w, colliding = point_collisions(poses, R, problem)
    if problem.table is not None:  # lifts the corners that are below it
        normal, offset = problem.table
        lever = problem.hand.outline[:, None] @ R.mT
        height = (lever + poses.position[:, :, None]) @ normal - offset
        is_below = (height < 0) & problem.hand.is_outline[:, None]
        residual = torch.where(is_below, height, 0.0)[..., None] * normal
        by_t, by_w = by_t + residual.sum(dim=2), by_w + torch.linalg.cross(lever, residual).sum(dim=2)
        colliding = colliding + is_below.sum(dim=-1)
    count = colliding.clamp(min=1)[..., None]
    return by_t / count, by_w / count, colliding


def point_collisions(
    poses: Poses, R: Float[Tensor, "p k 3 3"], problem: Problem
) -> tuple[Float[Tensor, "p k 3"], Float[Tensor, "p k 3"], Int[Tensor, "p k"]]:
    """Sums of the gradients of all points of C inside the hand: the inner surface is pulled to points of the target,
    the nearest surface of the hand to those of obstacles."""
    hand, scene = problem.hand, problem.surroundings
    in_hand = (scene - poses.position[:, :, None]) @ R
    nodes = (in_hand - hand.origin[:, None, None]) / hand.spacing
    limit = torch.tensor(hand.distance.shape[1:], device=nodes.device) - 1
    p, k, c = ((nodes >= 0) & (nodes <= limit)).all(dim=-1).nonzero(as_tuple=True)
    x = in_hand[p, k, c]
    depth = -interpolate(hand, p, x)
    p, k, c, x, depth = (part[depth > 0] for part in (p, k, c, x, depth))
    node = ((x - hand.origin[p]) / hand.spacing + 0.5).long()
    inner = hand.samples[p, hand.nearest_sample[p, node[:, 0], node[:, 1], node[:, 2]]]
    outer = x + depth[:, None] * outwards(hand, p, x)
    lever = torch.einsum("nij,nj->ni", R[p, k], torch.where((c < problem.targets)[:, None], inner, outer))
    residual = lever + poses.position[p, k] - scene[c]
    parts = torch.cat([residual, torch.linalg.cross(lever, residual), torch.ones_like(residual[:, :1])], dim=-1)
    size = poses.position.shape[:2]
    sums = parts.new_zeros(size[0] * size[1], 7).index_add_(0, p * size[1] + k, parts).reshape(*size, 7)
    return sums[..., :3], sums[..., 3:6], sums[..., 6].long()


def interpolate(hand: Hand, p: Int[Tensor, "n"], x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Trilinear distance to the hand [m] of points in the frames of their preshapes."""
    limit = torch.tensor(hand.distance.shape[1:], device=x.device) - 1
    u = ((x - hand.origin[p]) / hand.spacing).clamp(min=0).minimum(limit)
    low = u.long().minimum(limit - 1)
    f = u - low
    result = torch.zeros_like(f[:, 0])
    for corner in np.ndindex(2, 2, 2):
        up = torch.tensor(corner, device=x.device)
        i, j, k = (low + up).unbind(-1)
        result += torch.where(up > 0, f, 1 - f).prod(dim=-1) * hand.distance[p, i, j, k]
    return result


def outwards(hand: Hand, p: Int[Tensor, "n"], x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Direction in which the distance to the hand grows."""
    steps = 0.5 * hand.spacing * torch.eye(3, device=x.device)
    slopes = [interpolate(hand, p, x + step) - interpolate(hand, p, x - step) for step in steps]
    return torch.nn.functional.normalize(torch.stack(slopes, dim=-1), dim=-1)


def stein_step(poses: Poses, seeds: Poses, found: Found, hand: Hand, gamma: float, config: MatchingConfig) -> Poses:
    """Eqs. (7) and (8) times A/N, over the kernel's mass, among the particles of each preshape."""
    t, q = poses.position, poses.rotation
    apart = t[:, :, None] - t[:, None]  # of particle i from j, at p i j
    square = apart.square().sum(-1)
    h = (square.mean(dim=(1, 2), keepdim=True) / np.log(t.shape[1] + 1)).clamp(min=1e-8)
    k_t = torch.exp(-square / h)  # eq. (9)
    k = k_t * (q @ q.mT).abs()  # eq. (10)
    away_t = 2 / h * torch.einsum("pij,pijx->pix", k, apart)
    away_w = torch.einsum("pij,pijx->pix", k_t, kernel_slope(q[:, None], q[:, :, None]))
    prior_t = (t - seeds.position) / config.prior_translation**2  # gradients of the negative log priors
    between = multiply(q, conjugate(seeds.rotation))
    prior_w = config.prior_concentration * 2 * between[..., :1] * between[..., 1:]
    R, n = rotation_matrix(q), torch.as_tensor(hand.count, device=t.device)[:, None, None]
    inverse_t = 1 / (1 + config.com_weight) if config.com_gradient == "loss" else 1.0
    drift_t = found.by_position + inverse_t * prior_t / n
    drift_w = found.by_rotation + turned(hand, R, prior_w) / n
    mass = k.sum(dim=-1, keepdim=True)
    move = (-gamma * k @ drift_t + config.repulsion * inverse_t * away_t / n) / mass
    spin = (-gamma * k @ drift_w + config.repulsion * turned(hand, R, away_w) / n) / mass
    return poses.moved(shortened(config.learning_rate * move, config.longest_step), config.learning_rate * spin)


def kernel_slope(a: Float[Tensor, "*#b 4"], b: Float[Tensor, "*#b 4"]) -> Float[Tensor, "*b 3"]:
    """Gradient of |a . b| (10) along the sphere by a, as the rotation vector that it turns b by."""
    between = multiply(b, conjugate(a))
    return 0.5 * between[..., :1].sign() * between[..., 1:]


def turned(hand: Hand, R: Float[Tensor, "p k 3 3"], w: Float[Tensor, "p k 3"]) -> Float[Tensor, "p k 3"]:
    """The rotational block of A, applied to gradients in the object frame."""
    return (R @ (hand.inverse_inertia[:, None] @ (R.mT @ w[..., None])))[..., 0]


def draw_batch(
    problem: Problem, share: float, config: MatchingConfig, rng: np.random.Generator
) -> tuple[Float[Tensor, "r 3"], Float[Tensor, "p m 3"], Float[Tensor, "p m"]]:
    """Target, samples and weights of one iteration: a share of S, or of R as Algorithm 1 prints it."""
    hand = problem.hand
    if config.batch_from == "object":
        size = max(int(np.ceil(share * len(problem.target))), 1)
        return problem.target[rng.permutation(len(problem.target))[:size]], *whole_hand(hand)
    offset, size = mini_batch(hand.count, share, rng)
    window = np.zeros((len(size), size.max()), dtype=int)
    for row, order, first, width in zip(window, problem.shuffled, offset, size, strict=True):
        row[:width] = order[(first + np.arange(width)) % len(order)]
    at = torch.as_tensor(window, device=hand.samples.device)
    is_drawn = torch.as_tensor(np.arange(size.max()) < size[:, None], device=at.device)
    return problem.target, hand.samples.take_along_dim(at[..., None], 1), hand.weights.take_along_dim(at, 1) * is_drawn


def whole_hand(hand: Hand) -> tuple[Float[Tensor, "p m 3"], Float[Tensor, "p m"]]:
    """All samples and their weights."""
    return hand.samples, hand.weights


def grouped(starts: Candidates, problem: Problem) -> Poses:
    """The starts as poses p k, of every preshape the same number, one preshape after the other."""
    preshapes = len(problem.hand.count)
    if not np.array_equal(starts.preshape, np.repeat(np.arange(preshapes), len(starts) // preshapes)):
        raise GraspmatchError("The torch version needs the same number of starts for every preshape, sorted by it.")
    return poses_of(starts, problem).reshape(preshapes, -1)


def in_world(poses: Poses, found: Found, starts: Candidates, problem: Problem) -> Matched:
    """Poses of the pivots in the object frame as those of the gripper in the world."""
    position, rotation, error, loss = (
        part.flatten(0, 1).double().cpu().numpy()
        for part in (poses.position, rotation_matrix(poses.rotation), found.matching_error, found.loss)
    )
    lever = np.einsum("nij,nj->ni", rotation, problem.hand.pivots[starts.preshape])
    return Matched(
        preshape=starts.preshape,
        T_world_gripper=from_parts(rotation, position + problem.centre_of_mass - lever),
        matching_error=error,
        loss=loss,
        is_free=found.is_free.flatten().cpu().numpy(),
    )
