"""Depth images: files, units, wrong pixels, lenses, intrinsics and poses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from depth_scenes import SHAPE, Box, K, Setting, camera_at, noisy, render
from graspmatch.errors import GraspmatchError
from graspmatch.geometry.se3 import from_parts, quaternion_from_matrix, rotation_exp
from graspmatch.scene.camera import Camera, camera, distorted, pixel_rays
from graspmatch.scene.camera_file import pose_of_numbers, read_intrinsics, read_pose
from graspmatch.scene.depth import depth_image
from graspmatch.scene.depth_file import read_depth, read_mask

Array = np.ndarray

RAMP = np.linspace(0.4, 1.2, SHAPE[0] * SHAPE[1]).reshape(SHAPE).astype(np.float32)
MILLIMETRES = np.round(1000 * RAMP).astype(np.uint16)
PLUMB_BOB = (0.12, -0.1, 0.001, -0.0008, 0.02)
RATIONAL = (0.12, -0.25, 0.001, -0.0008, 0.1, 0.05, -0.02, 0.01)
CAMERA_INFO = """
image_width: 640
image_height: 480
camera_name: depth
camera_matrix: {rows: 3, cols: 3, data: [460, 0, 319.5, 0, 460, 239.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0.002, 0.05]}
"""


def message(**more: object) -> dict:
    """A camera_info message as JSON has it."""
    return {
        "width": 640,
        "height": 480,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": K.ravel().tolist(),
        **more,
    }


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy", ".npz"])
def test_depth_survives_a_file_of_integers(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"depth{suffix}"
    write_image(path, MILLIMETRES)
    image = depth_image(read_depth(path), camera(K))
    np.testing.assert_allclose(image.depth, MILLIMETRES / 1000, rtol=1e-6)


@pytest.mark.parametrize("suffix", [".tiff", ".npy", ".npz"])
def test_depth_survives_a_file_of_floats(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"depth{suffix}"
    write_image(path, RAMP)
    np.testing.assert_array_equal(read_depth(path), RAMP)


@pytest.mark.parametrize("channel", ["Z", "R", "anything"])
def test_depth_survives_an_exr_file(channel: str, tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR")
    path = tmp_path / "depth.exr"
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {channel: RAMP.copy()}).write(str(path))
    np.testing.assert_array_equal(read_depth(path), RAMP)


def test_millimetres_as_floats_are_recognised_and_said() -> None:
    image = depth_image(1000 * RAMP, camera(K))
    np.testing.assert_allclose(image.depth, RAMP, rtol=1e-6)
    assert any("millimetres" in note for note in image.notes)


@pytest.mark.parametrize(
    ("values", "scale", "hint"),
    [
        (MILLIMETRES, 1.0, "0.001"),
        (RAMP, 0.001, "such as 1 "),
        ((5000 * RAMP * 4).astype(np.uint16) * np.uint16(1), 0.1, "0.0002"),
        ((RAMP * 0.03).astype(np.float32), None, "metres that one step"),
    ],
)
def test_a_wrong_unit_is_refused_with_a_better_one(values: Array, scale: float | None, hint: str) -> None:
    with pytest.raises(GraspmatchError, match="wrong unit") as error:
        depth_image(values, camera(K), metres_per_unit=scale)
    assert hint in str(error.value)


def test_pixels_without_a_measurement_are_nan() -> None:
    depth = RAMP.copy()
    depth[10, 10], depth[20, 20], depth[30, 30], depth[40, 40] = 0, np.nan, np.inf, -1
    image = depth_image(depth, camera(K), drop_edges=False)
    assert np.argwhere(np.isnan(image.depth)).tolist() == [[10, 10], [20, 20], [30, 30], [40, 40]]


def test_an_empty_image_is_refused() -> None:
    with pytest.raises(GraspmatchError, match="Only 0 of"):
        depth_image(np.zeros(SHAPE, dtype=np.uint16), camera(K))


def test_flying_pixels_go_and_true_edges_stay() -> None:
    true, ids = render(Setting((Box(0, 0, (0.1, 0.1, 0.15)),), camera=camera_at(50, 0.7)))
    flying = true.copy()
    rows = np.arange(200, 240)
    edge = np.argmax(ids[rows] == 0, axis=1) - 1  # the last pixel of the table before the box
    flying[rows, edge] = (true[rows, edge] + true[rows, edge + 1]) / 2
    is_deep = true[rows, edge] - true[rows, edge + 1] > 0.05
    kept = np.isfinite(depth_image(flying, camera(K)).depth)
    assert is_deep.sum() > 20
    assert not kept[rows, edge][is_deep].any()
    assert kept[rows, edge + 1].all()
    untouched = np.isfinite(depth_image(true, camera(K)).depth)
    assert untouched[ids == 0].mean() > 0.995


@pytest.mark.parametrize("lens", [PLUMB_BOB[:4], PLUMB_BOB, RATIONAL])
def test_rays_come_back_through_the_lens(lens: tuple[float, ...]) -> None:
    of = camera(K, distortion=lens)
    x, y = pixel_rays(of, 640, 480)
    back_x, back_y = distorted(x.astype(float), y.astype(float), of.distortion)
    rows, columns = np.indices(SHAPE)
    np.testing.assert_allclose(back_x * K[0, 0] + K[0, 2], columns, atol=0.05)
    np.testing.assert_allclose(back_y * K[1, 1] + K[1, 2], rows, atol=0.05)
    assert np.abs(x * K[0, 0] + K[0, 2] - columns).max() > 1  # the lens does something


def test_a_flat_wall_seen_through_a_lens_is_flat() -> None:
    of = camera(K, distortion=RATIONAL)
    x, y = pixel_rays(of, 640, 480)
    wall = 1.0 / (1.0 + 0.2 * x - 0.1 * y)  # the plane z + 0.2 x - 0.1 y = 1
    points = depth_image(wall, of, drop_edges=False).points.reshape(-1, 3)
    np.testing.assert_allclose(points @ [0.2, -0.1, 1.0], 1.0, atol=1e-5)


def test_intrinsics_are_read_from_a_ros_camera_file(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(CAMERA_INFO)
    read = read_intrinsics(path)
    np.testing.assert_array_equal(read.K, K)
    np.testing.assert_array_equal(read.distortion, [0.1, -0.2, 0.001, 0.002, 0.05])
    assert read.size == (640, 480)


@pytest.mark.parametrize(
    "content",
    [
        message(),
        {"K": K.tolist()},
        {"fx": 460, "fy": 460, "cx": 319.5, "cy": 239.5},
        {"fx": 460, "fy": 460, "ppx": 319.5, "ppy": 239.5, "model": "distortion.brown_conrady", "coeffs": [0.0] * 5},
        {"width": 640, "height": 480, "intrinsic_matrix": K.T.ravel().tolist()},
        {"camera_info": message()},
    ],
    ids=["ros message", "matrix", "four numbers", "realsense", "open3d", "nested"],
)
def test_intrinsics_are_read_from_json(content: dict, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content))
    np.testing.assert_array_equal(read_intrinsics(path).K, K)


def test_intrinsics_are_read_from_arrays_and_text(tmp_path: Path) -> None:
    np.save(tmp_path / "K.npy", K)
    np.savez(tmp_path / "K.npz", K=K)
    np.savetxt(tmp_path / "K.txt", K)
    for name in ("K.npy", "K.npz", "K.txt"):
        np.testing.assert_allclose(read_intrinsics(tmp_path / name).K, K)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"width": 640}, "no intrinsics among width"),
        (message(k=[0.0] * 9), "focal lengths"),
        (message(distortion_model="equidistant", d=[0.1, 0, 0, 0]), "Known: plumb_bob"),
        ({"K": [[1, 2], [3, 4]]}, "principal point|intrinsics|focal"),
    ],
)
def test_unusable_intrinsics_are_refused(content: dict, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content))
    with pytest.raises(GraspmatchError, match=expected):
        read_intrinsics(path)


def test_intrinsics_of_another_image_are_refused() -> None:
    with pytest.raises(GraspmatchError, match="1280 x 720"):
        depth_image(RAMP, camera(K, size=(1280, 720)))
    far_off = K + np.array([[0, 0, 640], [0, 0, 360], [0, 0, 0]])
    with pytest.raises(GraspmatchError, match="outside the depth image"):
        depth_image(RAMP, camera(far_off))


def test_a_pose_is_the_same_however_it_is_written(tmp_path: Path) -> None:
    T = from_parts(rotation_exp(np.array([0.3, -2.0, 0.5])), np.array([0.1, -0.4, 0.6]))
    w, x, y, z = (float(value) for value in quaternion_from_matrix(T[:3, :3]))
    position = dict(zip("xyz", map(float, T[:3, 3]), strict=True))
    np.savetxt(tmp_path / "pose.txt", T)
    np.save(tmp_path / "pose.npy", T)
    (tmp_path / "matrix.json").write_text(json.dumps({"T_world_camera": T.tolist()}))
    ros = {
        "header": {"frame_id": "base"},
        "pose": {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}},
    }
    (tmp_path / "ros.json").write_text(json.dumps(ros))
    for name in ("pose.txt", "pose.npy", "matrix.json", "ros.json"):
        np.testing.assert_allclose(read_pose(tmp_path / name), T, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(pose_of_numbers(np.array([*T[:3, 3], w, x, y, z])), T, atol=1e-6)


def test_a_pose_that_is_not_rigid_is_refused() -> None:
    with pytest.raises(GraspmatchError, match="rotation"):
        Camera(K).placed(np.diag([2.0, 2.0, 2.0, 1.0]))
    with pytest.raises(GraspmatchError, match="quaternion w x y z"):
        pose_of_numbers(np.array([0, 0, 0, 1.0, 1.0, 0, 0]))


def test_pictures_are_no_depth_images(tmp_path: Path) -> None:
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)).save(tmp_path / "rgb.png")
    Image.fromarray(np.zeros((48, 64), dtype=np.uint8)).save(tmp_path / "grey.png")
    (tmp_path / "torn.png").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(GraspmatchError, match="colour image"):
        read_depth(tmp_path / "rgb.png")
    with pytest.raises(GraspmatchError, match="8 bits"):
        read_depth(tmp_path / "grey.png")
    with pytest.raises(GraspmatchError, match="could not be read as PNG"):
        read_depth(tmp_path / "torn.png")
    (tmp_path / "depth.bin").touch()
    with pytest.raises(GraspmatchError, match=r"Known: \.png"):
        read_depth(tmp_path / "depth.bin")


def test_a_mask_of_colours_marks_what_is_not_black(tmp_path: Path) -> None:
    mask = np.zeros((48, 64, 3), dtype=np.uint8)
    mask[10:20, 10:20, 1] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    assert np.count_nonzero(read_mask(tmp_path / "mask.png")) == 100


def test_noise_of_the_test_camera_is_that_of_a_cheap_one() -> None:
    true, _ = render(Setting(()))
    off = (noisy(true, np.random.default_rng(0)) - true)[true > 0]
    assert 0.0005 < np.median(np.abs(off)) < 0.005


def write_image(path: Path, values: Array) -> None:
    """Write by suffix."""
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez(path, depth=values)
    else:
        Image.fromarray(values).save(path)
