"""The simulated depth camera: exact before its errors, and each error as large as it is said to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from depth_scenes import SHAPE, Box, Setting, camera_at, render
from graspmatch.config import SensorConfig
from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.scene.camera import Camera, pixel_rays
from graspmatch.simulate.camera import NOTHING, Sight, camera_towards, look, table_mesh
from graspmatch.simulate.sensor import shoot

BOX = Box(0.02, -0.03, (0.08, 0.06, 0.1), yaw=0.4)
EXACT = SensorConfig(
    axial_noise=0.0,
    scale_error=0.0,
    tilt_error=0.0,
    disparity_step=0.0,
    dropout=0.0,
    edge_dropout=0.0,
    flying=0.0,
    grazing=np.pi / 2,
)


def mesh_of(box: Box) -> TriangleMesh:
    solid = trimesh.creation.box(extents=box.size)
    turn = trimesh.transformations.rotation_matrix(box.yaw, (0, 0, 1))
    turn[:3, 3] = box.x, box.y, box.z + box.size[2] / 2
    solid.apply_transform(turn)
    return TriangleMesh(np.array(solid.vertices), np.array(solid.faces))


def sight_of(camera: Camera) -> Sight:
    return look(camera, [mesh_of(BOX), table_mesh(0.4)], (SHAPE[1], SHAPE[0]))


@pytest.fixture(scope="module")
def camera() -> Camera:
    return camera_at(45, 0.7)


@pytest.fixture(scope="module")
def sight(camera: Camera) -> Sight:
    return sight_of(camera)


def test_depth_and_bodies_are_those_of_closed_forms(camera: Camera, sight: Sight) -> None:
    depth, thing = render(Setting((BOX,), table=(0.8, 0.8), floor=None, camera=camera))
    agrees = np.abs(sight.depth - depth) < 1e-4
    assert agrees.mean() > 0.9999  # pixels exactly on an edge may fall to either side
    assert np.mean((sight.body == 0) == (thing == 0)) > 0.9999
    assert np.all((sight.body == NOTHING) == (sight.depth == 0))
    up = sight.facing[(sight.body == 1)]
    rays = np.stack([*pixel_rays(camera, SHAPE[1], SHAPE[0]), np.ones(SHAPE)], axis=-1)[sight.body == 1]
    straight = np.abs(rays @ camera.pose[2, :3]) / np.linalg.norm(rays, axis=-1)
    np.testing.assert_allclose(up, straight, atol=1e-4)


def test_the_camera_stands_where_it_is_asked_to_and_looks_at_the_place() -> None:
    centre = np.array([0.1, -0.2, 0.05])
    camera = camera_towards(centre, np.radians(30), np.radians(60), 0.5, np.diag([600.0, 600.0, 1.0]))
    place = camera.pose[:3, 3] - centre
    assert np.linalg.norm(place) == pytest.approx(0.5)
    assert np.arctan2(place[1], place[0]) == pytest.approx(np.radians(30))
    assert np.arcsin(place[2] / 0.5) == pytest.approx(np.radians(60))
    np.testing.assert_allclose(camera.pose[:3, 2], -place / 0.5, atol=1e-12)  # z forward
    assert camera.pose[2, 0] == pytest.approx(0)  # x level
    assert camera.pose[2, 1] < 0  # y down


def test_without_errors_the_sensor_sends_the_truth_in_millimetres(camera: Camera, sight: Sight) -> None:
    shot = shoot(sight, camera, EXACT, np.random.default_rng(0))
    np.testing.assert_allclose(shot.depth / 1000, sight.depth, atol=0.0006)
    np.testing.assert_allclose(shot.camera.pose, camera.pose, atol=1e-12)


def test_noise_grows_with_the_square_of_the_depth(camera: Camera, sight: Sight) -> None:
    shot = shoot(sight, camera, replace(EXACT, axial_noise=0.02), np.random.default_rng(0))
    error = (shot.depth / 1000 - sight.depth) / np.maximum(sight.depth, 0.1) ** 2
    for near, far in ((0.4, 0.65), (0.65, 1.2)):
        band = (sight.depth > near) & (sight.depth < far)
        assert np.std(error[band]) == pytest.approx(0.02, rel=0.1)


def test_a_wrong_scale_is_the_same_everywhere_and_as_large_as_said(camera: Camera, sight: Sight) -> None:
    seen, medians = sight.depth > 0, []
    for seed in range(12):
        shot = shoot(sight, camera, replace(EXACT, scale_error=0.03), np.random.default_rng(seed))
        factor = shot.depth[seen] / 1000 / sight.depth[seen]
        assert np.std(factor) < 0.001
        medians.append(np.median(factor))
    assert 0.015 < np.std(medians) < 0.06


def test_only_edges_fly_and_drop_out(camera: Camera, sight: Sight) -> None:
    shot = shoot(sight, camera, replace(EXACT, flying=0.5, edge_dropout=0.3), np.random.default_rng(0))
    wrong = np.abs(shot.depth / 1000.0 - sight.depth) > 0.001
    assert wrong.any()
    near_edge = np.zeros(SHAPE, dtype=bool)
    for shift in range(-2, 3):
        for axis in (0, 1):
            near_edge |= np.abs(np.roll(sight.depth, shift, axis=axis) - sight.depth) > 0.015
    assert not np.any(wrong & ~near_edge)
    hanging = (shot.depth > 0) & wrong
    assert np.all(shot.depth[hanging] / 1000 < sight.depth.max())


def test_a_miscalibrated_camera_is_off_by_what_is_said(camera: Camera, sight: Sight) -> None:
    config = replace(EXACT, pose_error_position=0.005, pose_error_angle=np.radians(1.0))
    said = [shoot(sight, camera, config, np.random.default_rng(seed)).camera.pose for seed in range(2)]
    for pose in said:
        assert np.linalg.norm(pose[:3, 3] - camera.pose[:3, 3]) == pytest.approx(0.005)
        cosine = (np.trace(pose[:3, :3].T @ camera.pose[:3, :3]) - 1) / 2
        assert np.degrees(np.arccos(cosine)) == pytest.approx(1.0, rel=1e-3)
    assert np.abs(said[0] - said[1]).max() > 1e-3


def test_the_same_seed_makes_the_same_image(camera: Camera, sight: Sight) -> None:
    one, two, other = (shoot(sight, camera, SensorConfig(), np.random.default_rng(seed)).depth for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert np.any(one != other)
