"""The plain PyTorch version of the matching: against the NumPy reference, and against the planner it stands beside."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from graspmatch.config import MatchingConfig, SeedingConfig
from graspmatch.geometry import grid as grids
from graspmatch.geometry import se3
from graspmatch.geometry.grid import Grid
from graspmatch.kernels import reference
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.match import match, measure, prepare
from graspmatch.planner.seed import seed_poses
from graspmatch.planner.upload import inverse_inertia
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import mug
from graspmatch.types import GraspmatchError

torch = pytest.importorskip("torch", reason="the comparison needs PyTorch, which graspmatch itself does not")

from baselines import torch_matching, torch_problem  # noqa: E402

HALF = np.array([0.015, 0.03, 0.01])
CORNERS = np.array(list(np.ndindex(2, 2, 2))) * 2 * HALF - HALF
PRESHAPES, PARTICLES = 2, 4


def box_distance(points):
    """Signed distance of the box of half lengths `HALF` [m]."""
    q = np.abs(points) - HALF
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def tensor(values):
    """Single precision on the CPU."""
    return torch_problem.tensor(values, "cpu")


class Small:
    """Two preshapes of different numbers of samples in a box-shaped hand, a target, and particles."""

    def __init__(self, rng):
        self.samples = [rng.normal(size=(size, 3)) * 0.03 for size in (40, 29)]
        self.target = rng.normal(size=(60, 3)) * 0.05
        self.t = rng.normal(size=(PRESHAPES, PARTICLES, 3)) * 0.03
        self.q = se3.random_quaternions(PRESHAPES * PARTICLES, rng).reshape(PRESHAPES, PARTICLES, 4)
        self.R = se3.matrix_from_quaternion(self.q)
        origin, shape = grids.covering(np.full(3, -0.06), np.full(3, 0.06), 0.002)
        nodes = grids.node_positions(origin, 0.002, shape)
        self.distance = Grid(origin, 0.002, box_distance(nodes).reshape(shape))
        self.nearest = [KDTree(s).query(nodes)[1].reshape(shape) for s in self.samples]
        self.inverse = [inverse_inertia(s, np.ones(len(s))) for s in self.samples]

    def problem(self, surroundings=((9.0, 9.0, 9.0),), targets=None, table=None):
        padded = torch_problem.padded
        hand = torch_problem.Hand(
            count=np.array([len(s) for s in self.samples]),
            pivots=np.zeros((2, 3)),
            samples=tensor(padded(self.samples, 0.0)),
            weights=tensor(padded([np.ones(len(s)) for s in self.samples], 0.0)),
            inverse_inertia=tensor(self.inverse),
            distance=tensor([self.distance.values] * 2),
            nearest_sample=torch.as_tensor(np.array(self.nearest)),
            origin=tensor([self.distance.origin] * 2),
            spacing=self.distance.spacing,
            outline=tensor([CORNERS] * 2),
            is_outline=torch.ones(2, 8, dtype=torch.bool),
        )
        return torch_problem.Problem(
            hand=hand,
            shuffled=tuple(np.random.default_rng(0).permutation(count) for count in hand.count),
            centre_of_mass=np.zeros(3),
            target=tensor(self.target),
            surroundings=tensor(surroundings),
            targets=len(surroundings) if targets is None else targets,
            table=table and (tensor(table[0]), table[1]),
        )

    def poses(self):
        return torch_problem.Poses(tensor(self.t), tensor(self.q))

    def gradients(self, problem, config=None):
        hand = torch_matching.whole_hand(problem.hand)
        config = config or MatchingConfig()
        return torch_matching.gradients(self.poses(), problem, problem.target, *hand, config)

    def turn_of(self, p, k, by_w):
        """A of eq. (3), applied to a gradient by the rotation vector."""
        return self.R[p, k] @ self.inverse[p] @ self.R[p, k].T @ by_w


PARTICLES_OF_ALL = list(np.ndindex(PRESHAPES, PARTICLES))


@pytest.fixture(autouse=True)
def one_thread(monkeypatch):
    """The tests leave the other cores alone."""
    monkeypatch.setenv("GRASPMATCH_THREADS", "1")
    torch.set_num_threads(1)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_mesh(mug(diameter=0.04, height=0.05))


# --- against the reference -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", ["loss", "paper"])
def test_gradients_are_those_of_the_reference(rng, scale):
    small = Small(rng)
    found = small.gradients(small.problem(), MatchingConfig(com_gradient=scale, com_weight=0.7))
    assert found.is_free.all()
    for p, k in PARTICLES_OF_ALL:
        t, q, samples = small.t[p, k], small.q[p, k], small.samples[p]
        com_weight = 0.7 if scale == "loss" else 0.7 / len(samples)
        paired = reference.pairs(samples @ small.R[p, k].T + t, small.target)
        by_t, by_q = reference.grasp_gradients(t, q, samples, paired, np.zeros(3), np.zeros(3), com_weight)
        error = reference.matching_loss(samples @ small.R[p, k].T + t, paired)
        np.testing.assert_allclose(found.by_position[p, k], by_t / (1 + com_weight), rtol=1e-4, atol=1e-7)
        turn = small.turn_of(p, k, reference.tangent(q, by_q))
        np.testing.assert_allclose(found.by_rotation[p, k], turn, rtol=1e-4, atol=1e-5)
        assert found.matching_error[p, k].item() == pytest.approx(error, rel=1e-5)
        assert found.loss[p, k].item() == pytest.approx(error + 0.7 * t @ t, rel=1e-5)


def test_brute_force_finds_the_nearest_points(rng):
    target, queries = rng.normal(size=(300, 3)) * 0.05, rng.normal(size=(3 * torch_matching.CHUNK["cpu"] + 1, 3)) * 0.1
    found = torch_matching.nearest(tensor(queries), tensor(target)).numpy()
    excess = np.linalg.norm(queries - found, axis=-1) - KDTree(target).query(queries)[0]
    assert np.abs(excess).max() < 1e-6


def test_inner_surface_is_pulled_to_points_of_the_target_inside_the_hand(rng):
    small, cloud = Small(rng), rng.uniform(-0.12, 0.12, size=(4000, 3))
    found = small.gradients(small.problem(cloud))
    for p, k in PARTICLES_OF_ALL:
        t, q = small.t[p, k], small.q[p, k]
        inside, in_hand = reference.colliding_points(t, q, cloud, lambda x: grids.interpolate(small.distance, x))
        assert len(inside) > 0
        assert not found.is_free[p, k]
        node = np.rint((in_hand - small.distance.origin) / small.distance.spacing).astype(int)
        pulled = small.samples[p][small.nearest[p][tuple(node.T)]]
        by_t, by_q = reference.matching_gradients(t, q, pulled, inside)
        np.testing.assert_allclose(found.by_position[p, k], by_t, atol=1e-5)
        turn = small.turn_of(p, k, reference.tangent(q, by_q))
        np.testing.assert_allclose(found.by_rotation[p, k], turn, rtol=1e-3, atol=1e-4)


def test_obstacles_leave_the_hand_where_they_came_in(rng):
    """An obstacle inside the box: the box moves by its depth, away from the nearest face."""
    small = Small(rng)
    for p, k in PARTICLES_OF_ALL:
        obstacle = small.R[p, k] @ [0.002, 0.004, 0.007] + small.t[p, k]  # nearest to the face z = 10 mm
        found = small.gradients(small.problem(obstacle[None], targets=0))
        np.testing.assert_allclose(small.R[p, k].T @ found.by_position[p, k].numpy(), [0, 0, 0.003], atol=1e-5)


def test_corners_below_the_table_lift_the_hand(rng):
    small = Small(rng)
    found = small.gradients(small.problem(table=((0.0, 0.0, 1.0), 0.02)))
    for p, k in PARTICLES_OF_ALL:
        height = (CORNERS @ small.R[p, k].T + small.t[p, k])[:, 2] - 0.02
        below = height[height < 0]
        assert found.is_free[p, k].item() == (len(below) == 0)
        if len(below):
            np.testing.assert_allclose(found.by_position[p, k], [0, 0, below.mean()], atol=1e-6)


def test_stein_step_is_that_of_the_reference(rng):
    small = Small(rng)
    problem = small.problem()
    config = MatchingConfig(repulsion=0.3, prior_translation=0.5, prior_concentration=3.0, longest_step=1.0)
    seed_t, seed_q = small.t + rng.normal(size=small.t.shape) * 0.05, se3.random_quaternions(8, rng).reshape(2, 4, 4)
    drift_t, drift_w = rng.normal(size=(2, PRESHAPES, PARTICLES, 3)) * 0.01
    found = replace(small.gradients(problem), by_position=tensor(drift_t), by_rotation=tensor(drift_w))
    seeds = torch_problem.Poses(tensor(seed_t), tensor(seed_q))
    moved = torch_matching.stein_step(small.poses(), seeds, found, problem.hand, 0.7, config)
    for p in range(PRESHAPES):
        n, R = len(small.samples[p]), small.R[p]
        inverse = R @ small.inverse[p] @ np.swapaxes(R, 1, 2)
        slopes = [
            reference.prior_slopes(*pose, 0.5**-2, 3.0)
            for pose in zip(small.t[p], small.q[p], seed_t[p], seed_q[p], strict=True)
        ]
        with_prior_t = drift_t[p] + 0.5 * np.array([by_t for by_t, _ in slopes]) / n
        with_prior_w = drift_w[p] + np.einsum("kij,kj->ki", inverse, [by_w for _, by_w in slopes]) / n
        moves, spins = reference.stein_directions(
            small.t[p], small.q[p], with_prior_t, with_prior_w, 0.7, 0.3, 0.5, inverse, n
        )
        np.testing.assert_allclose(moved.position[p], small.t[p] + moves, rtol=1e-4, atol=1e-6)
        spins *= np.minimum(1.0, 0.5 / np.linalg.norm(spins, axis=-1, keepdims=True))
        turned = se3.quaternion_multiply(se3.quaternion_exp(spins), small.q[p])
        np.testing.assert_allclose(np.abs(np.sum(moved.rotation[p].numpy() * turned, axis=-1)), 1.0, atol=1e-6)


# --- the mini-batch --------------------------------------------------------------------------------------------------


def test_mini_batch_has_its_share_of_distinct_samples_of_each_preshape(rng):
    small = Small(rng)
    _, samples, weights = torch_matching.draw_batch(small.problem(), 0.5, MatchingConfig(), rng)
    for p, own in enumerate(small.samples):
        drawn = samples[p][weights[p] > 0].numpy()
        distance, index = KDTree(own).query(drawn)
        assert len(drawn) == len(np.unique(index)) == np.ceil(0.5 * len(own))
        assert distance.max() < 1e-7


def test_batch_from_the_object_is_a_share_of_the_target(rng):
    small = Small(rng)
    target, samples, _ = torch_matching.draw_batch(small.problem(), 0.3, MatchingConfig(batch_from="object"), rng)
    assert len(target) == len(torch.unique(target, dim=0)) == 18
    assert samples.shape == (2, 40, 3)


# --- beside the planner ----------------------------------------------------------------------------------------------


def both(toy, scene, config, seed=0):
    """Matched by the planner and by PyTorch, from the same starts and random numbers."""
    rng = np.random.default_rng(seed)
    starts = seed_poses(scene, toy, SeedingConfig(), rng)
    same = deepcopy(rng)
    ours = match(starts, prepare(scene, toy, config, rng, "cpu"), config, rng)
    problem = torch_problem.torch_prepare(scene, toy, config, same, "cpu")
    return ours, torch_matching.torch_match(starts, problem, config, same)


@pytest.mark.parametrize("stein_iterations", [0, 2])
def test_first_steps_are_those_of_the_planner(toy, scene, stein_iterations):
    """Later ones drift apart: the field's nearest neighbours are not all exact, and collisions begin at other poses."""
    ours, found = both(toy, scene, MatchingConfig(iterations=2, stein_iterations=stein_iterations))
    before, _ = both(toy, scene, MatchingConfig(iterations=0))
    a, b, c = (matched.T_world_gripper for matched in (ours, found, before))
    assert np.all(np.median(np.abs(a - b), axis=0) <= 0.05 * np.median(np.abs(a - c), axis=0))
    assert np.mean(ours.is_free == found.is_free) > 0.95
    np.testing.assert_allclose(np.sqrt(np.median(found.loss)), np.sqrt(np.median(ours.loss)), rtol=0.01)


@pytest.mark.parametrize(("method", "seeds", "tolerance"), [("sgd-icp", 1, 0.1), ("annealed-stein-icp", 3, 0.15)])
def test_final_losses_are_about_those_of_the_planner(toy, scene, method, seeds, tolerance):
    """Of each run the ten lowest and the median. The Stein phase makes every run another draw: over ten seeds the mean
    of the ten lowest varied by 5 %, the median by 5 % and the single lowest by 20 %, for both versions alike."""
    runs = [both(toy, scene, MatchingConfig(method=method), seed) for seed in range(seeds)]
    roots = np.sqrt([[np.sort(matched.loss) for matched in run] for run in runs])
    for ours, found in (roots[..., :10].mean(axis=(0, 2)), np.median(roots, axis=-1).mean(axis=0)):
        assert found == pytest.approx(ours, rel=tolerance)


def test_loss_of_given_poses_is_that_of_the_planner(toy, scene):
    rng, config = np.random.default_rng(0), MatchingConfig()
    starts = seed_poses(scene, toy, SeedingConfig(), rng).select(rng.permutation(40))
    ours = measure(starts, prepare(scene, toy, config, rng, "cpu"))
    problem = torch_problem.torch_prepare(scene, toy, config, rng, "cpu")
    for a, b in zip(ours, torch_matching.torch_measure(starts, problem, config), strict=True):
        np.testing.assert_allclose(np.sqrt(a), np.sqrt(b), rtol=0.03)


def test_plan_gives_grasps_best_first_and_the_same_again(toy, scene):
    first, again = (torch_matching.torch_plan(scene, toy, 3) for _ in range(2))
    assert len(first) > 0, first.explain()
    assert np.all(np.diff(first.score) <= 0)
    assert np.all(first.clearance > 0.0019)
    np.testing.assert_array_equal(first.T_world_gripper, again.T_world_gripper)
    np.testing.assert_array_equal(first.loss, again.loss)


def test_starts_and_methods_it_does_not_have_are_errors(toy, scene):
    rng, config = np.random.default_rng(0), MatchingConfig()
    problem = torch_problem.torch_prepare(scene, toy, config, rng, "cpu")
    starts = seed_poses(scene, toy, SeedingConfig(), rng)
    with pytest.raises(GraspmatchError, match="sgd-icp"):
        torch_matching.torch_match(starts, problem, MatchingConfig(method="icp"), rng)
    unsorted = Candidates(starts.preshape[::-1].copy(), starts.T_world_gripper)
    with pytest.raises(GraspmatchError, match="same number of starts"):
        torch_matching.torch_match(unsorted, problem, config, rng)


def test_no_poses_have_no_losses(toy, scene):
    problem = torch_problem.torch_prepare(scene, toy, MatchingConfig(), np.random.default_rng(0), "cpu")
    nothing = Candidates(np.zeros(0, dtype=int), np.zeros((0, 4, 4)))
    error, loss = torch_matching.torch_measure(nothing, problem, MatchingConfig())
    assert error.shape == loss.shape == (0,)
