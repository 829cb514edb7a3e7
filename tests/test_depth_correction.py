"""Depth that lies: scale and tilt recovered from the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from depth_scenes import Box, Cylinder, K, Setting, camera_at, noisy, render
from graspmatch.errors import GraspmatchError
from graspmatch.geometry.se3 import from_parts, rotation_exp
from graspmatch.scene.camera import Camera, pixel_rays
from graspmatch.scene.correct import correct_depth, levelled
from graspmatch.scene.depth import DepthImage, depth_image
from graspmatch.scene.scene import Scene

Array = np.ndarray

SETTING = Setting((Box(-0.1, 0.05, (0.1, 0.14, 0.12), 0.4), Cylinder(0.12, 0.0, 0.035, 0.11)))
UP = SETTING.camera.pose[2, :3]
HEIGHT = float(SETTING.camera.pose[2, 3])
TOLERANCE = 0.002
"""Median error of the depth after the correction [m], noise of 0.7 mm in it; a scale error of 3 % is 20 mm here."""


def lying(scale: float, right: float, down: float, seed: int = 0) -> tuple[DepthImage, Array, Array]:
    """What a camera measures whose depth is off by these factors; the true depth; the thing that each pixel sees."""
    true, ids = render(SETTING)
    x, y = pixel_rays(SETTING.camera, 640, 480)
    measured = noisy(true * scale * (1 + right * x + down * y), np.random.default_rng(seed))
    return depth_image(measured, Camera(K)), true, ids


def median_error(image: DepthImage, true: Array, where: Array) -> float:
    return float(np.nanmedian(np.abs(image.depth - true)[where & (true > 0)]))


@pytest.mark.parametrize(
    ("scale", "right", "down"), [(1.03, 0, 0), (0.97, 0, 0), (1.03, 0.05, -0.03), (0.95, -0.04, 0.06), (1.0, 0, 0)]
)
def test_scale_and_tilt_are_undone_on_table_and_objects(scale: float, right: float, down: float) -> None:
    image, true, ids = lying(scale, right, down)
    corrected, found = correct_depth(image, up_camera=UP, camera_height=HEIGHT)
    assert found.scale == pytest.approx(1 / scale, abs=0.002)
    near = true < 1.2  # the floor is another plane
    assert median_error(corrected, true, near) < TOLERANCE
    for thing in (0, 1):
        assert median_error(corrected, true, ids == thing) < TOLERANCE
    if scale != 1:
        assert median_error(image, true, near) > 5 * TOLERANCE


def test_the_scale_alone_follows_from_the_height_of_the_camera() -> None:
    image, true, _ = lying(1.03, 0, 0)
    corrected, found = correct_depth(image, camera_height=HEIGHT)
    assert found.tilt.tolist() == [0, 0]
    assert median_error(corrected, true, true < 1.2) < TOLERANCE


def test_the_tilt_alone_follows_from_the_direction_of_the_table() -> None:
    image, true, _ = lying(1.0, 0.05, -0.03)
    corrected, found = correct_depth(image, up_camera=UP)
    assert found.scale == 1
    np.testing.assert_allclose(found.tilt, [-0.05, 0.03], atol=0.005)
    assert median_error(corrected, true, true < 1.2) < TOLERANCE


@pytest.mark.parametrize(
    ("known", "expected"),
    [
        ({"camera_height": 0.7 * HEIGHT}, "no error of a camera"),
        ({"camera_height": -0.2}, "inverse"),
        ({}, "needed"),
        ({"up_camera": np.array([np.sin(0.35), -np.cos(0.35), 0.0])}, "tilted|No support plane|still"),
    ],
)
def test_what_is_no_error_of_a_camera_is_refused(known: dict, expected: str) -> None:
    image, _, _ = lying(1.0, 0, 0)
    with pytest.raises(GraspmatchError, match=expected):
        correct_depth(image, **known)


def test_a_scene_with_a_known_table_has_its_object_in_the_right_place() -> None:
    image, _, _ = lying(1.03, 0.02, -0.02)
    placed = replace(image, camera=SETTING.camera)
    scene = Scene.from_depth(
        placed, table=0.0, at=pixel_of(np.array([0.12, 0.0, 0.06])), correct="depth", complete=False
    )
    assert any("scaled by 0.97" in note for note in scene.notes)
    top = float(np.percentile(scene.target.points[:, 2], 99))
    assert top == pytest.approx(0.11, abs=0.004)
    front = scene.target.points[np.argmin(scene.target.points[:, 1])]
    assert front[1] == pytest.approx(-0.035, abs=0.004)


def test_without_the_correction_the_object_is_elsewhere() -> None:
    image, _, _ = lying(1.03, 0.0, 0.0)
    placed = replace(image, camera=SETTING.camera)
    scene = Scene.from_depth(placed, at=pixel_of(np.array([0.12, 0.0, 0.06])), correct="off")
    assert abs(float(np.percentile(scene.target.points[:, 2], 99)) - 0.11) > 0.008


def pixel_of(point_world: Array) -> tuple[float, float]:
    """Column and row that see a point."""
    T = np.linalg.inv(SETTING.camera.pose)
    x, y, z = K @ (T[:3, :3] @ point_world + T[:3, 3])
    return float(x / z), float(y / z)


def test_a_height_without_a_pose_is_refused() -> None:
    image, _, _ = lying(1.0, 0, 0)
    with pytest.raises(GraspmatchError, match="camera's pose"):
        Scene.from_depth(image, table=0.0)


def test_the_camera_of_these_tests_stands_where_it_looks_from() -> None:
    assert camera_at(45, 0.7).pose[2, 3] == pytest.approx(0.03 + 0.7 * np.sin(np.pi / 4))


def test_half_of_a_wrong_pose_is_undone_where_the_table_is_known() -> None:
    image, _, _ = lying(1.0, 0.0, 0.0)
    lean = from_parts(rotation_exp(np.array([0.02, 0.0, 0.0])), np.zeros(3))
    placed = replace(image, camera=SETTING.camera.placed(SETTING.camera.pose @ lean))
    front = {}
    for correct in ("depth", "auto"):
        at = pixel_of(np.array([0.12, 0.0, 0.06]))
        scene = Scene.from_depth(placed, table=0.0, at=at, correct=correct, complete=False)
        front[correct] = float(np.percentile(scene.target.points[:, 1], 1)) - -0.035
    assert abs(front["depth"]) > 0.012
    assert abs(front["auto"]) < 0.65 * abs(front["depth"])


def test_a_table_that_leans_too_much_is_no_matter_of_calibration() -> None:
    image, _, _ = lying(1.0, 0.0, 0.0)
    lean = from_parts(rotation_exp(np.array([0.1, 0.0, 0.0])), np.zeros(3))
    placed = replace(image, camera=SETTING.camera.placed(SETTING.camera.pose @ lean))
    np.testing.assert_array_equal(levelled(placed).camera.pose, placed.camera.pose)
    straight = replace(image, camera=SETTING.camera)
    np.testing.assert_allclose(levelled(straight).camera.pose, SETTING.camera.pose, atol=2e-3)
