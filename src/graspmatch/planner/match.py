"""Parallel shape matching: Algorithm 1 of the paper, all particles of all preshapes at once.

Where the paper leaves a choice, `docs/method.md` says which was taken and why. Poses are optimised in the object frame:
world axes, origin at the centre of mass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from graspmatch.config import MatchingConfig
from graspmatch.geometry import se3
from graspmatch.geometry.cloud import extent, voxel_downsample
from graspmatch.geometry.thin import thinned
from graspmatch.kernels import warp_collide, warp_match, warp_stein, warp_steps
from graspmatch.kernels.fields import BlockCloud, covering_nearest_field, in_block_order, upload_blocks
from graspmatch.kernels.launch import download, launch, upload
from graspmatch.kernels.warp_blocks import LANES
from graspmatch.kernels.warp_fields import NearestField
from graspmatch.planner.candidates import Candidates, Matched
from graspmatch.planner.recording import Recording
from graspmatch.planner.upload import DeviceHand, upload_gripper
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper

FIELD_MARGIN = 0.03
"""How far the nearest-neighbour field reaches beyond the target [m]; farther samples use its border."""
FIELD_NODES = 96
"""At most so many nodes along one axis: larger objects are thinned more."""
FEWEST_VOXELS = 10
"""At least so many voxels along the longest side: smaller objects are thinned less."""


@dataclass(frozen=True)
class Draws:
    """The mini-batches of k iterations."""

    offset: wp.array
    """First sample of each preshape's mini-batch, a window of its shuffled samples, of k times p preshapes ..."""
    size: wp.array
    """... and number of samples."""
    parts: tuple[Float[np.ndarray, "_ 3"], ...] = ()
    """Those of the target; none where it is always the whole."""

    def target(self, k: int, problem: Problem) -> NearestField:
        """That of one iteration."""
        if not self.parts:
            return problem.target
        return covering_nearest_field(self.parts[k], problem.spacing, FIELD_MARGIN, problem.device)


@dataclass(frozen=True)
class Problem:
    """Scene and hand on the device: everything that stays the same from iteration to iteration."""

    hand: DeviceHand
    samples: wp.array
    """For each preshape those that have weight in random order, then the others: a window of the first is a mini-batch.
    All x, y, z and weights."""
    centre_of_mass: Float[np.ndarray, "3"]
    """Origin of the object frame in the world [m]."""
    target_points: Float[np.ndarray, "n 3"]
    """R, in the object frame [m]."""
    spacing: float
    """Of R and of its nearest-neighbour field [m]."""
    target: NearestField
    surroundings: warp_collide.Surroundings
    """C, in the object frame ..."""
    cloud: BlockCloud
    """... and its points."""
    terms: warp_match.Terms
    whole: Draws
    """All samples and the whole target."""
    device: str


def prepare(scene: Scene, gripper: Gripper, config: MatchingConfig, rng: np.random.Generator, device: str) -> Problem:
    """Thin the clouds, build the nearest-neighbour field, upload the hand."""
    points = scene.target.points - scene.centre_of_mass
    spacing = target_spacing(points, config.voxel_size)
    target_points, _ = voxel_downsample(points, spacing, origin=np.zeros(3))
    hand = upload_gripper(gripper, device)
    shuffled = np.arange(hand.rows.shape[1])
    for n, start in zip(hand.samples, hand.starts, strict=True):
        shuffled[start : start + n] = start + rng.permutation(n)
    own, others = (thinned(cloud.points, config.collision_points) for cloud in (scene.target, scene.obstacles))
    cloud = upload_blocks([in_block_order(part - scene.centre_of_mass) for part in (own, others)], device)
    return Problem(
        hand=hand,
        samples=upload(hand.rows[:, shuffled].ravel(), wp.float32, device),
        centre_of_mass=scene.centre_of_mass,
        target_points=target_points,
        spacing=spacing,
        target=covering_nearest_field(target_points, spacing, FIELD_MARGIN, device),
        surroundings=surroundings_of(scene, cloud),
        cloud=cloud,
        terms=terms_of(config),
        whole=uploaded_draws(*whole_batch(hand.samples), device),
        device=device,
    )


def match(
    starts: Candidates,
    problem: Problem,
    config: MatchingConfig,
    rng: np.random.Generator,
    recording: Recording | None = None,
) -> Matched:
    """Algorithm 1: every start, matched to the target."""
    particles = upload_particles(starts, problem)

    def show() -> None:
        if recording:
            recording.watch(in_world(particles, starts, problem))

    if recording:
        recording.start()
    show()
    stein_iterations = min(stein_phase(config), config.iterations)
    draws = draw(problem, config, rng)
    watch = show if recording else None
    stein(problem, particles, groups_of(starts, particles, problem), draws, stein_iterations, config, watch)
    descend(problem, particles, draws, stein_iterations, config, watch)  # eq. (3)
    gradients(problem, particles, problem.whole, want_loss=True)
    launch(warp_steps.take_best, len(starts), [particles], [], problem.device)
    show()
    return Matched(
        **vars(in_world(particles, starts, problem)),
        matching_error=download(particles.matching_error).astype(float),
        loss=download(particles.loss).astype(float),
        is_free=download(particles.colliding) == 0,
    )


def in_world(particles: warp_match.Particles, starts: Candidates, problem: Problem) -> Candidates:
    """The particles where they are, in the world."""
    rotation = se3.matrix_from_quaternion(np.roll(download(particles.rotation).astype(float), 1, axis=-1))
    position = download(particles.position).astype(float) + problem.centre_of_mass
    lever = np.einsum("nij,nj->ni", rotation, problem.hand.pivots[starts.preshape])
    return Candidates(starts.preshape, se3.from_parts(rotation, position - lever))


def measure(candidates: Candidates, problem: Problem) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Matching error (14) and loss (13) of poses as they are [m2]: after matching, many were backed off."""
    particles = particles_at(candidates, problem)
    gradients(problem, particles, problem.whole, want_loss=True)
    return download(particles.matching_error).astype(float), download(particles.loss).astype(float)


def stein_phase(config: MatchingConfig) -> int:
    """k_stein, or zero for the methods without particles that know of each other."""
    return config.stein_iterations if config.method in ("stein-icp", "annealed-stein-icp") else 0


def annealing(k: int, config: MatchingConfig) -> float:
    """gamma(k), eq. (11) with Table I; one without annealing."""
    if config.method != "annealed-stein-icp":
        return 1.0
    cycle = config.iterations / config.annealing_cycles
    return float((k % cycle) / cycle) ** config.annealing_exponent


def batch_share(k: int, config: MatchingConfig) -> float:
    """Size of the mini-batch, as a share of the whole: it grows over two thirds of the iterations (Table I)."""
    ramp = full_batch_from(config)
    return min(k, ramp) / ramp if config.method != "icp" else 1.0


def full_batch_from(config: MatchingConfig) -> float:
    """Iteration from which on the mini-batch is the whole, and a particle's best free pose is remembered."""
    return 2 * config.iterations / 3


def draw(problem: Problem, config: MatchingConfig, rng: np.random.Generator) -> Draws:
    """The mini-batches of all iterations: of S, or of R as Algorithm 1 prints it."""
    shares = np.array([batch_share(k, config) for k in range(1, config.iterations + 1)])
    if config.batch_from == "gripper":
        return uploaded_draws(*mini_batch(problem.hand.samples, shares, rng), problem.device)
    offset, size = (np.tile(part, (len(shares), 1)) for part in whole_batch(problem.hand.samples))
    parts = tuple(object_batch(problem.target_points, share, rng) for share in shares)
    return replace(uploaded_draws(offset, size, problem.device), parts=parts)


def uploaded_draws(offset: Int[np.ndarray, "*k p"], size: Int[np.ndarray, "*k p"], device: str) -> Draws:
    """Windows of the samples, and the whole target."""
    return Draws(upload(offset.ravel(), wp.int32, device), upload(size.ravel(), wp.int32, device))


def mini_batch(
    samples: Int[np.ndarray, "p"], shares: Float[np.ndarray, "*k"] | float, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "*k p"], Int[np.ndarray, "*k p"]]:
    """Random windows of every preshape's samples: where each begins, and how long it is."""
    offset = rng.integers(samples, size=(*np.shape(shares), len(samples)))
    return offset, np.ceil(np.multiply.outer(shares, samples)).astype(int)


def whole_batch(samples: Int[np.ndarray, "p"]) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    """All samples of every preshape."""
    return np.zeros_like(samples), samples


def object_batch(points: Float[np.ndarray, "n 3"], share: float, rng: np.random.Generator) -> Float[np.ndarray, "m 3"]:
    """A random subset of R, at least one point."""
    return points[rng.permutation(len(points))[: max(int(np.ceil(share * len(points))), 1)]]


def gradients(
    problem: Problem,
    particles: warp_match.Particles,
    draws: Draws,
    k: int = 0,
    *,
    want_loss: bool = False,
) -> None:
    """One pass of eqs. (16)-(18), with the k-th of the mini-batches; `want_loss` is for the loss of those that collide,
    too."""
    inputs = [*slope_inputs(problem, draws, k), int(want_loss), particles]
    launch(warp_steps.gradients, particles.preshape.shape[0], inputs, [], problem.device, lanes=LANES)


def descend(
    problem: Problem,
    particles: warp_match.Particles,
    draws: Draws,
    first: int,
    config: MatchingConfig,
    show: Callable[[], object] | None = None,
) -> None:
    """The iterations from a first one on, in which every particle goes its own way: one launch, but where each has
    another target or is shown."""
    settle_from = int(np.ceil(full_batch_from(config))) - 1
    for run in runs_of(range(first, config.iterations), draws, show):
        counts = [len(run), settle_from - run.start, int(config.method == "icp")]
        inputs = [*slope_inputs(problem, draws, run.start), *counts, particles]
        launch(warp_steps.descend, particles.preshape.shape[0], inputs, [], problem.device, lanes=LANES)
        if show:
            show()


def slope_inputs(problem: Problem, draws: Draws, k: int) -> list:
    """What the kernels take to find the gradients of the loss, from the k-th mini-batch on."""
    hand, target = problem.hand, draws.target(k, problem)
    goals = [target, target.index, target.coordinates]
    scene = [problem.surroundings, problem.cloud.points, problem.cloud.balls, hand.outline, hand.matching_levels]
    return [hand.matching, problem.samples, *goals, *scene, problem.terms, draws.offset, draws.size, k]


@dataclass
class Groups:
    """Particles by preshape, which see each other in the Stein phase: where those of each begin and how many they are,
    and where all of them go next."""

    begin: wp.array
    count: wp.array
    position: wp.array
    rotation: wp.array


def groups_of(starts: Candidates, particles: warp_match.Particles, problem: Problem) -> Groups:
    """Of particles in the order of their preshapes."""
    preshapes = np.arange(len(problem.hand.samples))
    begin, end = (np.searchsorted(starts.preshape, preshapes, side) for side in ("left", "right"))
    return Groups(
        begin=upload(begin, wp.int32, problem.device),
        count=upload(end - begin, wp.int32, problem.device),
        position=wp.clone(particles.position),
        rotation=wp.clone(particles.rotation),
    )


def stein(
    problem: Problem,
    particles: warp_match.Particles,
    groups: Groups,
    draws: Draws,
    iterations: int,
    config: MatchingConfig,
    show: Callable[[], object] | None = None,
) -> None:
    """The Stein phase: SVGD updates of all particles, each with the others of its preshape."""
    gamma = upload([annealing(k, config) for k in range(1, iterations + 1)], wp.float32, problem.device)
    for run in runs_of(range(iterations), draws, show):
        inputs = [*slope_inputs(problem, draws, run.start), len(run), gamma, groups.begin, groups.count, particles]
        outputs = [groups.position, groups.rotation]
        n, rounds = particles.preshape.shape[0], 2 * len(run) + 1
        launch(warp_stein.stein, n, inputs, outputs, problem.device, lanes=LANES, rounds=rounds)
        if show:
            show()


def runs_of(iterations: range, draws: Draws, show: Callable[[], object] | None) -> list[range]:
    """What of some iterations one launch can do: all, but where each has another target or is shown."""
    if draws.parts or show:
        return [range(k, k + 1) for k in iterations]
    return [iterations] if iterations else []


def target_spacing(points: Float[np.ndarray, "n 3"], voxel_size: float) -> float:
    """Spacing of R [m]: finer for objects of few voxels, coarser for those whose field would need too many nodes."""
    longest = extent(points)
    return max(min(voxel_size, longest / FEWEST_VOXELS), (longest + 2 * FIELD_MARGIN) / FIELD_NODES)


def surroundings_of(scene: Scene, cloud: BlockCloud) -> warp_collide.Surroundings:
    """C, but for its points: the table is the plane that it is."""
    surroundings = warp_collide.Surroundings()
    surroundings.blocks = cloud.blocks
    surroundings.target_blocks = cloud.ends[0]
    surroundings.has_table = int(scene.table is not None)
    if scene.table is not None:
        surroundings.normal = wp.vec3(*scene.table.normal)
        surroundings.offset = scene.table.offset - float(scene.table.normal @ scene.centre_of_mass)
    return surroundings


def terms_of(config: MatchingConfig) -> warp_match.Terms:
    """The weights of the loss; the centre of mass is the origin of the object frame."""
    terms = warp_match.Terms()
    terms.com = wp.vec3(0.0, 0.0, 0.0)
    terms.com_weight = config.com_weight
    terms.com_gradient_weight = config.com_weight * (1.0 if config.com_gradient == "loss" else -1.0)
    terms.repulsion = config.repulsion
    terms.prior_precision = config.prior_translation**-2
    terms.prior_concentration = config.prior_concentration
    terms.learning_rate = config.learning_rate
    terms.convergence = config.convergence
    terms.longest_step = config.longest_step
    return terms


def particles_at(candidates: Candidates, problem: Problem) -> warp_match.Particles:
    """The pivots' poses in the object frame, and room for the gradients there."""
    n, device = len(candidates), problem.device
    turn = candidates.T_world_gripper[:, :3, :3]
    pivot = np.einsum("nij,nj->ni", turn, problem.hand.pivots[candidates.preshape])
    place = candidates.T_world_gripper[:, :3, 3] - problem.centre_of_mass + pivot
    particles = warp_match.Particles()
    particles.preshape = upload(candidates.preshape, wp.int32, device)
    particles.position = upload(place, wp.vec3, device)
    particles.rotation = upload(np.roll(se3.quaternion_from_matrix(turn), -1, axis=-1), wp.quat, device)
    particles.gradient_position = wp.empty(n, dtype=wp.vec3, device=device)
    particles.gradient_rotation = wp.empty(n, dtype=wp.vec3, device=device)
    particles.matching_error = wp.empty(n, dtype=wp.float32, device=device)
    particles.loss = upload(np.full(n, warp_match.NONE), wp.float32, device)
    particles.colliding = wp.empty(n, dtype=wp.int32, device=device)
    return particles


def upload_particles(starts: Candidates, problem: Problem) -> warp_match.Particles:
    """The same, with room for all that the kernels find on their way from there."""
    n, device = len(starts), problem.device
    particles = particles_at(starts, problem)
    particles.seed_position = wp.clone(particles.position)
    particles.seed_rotation = wp.clone(particles.rotation)
    particles.is_converged = wp.zeros(n, dtype=wp.int32, device=device)
    particles.best_loss = wp.full(n, warp_match.NONE, dtype=wp.float32, device=device)
    particles.best_error = wp.zeros(n, dtype=wp.float32, device=device)
    particles.best_position = wp.clone(particles.position)
    particles.best_rotation = wp.clone(particles.rotation)
    return particles
