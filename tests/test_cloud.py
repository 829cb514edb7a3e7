"""Properties of thinning, specks and normals."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from graspmatch.geometry import cloud
from graspmatch.geometry.cloud import narrowest_width
from graspmatch.geometry.se3 import rotation_exp


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)


def sphere(n: int, radius: float = 0.05) -> np.ndarray:
    """Evenly spread points on a sphere around the origin (Fibonacci)."""
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return radius * np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1)


def box_surface(half: tuple[float, float, float], n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Random points on the faces of a box, by area, and their normals."""
    half_sizes = np.array(half)
    areas = np.prod(half_sizes) / half_sizes
    axis = rng.choice(3, size=n, p=areas / areas.sum())
    sign = rng.choice([-1.0, 1.0], size=n)
    points = rng.uniform(-1, 1, size=(n, 3))
    points[np.arange(n), axis] = sign
    normals = np.zeros((n, 3))
    normals[np.arange(n), axis] = sign
    return points * half_sizes, normals


def normals_of(points: np.ndarray, **options) -> np.ndarray:
    return cloud.estimate_normals(points, cloud.nearest(points, 12)[1], **options)


def test_distinct_rows_keeps_one_copy_of_each_row(rng):
    rows = rng.integers(0, 4, size=(500, 3)).astype(float)
    kept = rows[cloud.distinct_rows(rows)]
    assert len(kept) == len(np.unique(rows, axis=0))
    assert np.array_equal(np.unique(kept, axis=0), np.unique(rows, axis=0))


def test_distinct_rows_come_in_an_order_of_their_own(rng):
    rows = np.repeat(rng.normal(size=(300, 3)), 2, axis=0)
    shuffled = rows[rng.permutation(len(rows))]
    assert np.array_equal(rows[cloud.distinct_rows(rows)], shuffled[cloud.distinct_rows(shuffled)])


def test_distinct_rows_tell_a_small_difference_but_not_the_sign_of_zero():
    rows = np.array([[0.0, 1.0, 2.0], [-0.0, 1.0, 2.0], [0.0, np.nextafter(1.0, 2.0), 2.0]])
    assert len(cloud.distinct_rows(rows)) == 2


def test_voxels_are_occupied_once_and_hold_their_centroid(rng):
    points, spacing = rng.uniform(-0.1, 0.1, size=(4000, 3)), 0.013
    centroids, inverse = cloud.voxel_downsample(points, spacing)
    cells = np.floor((points - points.min(axis=0)) / spacing + cloud.GRID_SHIFT)
    assert len(centroids) == len(np.unique(cells, axis=0))
    for row in rng.choice(len(centroids), 50, replace=False):
        members = points[inverse == row]
        assert len(np.unique(cells[inverse == row], axis=0)) == 1
        assert np.allclose(centroids[row], members.mean(axis=0), atol=1e-15)


def test_voxels_do_not_depend_on_the_order_of_the_points(rng):
    points = rng.normal(size=(5000, 3)) * 0.05
    order = rng.permutation(len(points))
    centroids, inverse = cloud.voxel_downsample(points, 0.005)
    again, inverse_again = cloud.voxel_downsample(points[order], 0.005)
    assert np.abs(centroids - again).max() < 1e-12
    assert np.array_equal(inverse[order], inverse_again)


def test_voxels_are_the_same_by_table_and_by_sorting(rng):
    """A point far away makes the table of voxels too long to be used."""
    points = rng.uniform(0.0, 0.1, size=(3000, 3))
    near = cloud.voxel_downsample(points, 0.005, origin=np.zeros(3))
    far = cloud.voxel_downsample(np.vstack([points, [[9.0, 9.0, 9.0]]]), 0.005, origin=np.zeros(3))
    np.testing.assert_array_equal(far[0][:-1], near[0])
    np.testing.assert_array_equal(far[1][:-1], near[1])


@pytest.mark.parametrize("step", [0.0025, 0.00125, 0.001])
def test_voxels_move_with_a_cloud_that_lies_on_a_grid(step):
    axis = np.arange(20) * step
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    shift = np.array([0.123, -0.77, 1.01])
    centroids, _ = cloud.voxel_downsample(points, 0.0025)
    moved, _ = cloud.voxel_downsample(points + shift, 0.0025)
    assert len(centroids) == len(moved)
    assert np.allclose(centroids + shift, moved, atol=1e-12)


def test_voxels_with_an_origin_are_the_cells_of_the_grid_through_it(rng):
    points, origin, spacing = rng.uniform(-0.1, 0.1, size=(3000, 3)), np.array([0.001, 5.0, -0.3]), 0.01
    centroids, inverse = cloud.voxel_downsample(points, spacing, origin=origin)
    cells = np.floor((points - origin) / spacing)
    assert len(centroids) == len(np.unique(cells, axis=0))
    assert np.array_equal(np.floor((centroids - origin) / spacing)[inverse], cells)


def test_labels_are_never_mixed_in_a_voxel(rng):
    points, labels = rng.uniform(0, 0.01, size=(300, 3)), rng.integers(0, 3, size=300)
    centroids, inverse = cloud.voxel_downsample(points, 1.0, labels=labels)
    assert len(centroids) == 3
    assert np.array_equal(inverse, labels)


def test_nothing_thins_to_nothing():
    centroids, inverse = cloud.voxel_downsample(np.zeros((0, 3)), 0.01)
    assert centroids.shape == (0, 3)
    assert inverse.shape == (0,)


def test_sectors_keep_opposite_normals_apart_and_right_angles_off_the_borders(rng):
    normals = sphere(5000, 1.0)
    assert (cloud.normal_sector(normals) != cloud.normal_sector(-normals)).all()
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    diagonals = np.array([[1, 1, 0], [1, -1, 0], [1, 0, 1], [1, 0, -1], [0, 1, 1], [0, 1, -1]]) / np.sqrt(2)
    for direction in np.concatenate([axes, diagonals]):
        wobbly = direction + rng.normal(size=(200, 3)) * 0.02
        assert len(np.unique(cloud.normal_sector(wobbly))) == 1


def test_specks_are_found_and_the_surface_is_not_eroded(rng):
    surface = cloud.voxel_downsample(sphere(40_000), 0.0025)[0]
    specks = np.array([[0.1, 0, 0], [0, 0.12, 0.1], [0, 0.121, 0.1], [-0.09, 0.05, -0.1]])
    found = cloud.isolated(*cloud.nearest(np.concatenate([surface, specks]), 12))
    assert found[-4:].all()
    assert not found[:-4].any()


@pytest.mark.parametrize("step", [0.0025, 0.005])
def test_a_thin_wire_is_not_taken_for_specks(step):
    wire = np.stack([0.05 + np.arange(20) * step, np.zeros(20), np.zeros(20)], axis=-1)
    points = np.concatenate([cloud.voxel_downsample(sphere(40_000), 0.0025)[0], wire])
    assert not cloud.isolated(*cloud.nearest(points, 12)).any()


def test_sparse_flat_parts_are_not_taken_for_specks(rng):
    dense = sphere(20_000, 0.02)
    axis = np.linspace(-0.2, 0.2, 12)
    sparse = np.stack(np.meshgrid(axis, axis, [-0.1]), axis=-1).reshape(-1, 3)
    assert not cloud.isolated(*cloud.nearest(np.concatenate([dense, sparse]), 12)).any()


def test_a_few_points_hold_no_specks():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [50, 0, 0]])
    assert not cloud.isolated(*cloud.nearest(points, 12)).any()


def test_normals_of_a_sphere_point_out():
    points = sphere(4000)
    cosine = np.einsum("ni,ni->n", normals_of(points), points / 0.05)
    assert cosine.min() > 0.99


def test_normals_of_a_box_point_out(rng):
    points, true = box_surface((0.03, 0.05, 0.1), 60_000, rng)
    centroids, inverse = cloud.voxel_downsample(points, 0.0025)
    means = cloud.voxel_means(true, inverse, len(centroids))
    on_one_face = np.linalg.norm(means, axis=1) > 0.99
    cosine = np.einsum("ni,ni->n", normals_of(centroids), means)[on_one_face]
    assert cosine.min() > 0
    assert np.mean(cosine > 0.98) > 0.8  # near an edge the neighbourhood bends round it


def test_signs_go_round_the_rim_of_a_thin_plate(rng):
    points, true = box_surface((0.08, 0.08, 0.003), 60_000, rng)
    centroids, inverse = cloud.voxel_downsample(points, 0.0025)
    means = cloud.voxel_means(true, inverse, len(centroids))
    assert (np.einsum("ni,ni->n", normals_of(centroids), means) > -1e-3).mean() > 0.999


def test_every_separate_part_is_turned_out():
    parts = [sphere(2000, 0.02), sphere(2000, 0.03) + np.array([0.2, 0, 0]), sphere(500, 0.01) + np.array([0, 0.3, 0])]
    outward = np.concatenate([part - part.mean(axis=0) for part in parts])
    assert (np.einsum("ni,ni->n", normals_of(np.concatenate(parts)), outward) > 0).all()


def test_normals_turn_to_the_sensor():
    points = sphere(4000)
    sensor = np.array([0.0, 0.0, 0.5])
    towards = np.einsum("ni,ni->n", normals_of(points, sensor_origin=sensor), sensor - points)
    assert towards.min() >= 0


def test_normals_turn_with_the_cloud(rng):
    points = sphere(3000) * np.array([1.0, 0.7, 1.6])
    R = rotation_exp(np.array([0.3, -1.1, 0.6]))
    shift = np.array([1.0, 2.0, -0.5])
    assert np.allclose(normals_of(points) @ R.T, normals_of(points @ R.T + shift), atol=1e-6)


def test_a_flat_sheet_faces_up(rng):
    points = np.concatenate([rng.uniform(-0.1, 0.1, size=(3000, 2)), np.zeros((3000, 1))], axis=1)
    assert np.allclose(normals_of(points), [0, 0, 1])


@pytest.mark.parametrize("n", [1, 2, 5])
def test_few_points_get_unit_normals(n, rng):
    points = rng.normal(size=(n, 3))
    assert np.allclose(np.linalg.norm(normals_of(points), axis=1), 1)


def test_narrowest_width_of_a_box_is_its_shortest_edge_whatever_way_it_is_turned():
    rng = np.random.default_rng(3)
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * [0.05, 0.1, 0.2]
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    assert narrowest_width(corners @ turn.T) == pytest.approx(0.05)
    assert narrowest_width(corners[corners[:, 0] > 0]) == pytest.approx(0.0, abs=1e-9)


def test_narrowest_width_of_a_ball_of_many_points_takes_little_memory():
    ball = sphere(20_000, 0.09)
    tracemalloc.start()
    width = narrowest_width(ball)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert width == pytest.approx(0.18, rel=0.005)
    assert peak < 50e6  # 20,000 corners times 40,000 faces would be 6 GB


def test_least_axis_is_that_of_the_smallest_eigenvalue(rng):
    shape = rng.normal(size=(500, 3, 3)) * 10.0 ** rng.uniform(-3, 0, size=(500, 3, 1))
    matrices = shape @ np.swapaxes(shape, 1, 2)
    values, axes = cloud.least_axis(matrices)
    expected = np.linalg.eigvalsh(matrices)
    assert np.all(np.abs(values - expected[:, 0]) < 1e-10 * expected[:, 2])
    off = np.linalg.norm(np.einsum("nij,nj->ni", matrices, axes) - values[:, None] * axes, axis=1)
    assert np.all(off < 1e-9 * expected[:, 2])
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0)


@pytest.mark.parametrize("values", [(0, 0, 0), (0, 0, 1), (1, 1, 1), (1, 1, 2), (1, 2, 2), (0, 1, 1)])
def test_least_axis_of_equal_eigenvalues_is_one_of_theirs(values, rng):
    turn = rotation_exp(rng.normal(size=(20, 3)))
    matrices = turn @ np.diag(np.array(values, dtype=float)) @ np.swapaxes(turn, 1, 2)
    found, axes = cloud.least_axis(matrices)
    np.testing.assert_allclose(found, values[0], atol=1e-9)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", matrices, axes), values[0] * axes, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0)
