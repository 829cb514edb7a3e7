"""Kernels against the NumPy reference, and the reference against finite differences and closed forms."""

# pyright: reportInvalidTypeForm=false
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial import KDTree
from threadpoolctl import threadpool_info

from graspmatch.geometry import grid as grids
from graspmatch.geometry import se3
from graspmatch.geometry.grid import Grid
from graspmatch.kernels import (
    reference,
    warp_arrival,
    warp_avoid,
    warp_blocks,
    warp_collide,
    warp_fields,
    warp_match,
    warp_stein,
    warp_steps,
)
from graspmatch.kernels.blas import blas_on_one_thread
from graspmatch.kernels.fields import (
    cell_levels,
    covering_nearest_field,
    in_block_order,
    in_blocks,
    pack_levels,
    scatter,
    stack_fields,
    upload_blocks,
)
from graspmatch.kernels.launch import launch
from graspmatch.kernels.warp_fields import NEVER
from graspmatch.kernels.warp_queue import Queue, take
from graspmatch.planner.upload import inverse_inertia, swept_distance


def close(found, expected, rtol=1e-4, atol=1e-6):
    """Single against double precision, lengths of decimetres."""
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=atol)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def random_pose(rng, scale=0.1):
    return rng.normal(size=3) * scale, se3.random_quaternions(1, rng)[0]


def vec3(array, device):
    return wp.array(array, dtype=wp.vec3, device=device)


def floats(array, device):
    return wp.array(array, dtype=wp.float32, device=device)


# --- the reference ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.01, 0.1, 1.0])
def test_gradient_by_translation_is_half_the_slope_of_the_loss(rng, scale):
    t, q = random_pose(rng, scale)
    samples, paired = rng.normal(size=(2, 30, 3)) * scale
    by_t, _ = reference.matching_gradients(t, q, samples, paired)
    R = se3.matrix_from_quaternion(q)
    h = 1e-6 * scale

    def loss(at):
        return reference.matching_loss(samples @ R.T + at, paired)

    slope = [(loss(t + h * e) - loss(t - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(2 * by_t, slope, rtol=1e-6, atol=1e-9 * scale)


def test_derivative_of_the_rotation_matches_differences(rng):
    q = se3.random_quaternions(1, rng)[0]
    derivative = reference.rotation_derivative(q)
    for k, e in enumerate(np.eye(4)):
        difference = reference.homogeneous_rotation(q + 1e-6 * e) - reference.homogeneous_rotation(q - 1e-6 * e)
        np.testing.assert_allclose(derivative[k], difference / 2e-6, atol=1e-8)


@pytest.mark.parametrize("scale", [0.01, 0.1, 1.0])
def test_tangent_gradient_is_half_the_slope_along_the_manifold(rng, scale):
    """Eqs. (5) and (17) through the quaternion, against perturbing the rotation itself; the loss with its CoM term."""
    t, q = random_pose(rng, scale)
    samples, paired = rng.normal(size=(2, 30, 3)) * scale
    tcp, com = rng.normal(size=(2, 3)) * scale
    _, by_q = reference.grasp_gradients(t, q, samples, paired, tcp, com, 1.0)

    def loss(w):
        turned = se3.quaternion_multiply(se3.quaternion_exp(w), q)
        moved = samples @ se3.matrix_from_quaternion(turned).T + t
        return reference.matching_loss(moved, paired) + reference.com_loss(t, turned, tcp, com)

    h = 1e-6
    slope = [(loss(h * e) - loss(-h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(2 * reference.tangent(q, by_q), slope, rtol=1e-5, atol=1e-9 * scale**2)


def test_tangent_gradient_is_the_mean_torque_of_the_residuals(rng):
    """What the kernels compute: lever x residual."""
    t, q = random_pose(rng)
    samples, paired = rng.normal(size=(2, 30, 3)) * 0.1
    _, by_q = reference.matching_gradients(t, q, samples, paired)
    lever = samples @ se3.matrix_from_quaternion(q).T
    torque = np.cross(lever, lever + t - paired).mean(axis=0)
    np.testing.assert_allclose(reference.tangent(q, by_q), torque, atol=1e-12)


def test_closed_form_alignment_recovers_a_rigid_motion(rng):
    samples = rng.normal(size=(40, 3))
    T = se3.from_parts(se3.matrix_from_quaternion(se3.random_quaternions(1, rng)[0]), rng.normal(size=3))
    found = reference.align(samples, se3.apply(T, samples), rng.random(40) + 0.1)
    np.testing.assert_allclose(found, T, atol=1e-12)


def test_closed_form_alignment_never_mirrors(rng):
    samples = rng.normal(size=(40, 3))
    found = reference.align(samples, samples * [1, 1, -1], np.ones(40))
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_repulsion_of_equal_poses_is_zero_and_of_near_ones_points_apart(rng):
    q = se3.random_quaternions(1, rng)[0]
    np.testing.assert_allclose(reference.kernel_slope(q, q), 0.0, atol=1e-12)
    w = np.array([0.02, -0.01, 0.03])
    near = se3.quaternion_multiply(se3.quaternion_exp(w), q)
    apart = reference.kernel_slope(q, near)
    assert apart @ w > 0.99 * np.linalg.norm(apart) * np.linalg.norm(w)
    np.testing.assert_allclose(reference.kernel_slope(-q, near), apart, atol=1e-12)  # q and -q are one rotation


def test_slope_of_the_rotation_kernel_matches_differences(rng):
    """Turning a by exp(w) changes |a . b|; carried to b, the same turn changes it the other way."""
    a, b = se3.random_quaternions(2, rng)
    h = 1e-6

    def kernel(w):
        return reference.rotation_kernel(a, se3.quaternion_multiply(se3.quaternion_exp(w), b))

    slope = np.array([(kernel(h * e) - kernel(-h * e)) / (2 * h) for e in np.eye(3)])
    np.testing.assert_allclose(reference.kernel_slope(a, b), -slope, atol=1e-8)


def test_prior_slopes_match_differences(rng):
    (t, q), (seed_t, seed_q) = random_pose(rng), random_pose(rng)

    def negative_log(dt, w):
        turned = se3.quaternion_multiply(se3.quaternion_exp(w), q)
        cosine = 2 * (turned @ seed_q) ** 2 - 1
        return 0.5 * 11.0 * np.sum((t + dt - seed_t) ** 2) - 0.7 * cosine

    h, zero = 1e-6, np.zeros(3)
    by_t = [(negative_log(h * e, zero) - negative_log(-h * e, zero)) / (2 * h) for e in np.eye(3)]
    by_w = [(negative_log(zero, h * e) - negative_log(zero, -h * e)) / (2 * h) for e in np.eye(3)]
    found = reference.prior_slopes(t, q, seed_t, seed_q, 11.0, 0.7)
    np.testing.assert_allclose(found[0], by_t, atol=1e-6)
    np.testing.assert_allclose(found[1], by_w, atol=1e-6)


# --- fields ----------------------------------------------------------------------------------------------------------


def surface_cloud(rng, n=4000):
    points = rng.normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=-1, keepdims=True) * [0.05, 0.03, 0.08]


def test_interpolation_on_the_device_matches_numpy_inside_and_outside(rng, device):
    fields = [Grid(rng.normal(size=3) * 0.1, 0.01, rng.normal(size=shape)) for shape in [(5, 6, 7), (4, 9, 3)]]
    points, which = rng.uniform(-0.2, 0.2, size=(500, 3)), rng.integers(2, size=500)
    out = wp.empty(500, dtype=wp.float32, device=device)
    inputs = [stack_fields(fields, device), wp.array(which, dtype=wp.int32, device=device), vec3(points, device)]
    launch(warp_fields.query_stack, 500, inputs, [out], device)
    expected = np.where(which == 0, grids.interpolate(fields[0], points), grids.interpolate(fields[1], points))
    np.testing.assert_allclose(out.numpy(), expected, rtol=1e-4, atol=2e-4)


def test_interpolation_reproduces_a_linear_field(rng):
    origin, shape = grids.covering(np.array([-0.1, -0.2, 0.0]), np.array([0.1, 0.1, 0.3]), 0.02)
    nodes = grids.node_positions(origin, 0.02, shape)
    field = Grid(origin, 0.02, (nodes @ [1.0, -2.0, 3.0] + 0.5).reshape(shape))
    points = rng.uniform([-0.1, -0.2, 0.0], [0.1, 0.1, 0.3], size=(100, 3))
    np.testing.assert_allclose(grids.interpolate(field, points), points @ [1.0, -2.0, 3.0] + 0.5, atol=1e-12)


def test_nearest_field_agrees_with_a_tree(rng, device):
    """Exact but for a few queries, and nowhere worse than half a voxel: seeds are rounded to nodes."""
    from graspmatch.geometry.cloud import voxel_downsample

    points = voxel_downsample(surface_cloud(rng, 20000), 0.005, origin=np.zeros(3))[0]
    field = covering_nearest_field(points, 0.005, 0.03, device)
    queries = rng.uniform(points.min(0) - 0.03, points.max(0) + 0.03, size=(20000, 3))
    out = wp.empty(len(queries), dtype=wp.int32, device=device)
    launch(warp_fields.query_nearest, len(queries), [field, vec3(queries, device)], [out], device)
    excess = np.linalg.norm(queries - points[out.numpy()], axis=-1) - KDTree(points).query(queries)[0]
    assert excess.max() < 0.0025
    assert np.mean(excess > 0.001) < 0.02
    assert excess.mean() < 0.0001


# --- clouds in blocks ------------------------------------------------------------------------------------------------


def test_level_of_a_cell_bounds_its_values(rng):
    field = Grid(np.zeros(3), 1.0, rng.normal(0.02, 0.01, size=(7, 8, 9)))
    levels, step = cell_levels(field.values, 0.00025), 0.00025
    points = rng.uniform(0, [6, 7, 8], size=(20000, 3))
    level, value = levels[tuple(points.astype(int).T)], grids.interpolate(field, points)
    assert np.all(value[level > 0] >= (level[level > 0] - 1.0) * step)
    assert level.min() == 0
    assert level.max() > 10


def test_blocks_hold_every_point_once_and_neighbours_together(rng):
    cloud = surface_cloud(rng)
    blocks = scatter(in_blocks(in_block_order(cloud)))
    points = np.swapaxes(blocks, 1, 2).reshape(-1, 3)
    points = points[points[:, 0] < 1]
    assert len(points) == len(cloud)
    assert KDTree(points).query(cloud)[0].max() < 1e-7
    size = np.ptp(blocks[blocks.max(axis=(1, 2)) < 1], axis=2).max(axis=1)
    assert np.median(size) < 0.035  # of 160 mm
    assert np.ptp(blocks[: len(blocks) // 8].mean(axis=2), axis=0)[2] > 0.1  # the first ones are everywhere


class Corridor:
    """A long box as the field of a hand and its way in, along +z, at some poses among the points of a cloud."""

    def __init__(self, rng, device, poses=12):
        self.device = device
        half, centre = np.array([0.01, 0.02, 0.15]), np.array([0.0, 0.0, -0.12])
        origin, shape = grids.covering(centre - half - 0.02, centre + half + 0.02, 0.003)
        nodes = np.abs(grids.node_positions(origin, 0.003, shape) - centre) - half
        distance = np.linalg.norm(np.maximum(nodes, 0), axis=-1) + np.minimum(nodes.max(axis=-1), 0)
        self.field = Grid(origin, 0.003, distance.reshape(shape))
        self.cloud = surface_cloud(rng)
        self.t, self.q = rng.normal(size=(poses, 3)) * 0.08, se3.random_quaternions(poses, rng)
        self.local = [(self.cloud - t) @ se3.matrix_from_quaternion(q) for t, q in zip(self.t, self.q, strict=True)]

    def inputs(self, fields, step):
        """What the kernels take: fields, points in blocks and levels, and the poses."""
        blocks = upload_blocks([in_block_order(self.cloud)], self.device, scattered=True)
        levels = pack_levels(fields, step, self.device)
        T = se3.from_parts(se3.matrix_from_quaternion(self.q), self.t)
        poses = [
            wp.zeros(len(self.t), dtype=wp.int32, device=self.device),
            wp.array(T, dtype=wp.mat44, device=self.device),
        ]
        return [stack_fields(fields, self.device), blocks.points, blocks.balls, levels, step], blocks.blocks, poses


def test_least_distance_is_that_of_all_points(rng, device):
    toy = Corridor(rng, device)
    field, blocks, poses = toy.inputs([toy.field], 0.00025)
    out = wp.empty(len(toy.t), dtype=wp.float32, device=device)
    inputs = [*field, blocks, *poses]
    launch(warp_avoid.least_distance, len(toy.t), inputs, [out], device, lanes=warp_blocks.LANES)
    expected = [grids.interpolate(toy.field, local).min() for local in toy.local]
    assert np.min(expected) < 0 < np.max(expected)
    np.testing.assert_allclose(out.numpy(), expected, atol=2e-6)


def test_clear_ways_are_those_that_keep_their_distance_to_all_points_and_the_table(rng, device):
    toy = Corridor(rng, device)
    field, blocks, poses = toy.inputs([toy.field], 0.00025)
    shift, turn = rng.normal(size=(40, 3)) * 0.02, se3.random_quaternions(40, rng)
    turn[:20] = [1.0, 0.0, 0.0, 0.0]
    corners = rng.normal(size=(1, 5, 3)) * 0.02
    out = wp.empty(len(toy.t), dtype=wp.int32, device=device)
    moves = [wp.array(se3.from_parts(se3.matrix_from_quaternion(turn), shift), dtype=wp.mat44, device=device)]
    hulls = wp.array(corners, dtype=wp.vec3, device=device)
    inputs = [*field, blocks, hulls, wp.vec3(0.0, 0.0, 1.0), -0.07, 0.002, *moves, *poses]
    launch(warp_avoid.clear_ways, len(toy.t), inputs, [out], device, lanes=warp_blocks.LANES)
    expected = np.zeros(len(toy.t), dtype=int)
    for i, (t, q) in enumerate(zip(toy.t, toy.q, strict=True)):
        R = se3.matrix_from_quaternion(q)
        for d, r in zip(shift, se3.matrix_from_quaternion(turn), strict=True):
            distance = grids.interpolate(toy.field, (toy.cloud - t - R @ d) @ R @ r).min()
            height = (corners[0] @ (R @ r).T + t + R @ d)[:, 2].min() + 0.07
            expected[i] += min(distance, height) > 0.002
    assert 0 < expected.sum() < 40 * len(toy.t)
    np.testing.assert_array_equal(out.numpy(), expected)


def backed_off(toy, field, blocks, poses, wider, least, most):
    """What `back_off` finds, in steps of a millimetre."""
    n, device = len(toy.t), toy.device
    found = [wp.empty(n, dtype=dtype, device=device) for dtype in (wp.int32, wp.float32, wp.float32)]
    options = [wp.array(wider, dtype=wp.int32, device=device), wp.array(least, dtype=wp.float32, device=device), most]
    inputs = [*field, blocks, wp.vec3(0.0, 0.0, 1.0), 0.002, 0.001, *poses, *options]
    launch(warp_avoid.back_off, n, inputs, found, device, lanes=warp_blocks.LANES)
    return [out.numpy() for out in found]


def test_backing_off_ends_at_the_first_step_that_is_clear_of_all_points(rng, device):
    toy = Corridor(rng, device)
    field, blocks, poses = toy.inputs([toy.field], 0.00025)
    _, _, retreat = backed_off(toy, field, blocks, poses, [-1], np.zeros((len(toy.t), 1)), 0.5)
    for local, found in zip(toy.local, retreat, strict=True):
        # The way back only grows: from point to point it is the first step at which that point is clear.
        steps = np.arange(0, 0.3, 0.001)
        near = np.array([grids.interpolate(toy.field, local + np.array([0, 0, d])) < 0.002 for d in steps])
        expected = steps[np.argmin(near, axis=0)].max()
        assert found >= expected - 1e-6
        assert not np.any(grids.interpolate(toy.field, local + np.array([0, 0, found])) < 0.002 - 1e-6)


def test_hands_open_as_far_as_that_shortens_their_way_back(rng, device):
    toy = Corridor(rng, device)
    fields = [replace(toy.field, values=toy.field.values + more) for more in (0.0, 0.012, 0.013, 0.03)]
    field, blocks, poses = toy.inputs(fields, 0.00025)
    n, wider, most, step = len(toy.t), [1, 2, -1, 0], 0.04, 0.001
    least = rng.choice([0.0, 0.0105, np.inf], size=(n, len(fields)))
    alone = np.zeros((n, len(fields)))
    for g in range(len(fields)):
        only = [wp.full(n, g, dtype=wp.int32, device=device), poses[1]]
        *_, alone[:, g] = backed_off(toy, field, blocks, only, [-1] * len(fields), least, most)
    begin = np.resize([0, 1, 3], n)
    starts = [wp.array(begin, dtype=wp.int32, device=device), poses[1]]
    chosen, smallest, needed = backed_off(toy, field, blocks, starts, wider, least, most)
    for i in range(n):
        g, best, asked, shortest = begin[i], begin[i], np.inf, np.inf
        while g >= 0 and shortest >= step:
            asked = min(asked, least[i, g])
            if alone[i, g] <= most and alone[i, g] < shortest:
                best, shortest = g, alone[i, g]
            g = wider[g]
        assert chosen[i] == best
        assert smallest[i] == pytest.approx(asked)
        assert needed[i] == pytest.approx(shortest)
    assert len(np.unique(chosen)) == len(fields)
    assert 0 < np.isinf(needed).sum() < n


def test_first_contact_is_the_earliest_of_all_points(rng, device):
    toy = Corridor(rng, device)
    nodes = grids.node_positions(toy.field.origin, 0.003, toy.field.shape).reshape(*toy.field.shape, 3)
    swept = toy.field.values < 0.01
    sides = [
        np.where(swept & (sign * nodes[..., 1] > -0.02), 0.5 + sign * 5 * nodes[..., 1], NEVER) for sign in (1, -1)
    ]
    fields = [replace(toy.field, values=np.where(v < NEVER, np.clip(v, 0, 1), NEVER)) for v in sides]
    field, blocks, poses = toy.inputs(fields, 1 / 250)
    out = wp.empty(2 * len(toy.t), dtype=wp.float32, device=device)
    swept_levels = pack_levels([swept_distance(grid) for grid in fields], 0.00025, device)
    inputs = [2, *field, swept_levels, 0.00025, 0, blocks, *poses]
    launch(warp_avoid.first_contact, len(toy.t), inputs, [out], device, lanes=warp_blocks.LANES)
    for local, found in zip(toy.local, out.numpy().reshape(-1, 2), strict=True):
        for grid, fraction in zip(fields, found, strict=True):
            u = (local - grid.origin) / grid.spacing
            u = u[np.all((u >= 0) & (u <= np.array(grid.shape) - 1), axis=-1)]
            low = np.minimum(u.astype(int), np.array(grid.shape) - 2)
            corners = np.stack([grid.values[tuple((low + c).T)] for c in np.ndindex(2, 2, 2)])
            smooth = grids.interpolate(grid, u * grid.spacing + grid.origin)
            nearest = grid.values[tuple((low + (u - low >= 0.5)).T)]
            expected = np.where(corners.max(axis=0) < NEVER, smooth, nearest).min(initial=NEVER)
            assert fraction == pytest.approx(expected, abs=1e-4)


@wp.kernel
def arrivals_one_by_one_and_at_once(
    queue: Queue,
    stack: warp_fields.FieldStack,
    A: wp.mat33,
    b: wp.vec3,
    points: wp.array(dtype=wp.float32),
    listed: wp.array(dtype=wp.int32),
    t_out: wp.array2d(dtype=wp.float32),
    slowness_out: wp.array2d(dtype=wp.float32),
):
    i = take(queue, wp.tid())
    if i < 0:
        return
    for e in range(listed.shape[0]):
        k = listed[e]
        x = warp_blocks.block_point(points, k // 32, k % 32)
        t_out[0, e] = warp_arrival.arrival_at(stack, i, A * x + b)
    warp_arrival.arrivals(stack, i, A, b, points, listed, 0, listed.shape[0], t_out[1], slowness_out)


def test_arrivals_at_many_points_are_those_at_each(rng, device):
    shape, spacing = (9, 12, 10), 0.004
    values = np.where(rng.random(shape) < 0.7, rng.random(shape), NEVER)
    values[:5] = rng.random((5, *shape[1:]))  # where all eight nodes are covered
    u = rng.uniform(-1, np.array(shape), size=(500, 3))
    listed = rng.permutation(500)
    found, slowness = (wp.zeros((n, 500), dtype=wp.float32, device=device) for n in (2, 4))
    stack = stack_fields([Grid(np.zeros(3), spacing, values)], device)
    points, list_of = floats(in_blocks(u).ravel(), device), wp.array(listed, dtype=wp.int32, device=device)
    inputs = [stack, wp.mat33(np.eye(3)), wp.vec3(0.0, 0.0, 0.0), points, list_of]
    launch(arrivals_one_by_one_and_at_once, 1, inputs, [found, slowness], device)
    alone, together = found.numpy()
    np.testing.assert_allclose(together, alone, atol=1e-6)
    assert 0.2 < np.mean(alone < NEVER) < 0.9
    node = np.clip((u[listed] + 0.5).astype(int), 1, np.array(shape) - 2)
    here = values[tuple(node.T)]
    for axis, step in enumerate(np.eye(3, dtype=int)):
        before, after = (values[tuple((node + sign * step).T)] for sign in (-1, 1))
        both = np.where((before < NEVER) & (after < NEVER), 0.5, 1.0)
        expected = both * (np.where(after < NEVER, after, here) - np.where(before < NEVER, before, here))
        np.testing.assert_allclose(slowness.numpy()[axis], np.where(here < NEVER, expected, 0.0), atol=1e-6)
    np.testing.assert_allclose(slowness.numpy()[3], np.linalg.norm(slowness.numpy()[:3], axis=0), rtol=1e-6)


def test_blocks_that_can_matter_are_looked_at(rng):
    """Each lies in its ball, the last ones that are not full as well; there are no others."""
    clouds = [rng.normal(size=(n, 3)) * 0.1 for n in (1, 31, 33, 1500)]
    found = upload_blocks([in_block_order(cloud) for cloud in clouds], "cpu", scattered=True)
    points = found.points.numpy().reshape(-1, 3, 32)
    balls = np.swapaxes(found.balls.numpy().reshape(-1, 4, 32), 1, 2).reshape(-1, 4)
    assert len(points) == found.blocks == found.ends[-1] == 1 + 1 + 2 + 47
    for block, (*centre, radius) in zip(points, balls, strict=False):
        distance = np.linalg.norm(block.T - centre, axis=-1)
        assert np.all((distance <= radius) | (block[0] > 100))
        assert radius < 1.5 * np.linalg.norm(np.ptp(block.T[block[0] < 100], axis=0)) / 2 + 1e-5
    assert np.all(balls[found.blocks :] == 0)


def test_products_of_matrices_leave_the_cores_to_kernels():
    def threads() -> list[int]:
        libraries = (library for library in threadpool_info() if "numpy" in library["filepath"])
        return [library["num_threads"] for library in libraries if library["user_api"] == "blas"]

    before = threads()
    with blas_on_one_thread():
        assert set(threads()) == {1}
    assert threads() == before


# --- matching --------------------------------------------------------------------------------------------------------


class Toy:
    """Two preshapes of random samples in a box-shaped hand, a target, and particles, on device and host."""

    def __init__(self, rng, device, particles=6, size=40):
        self.device, self.rng = device, rng
        self.samples = [rng.normal(size=(size, 3)) * 0.03 for _ in range(2)]
        self.weights = [rng.random(size) + 0.5 for _ in range(2)]
        self.target = rng.normal(size=(60, 3)) * 0.05
        self.preshape = np.repeat([0, 1], particles // 2)
        self.t = rng.normal(size=(particles, 3)) * 0.03
        self.q = se3.random_quaternions(particles, rng)
        origin, shape = grids.covering(np.full(3, -0.04), np.full(3, 0.04), 0.002)
        nodes = grids.node_positions(origin, 0.002, shape)
        self.half = np.array([0.015, 0.03, 0.01])
        self.distance = Grid(origin, 0.002, self.box(nodes).reshape(shape))
        self.nearest = [KDTree(s).query(nodes)[1] for s in self.samples]

    def box(self, points):
        q = np.abs(points) - self.half
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)

    def hand(self):
        hand = warp_collide.Hand()
        hand.samples = vec3(np.concatenate(self.samples), self.device)
        hand.weights = wp.array(np.concatenate(self.weights), dtype=wp.float32, device=self.device)
        hand.start = wp.array([0, len(self.samples[0])], dtype=wp.int32, device=self.device)
        hand.count = wp.array([len(s) for s in self.samples], dtype=wp.int32, device=self.device)
        hand.tool_centre_point = wp.zeros(2, dtype=wp.vec3, device=self.device)
        self.inverse = [inverse_inertia(s, w) for s, w in zip(self.samples, self.weights, strict=True)]
        hand.inverse_inertia = wp.array(np.array(self.inverse), dtype=wp.mat33, device=self.device)
        hand.distance = stack_fields([self.distance, self.distance], self.device)
        hand.distance_step = 0.00025
        hand.nearest_sample = wp.array(np.concatenate(self.nearest), dtype=wp.int32, device=self.device)
        corners = np.array(list(np.ndindex(2, 2, 2))) * 2 * self.half - self.half
        self.outline = floats(np.concatenate([in_blocks(corners)] * 2).ravel(), self.device)
        hand.outline_start = wp.array([0, 1], dtype=wp.int32, device=self.device)
        hand.outline_count = wp.array([8, 8], dtype=wp.int32, device=self.device)
        return hand

    def surroundings(self, cloud, is_target=True, table=None):
        scene = warp_collide.Surroundings()
        scene.blocks, scene.target_blocks = cloud.blocks, cloud.blocks if is_target else 0
        scene.has_table = int(table is not None)
        if table is not None:
            scene.normal, scene.offset = wp.vec3(*table[0]), table[1]
        return scene

    def particles(self):
        n, device = len(self.t), self.device
        particles = warp_match.Particles()
        particles.preshape = wp.array(self.preshape, dtype=wp.int32, device=device)
        particles.position = vec3(self.t, device)
        particles.rotation = wp.array(np.roll(self.q, -1, axis=-1), dtype=wp.quat, device=device)
        particles.seed_position = wp.clone(particles.position)
        particles.seed_rotation = wp.clone(particles.rotation)
        for name in ("gradient_position", "gradient_rotation", "best_position"):
            setattr(particles, name, wp.zeros(n, dtype=wp.vec3, device=device))
        particles.best_rotation = wp.zeros(n, dtype=wp.quat, device=device)
        particles.matching_error = wp.zeros(n, dtype=wp.float32, device=device)
        particles.loss = wp.zeros(n, dtype=wp.float32, device=device)
        particles.best_error = wp.zeros(n, dtype=wp.float32, device=device)
        particles.best_loss = wp.full(n, warp_match.NONE, dtype=wp.float32, device=device)
        particles.colliding = wp.zeros(n, dtype=wp.int32, device=device)
        particles.is_converged = wp.zeros(n, dtype=wp.int32, device=device)
        return particles

    def terms(self, com_weight=1.0, repulsion=0.01):
        terms = warp_match.Terms()
        terms.com, terms.com_weight, terms.com_gradient_weight = wp.vec3(0.0, 0.0, 0.0), com_weight, com_weight
        terms.repulsion, terms.prior_precision, terms.prior_concentration = repulsion, 0.0, 0.0
        terms.learning_rate, terms.convergence, terms.longest_step = 1.0, 0.0, 1.0
        return terms

    def slope_inputs(self, scene, terms, **kwargs):
        # A fine field makes the nearest neighbour exact for so few points.
        field = covering_nearest_field(self.target, 0.004, 0.05, self.device)
        batch = [wp.array(v, dtype=wp.int32, device=self.device) for v in ([0, 0], [len(s) for s in self.samples])]
        rows = [
            np.vstack([s.T, w])[:, self.rng.permutation(len(s))]
            for s, w in zip(self.samples, self.weights, strict=True)
        ]
        samples = floats(np.concatenate(rows, axis=1).ravel(), self.device)
        cloud, hand = upload_blocks([in_block_order(scene)], self.device), self.hand()
        levels = pack_levels([self.distance] * 2, 0.00025, self.device)
        goals = [field, field.index, field.coordinates]
        around = [self.surroundings(cloud, **kwargs), cloud.points, cloud.balls, self.outline, levels]
        return [hand, samples, *goals, *around, terms, *batch]

    def gradients(self, scene, terms, particles, *, want_loss=False, **kwargs):
        inputs = [*self.slope_inputs(scene, terms, **kwargs), 0, int(want_loss), particles]
        launch(warp_steps.gradients, len(self.t), inputs, [], self.device, lanes=warp_blocks.LANES)

    def descend(self, scene, terms, particles, iterations=1, *, closed_form=False):
        *inputs, offset, size = self.slope_inputs(scene, terms)
        batches = [wp.array(np.tile(v.numpy(), iterations), device=self.device) for v in (offset, size)]
        inputs += [*batches, 0, iterations, 0, int(closed_form), particles]
        launch(warp_steps.descend, len(self.t), inputs, [], self.device, lanes=warp_blocks.LANES)

    def stein(self, scene, terms, particles, gamma, iterations=1):
        """All of each preshape as one group."""
        *inputs, offset, size = self.slope_inputs(scene, terms)
        batches = [wp.array(np.tile(v.numpy(), iterations), device=self.device) for v in (offset, size)]
        begin = np.searchsorted(self.preshape, [0, 1])
        groups = [wp.array(v, dtype=wp.int32, device=self.device) for v in (begin, np.bincount(self.preshape))]
        inputs += [*batches, 0, iterations, floats(np.full(iterations, gamma), self.device), *groups, particles]
        following = [wp.clone(particles.position), wp.clone(particles.rotation)]
        sizes = {"lanes": warp_blocks.LANES, "rounds": 2 * iterations + 1}
        launch(warp_stein.stein, len(self.t), inputs, following, self.device, **sizes)


NOWHERE = np.full((1, 3), 9.0)
"""A scene that nothing collides with."""


def test_matching_gradients_on_the_device_match_the_reference(rng, device):
    toy, terms = Toy(rng, device), None
    particles, terms = toy.particles(), toy.terms()
    toy.gradients(NOWHERE, terms, particles)
    for i, g in enumerate(toy.preshape):
        samples, weights = toy.samples[g], toy.weights[g] / toy.weights[g].sum() * len(toy.samples[g])
        R = se3.matrix_from_quaternion(toy.q[i])
        moved = samples @ R.T + toy.t[i]
        residual = moved - reference.pairs(moved, toy.target)
        by_t = (weights[:, None] * residual).mean(axis=0) + toy.t[i]  # TCP and CoM are both origins
        torque = (weights[:, None] * np.cross(samples @ R.T, residual)).mean(axis=0)
        close(particles.gradient_position.numpy()[i], by_t / 2)
        expected = R @ toy.inverse[g] @ R.T @ torque
        np.testing.assert_allclose(particles.gradient_rotation.numpy()[i], expected, rtol=1e-3, atol=1e-4)
        loss = np.mean(weights * np.sum(residual**2, axis=-1)) + toy.t[i] @ toy.t[i]
        assert particles.loss.numpy()[i] == pytest.approx(loss, rel=1e-4)


def test_colliding_particles_follow_the_collision_gradient(rng, device):
    toy = Toy(rng, device)
    scene = rng.uniform(-0.12, 0.12, size=(4000, 3))
    particles = toy.particles()
    toy.gradients(scene, toy.terms(), particles)
    for i, g in enumerate(toy.preshape):
        inside_object, inside_hand = reference.colliding_points(toy.t[i], toy.q[i], scene, toy.box)
        count = particles.colliding.numpy()[i]
        assert count > 0
        assert abs(count - len(inside_object)) <= 0.1 * len(inside_object) + 1  # the grid rounds the box's edges
        # The kernel pairs by the nearest sample of the nearest node: nearly always the nearest sample.
        node = np.rint((inside_hand - toy.distance.origin) / toy.distance.spacing).astype(int)
        paired = toy.nearest[g].reshape(toy.distance.shape)[tuple(node.T)]
        assert np.mean(paired == KDTree(toy.samples[g]).query(inside_hand)[1]) > 0.8
        R = se3.matrix_from_quaternion(toy.q[i])
        by_t = (toy.samples[g][paired] @ R.T + toy.t[i] - inside_object).mean(axis=0)
        np.testing.assert_allclose(particles.gradient_position.numpy()[i], by_t, atol=5e-4)


def test_hand_below_the_table_is_lifted_by_its_corners(rng, device):
    toy = Toy(rng, device)
    particles = toy.particles()
    toy.gradients(NOWHERE, toy.terms(), particles, table=((0.0, 0.0, 1.0), 0.02))
    corners = np.array(list(np.ndindex(2, 2, 2))) * 2 * toy.half - toy.half
    for i in range(len(toy.t)):
        height = (corners @ se3.matrix_from_quaternion(toy.q[i]).T + toy.t[i])[:, 2] - 0.02
        below = height[height < 0]
        assert particles.colliding.numpy()[i] == len(below)
        if len(below):
            expected = [0.0, 0.0, below.mean()]
            close(particles.gradient_position.numpy()[i], expected)


def test_obstacles_leave_the_hand_where_they_came_in(rng, device):
    """A single obstacle point inside a box: the box moves by the point's depth, away from the nearest face."""
    toy = Toy(rng, device)
    inside = np.array([0.002, 0.004, 0.007])  # nearest to the face z = 10 mm
    for i in range(len(toy.t)):
        particles = toy.particles()
        R = se3.matrix_from_quaternion(toy.q[i])
        toy.gradients((R @ inside + toy.t[i])[None], toy.terms(), particles, is_target=False)
        moved = R.T @ particles.gradient_position.numpy()[i]
        np.testing.assert_allclose(moved, [0.0, 0.0, 0.003], atol=3e-4)


@pytest.mark.parametrize("prior", [0.0, 3.0])
def test_stein_step_matches_the_reference(rng, device, prior):
    toy = Toy(rng, device, particles=8)
    particles, terms = toy.particles(), toy.terms(repulsion=0.3)
    terms.prior_precision, terms.prior_concentration = prior, prior
    seed_t, seed_q = toy.t + rng.normal(size=(8, 3)) * 0.05, se3.random_quaternions(8, rng)
    particles.seed_position = vec3(seed_t, device)
    particles.seed_rotation = wp.array(np.roll(seed_q, -1, axis=-1), dtype=wp.quat, device=device)
    toy.gradients(NOWHERE, terms, particles)
    drift_t, drift_w = particles.gradient_position.numpy().copy(), particles.gradient_rotation.numpy().copy()
    toy.stein(NOWHERE, terms, particles, gamma=0.7)
    for g in range(2):
        own, n = toy.preshape == g, len(toy.samples[g])
        R = se3.matrix_from_quaternion(toy.q[own])
        inverse = R @ toy.inverse[g] @ np.swapaxes(R, 1, 2)
        poses = zip(toy.t[own], toy.q[own], seed_t[own], seed_q[own], strict=True)
        slopes = [reference.prior_slopes(*pose, prior, prior) for pose in poses]
        with_prior_t = drift_t[own] + 0.5 * np.array([by_t for by_t, _ in slopes]) / n
        with_prior_w = drift_w[own] + np.einsum("kij,kj->ki", inverse, [by_w for _, by_w in slopes]) / n
        moves, spins = reference.stein_directions(
            toy.t[own], toy.q[own], with_prior_t, with_prior_w, 0.7, 0.3, 0.5, inverse, n
        )
        np.testing.assert_allclose(particles.position.numpy()[own], toy.t[own] + moves, rtol=1e-3, atol=1e-5)
        spins *= np.minimum(1.0, 0.5 / np.linalg.norm(spins, axis=-1, keepdims=True))
        turned = se3.quaternion_multiply(se3.quaternion_exp(spins), toy.q[own])
        found = np.roll(particles.rotation.numpy()[own], 1, axis=-1)
        np.testing.assert_allclose(np.abs(np.sum(found * turned, axis=-1)), 1.0, atol=1e-5)


def test_no_stein_step_is_longer_than_the_longest(rng, device):
    toy = Toy(rng, device)
    toy.t *= 0.01  # near particles repel each other without bound
    particles, terms = toy.particles(), toy.terms(repulsion=1.0)
    terms.longest_step = 0.02
    toy.stein(NOWHERE, terms, particles, gamma=0.0)
    steps = np.linalg.norm(particles.position.numpy() - toy.t, axis=-1)
    assert steps.max() == pytest.approx(0.02, rel=1e-4)


def test_lone_particle_without_repulsion_takes_the_plain_step(rng, device):
    toy = Toy(rng, device, particles=2)
    terms = toy.terms(repulsion=0.0)
    stein, plain = toy.particles(), toy.particles()
    toy.stein(NOWHERE, terms, stein, gamma=1.0)
    toy.descend(NOWHERE, terms, plain)
    np.testing.assert_allclose(stein.position.numpy(), plain.position.numpy(), atol=1e-6)
    np.testing.assert_allclose(stein.rotation.numpy(), plain.rotation.numpy(), atol=1e-6)


def test_iterations_of_the_stein_phase_in_one_launch_are_those_of_many(rng, device, monkeypatch):
    toy = Toy(rng, device, particles=20)
    scene, terms = rng.uniform(-0.06, 0.06, size=(400, 3)), toy.terms(repulsion=0.3)
    apart = toy.particles()
    for _ in range(4):
        toy.rng = np.random.default_rng(0)
        toy.stein(scene, terms, apart, gamma=0.5)
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("GRASPMATCH_THREADS", threads)
        together, toy.rng = toy.particles(), np.random.default_rng(0)
        toy.stein(scene, terms, together, gamma=0.5, iterations=4)
        np.testing.assert_array_equal(together.position.numpy(), apart.position.numpy())
        np.testing.assert_array_equal(together.rotation.numpy(), apart.rotation.numpy())
    assert np.linalg.norm(apart.position.numpy() - toy.t, axis=-1).max() > 1e-3


def test_closed_form_step_matches_the_reference(rng, device):
    toy = Toy(rng, device)
    particles, terms = toy.particles(), toy.terms(com_weight=0.0)
    toy.descend(NOWHERE, terms, particles, closed_form=True)
    for i, g in enumerate(toy.preshape):
        R = se3.matrix_from_quaternion(toy.q[i])
        paired = reference.pairs(toy.samples[g] @ R.T + toy.t[i], toy.target)
        T = reference.align(toy.samples[g], paired, toy.weights[g])
        np.testing.assert_allclose(particles.position.numpy()[i], T[:3, 3], atol=2e-5)
        found = se3.matrix_from_quaternion(np.roll(particles.rotation.numpy()[i].astype(float), 1))
        np.testing.assert_allclose(found, T[:3, :3], atol=2e-3)


def test_results_do_not_depend_on_the_number_of_threads(rng, monkeypatch):
    toy = Toy(rng, "cpu", particles=20)
    scene = rng.uniform(-0.06, 0.06, size=(400, 3))
    found = []
    for threads in ("1", "2", "4"):
        monkeypatch.setenv("GRASPMATCH_THREADS", threads)
        toy.rng = np.random.default_rng(0)
        particles = toy.particles()
        toy.gradients(scene, toy.terms(), particles)
        found.append(np.concatenate([particles.gradient_position.numpy(), particles.gradient_rotation.numpy()]))
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
