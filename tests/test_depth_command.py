"""Captures on the command line: from options to the scene."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from depth_scenes import Box, Cylinder, K, Setting, noisy, render
from graspmatch.apps.capture import read_scene
from graspmatch.apps.cli import main, parse
from graspmatch.apps.options import Plan
from graspmatch.errors import GraspmatchError
from graspmatch.geometry.se3 import quaternion_from_matrix
from graspmatch.scene.scene import Scene

SETTING = Setting((Box(-0.12, 0, (0.08, 0.1, 0.12), 0.3), Cylinder(0.1, 0.02, 0.03, 0.1)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A depth image, its intrinsics, pose and mask, and the same as clouds."""
    folder = tmp_path_factory.mktemp("capture")
    true, ids = render(SETTING)
    depth = noisy(true, np.random.default_rng(0))
    Image.fromarray(np.round(1000 * depth).astype(np.uint16)).save(folder / "depth.png")
    Image.fromarray(np.where(ids == 1, 255, 0).astype(np.uint8)).save(folder / "mask.png")
    (folder / "k.yaml").write_text(f"width: 640\nheight: 480\nk: {K.ravel().tolist()}\n")
    np.savetxt(folder / "pose.txt", SETTING.camera.pose)
    np.savez(folder / "capture.npz", depth=depth, K=K)
    points = np.where(depth > 0, depth, np.nan)[..., None] * np.dstack(
        [*np.meshgrid((np.arange(640) - K[0, 2]) / K[0, 0], (np.arange(480) - K[1, 2]) / K[1, 1]), np.ones(depth.shape)]
    )
    np.save(folder / "cloud.npy", points[np.isfinite(points[..., 2])])
    return folder


def scene_of(folder: Path, *words: str) -> Scene:
    """The scene of the options of a plan; names of files in the folder are made paths."""
    paths = [str(folder / word) if (folder / word).is_file() else word for word in words]
    command = parse(["plan", "--gripper", "kinova_kg3", *paths])
    assert isinstance(command, Plan)
    return read_scene(command.input, command.capture, table="auto", unit=command.unit, obstacles=command.obstacles)


WAYS = {
    "image, number": ["--depth", "depth.png", "--intrinsics", "k.yaml", "--object", "1"],
    "image as input": ["depth.png", "--intrinsics", "k.yaml", "--object", "1"],
    "image, mask": ["--depth", "depth.png", "--intrinsics", "k.yaml", "--mask", "mask.png"],
    "image, numbers as intrinsics": ["--depth", "depth.png", "--intrinsics", "460,460,319.5,239.5", "--object", "1"],
    "one file": ["capture.npz", "--object", "1"],
    "cloud": ["cloud.npy", "--object", "1"],
}


@pytest.mark.parametrize("name", list(WAYS))
def test_every_way_leads_to_the_same_object(name: str, folder: Path) -> None:
    scene = scene_of(folder, *WAYS[name])
    T = SETTING.camera.pose
    centre_world = T[:3, :3] @ scene.centre_of_mass + T[:3, 3]
    np.testing.assert_allclose(centre_world, [0.1, 0.0, 0.07], atol=0.02)
    assert scene.table is not None


def test_a_pose_makes_the_world(folder: Path) -> None:
    T = SETTING.camera.pose
    numbers = ",".join(str(value) for value in (*T[:3, 3], *quaternion_from_matrix(T[:3, :3])))
    for pose in (str(folder / "pose.txt"), numbers):
        scene = scene_of(folder, "depth.png", "--intrinsics", "k.yaml", f"--camera-pose={pose}", "--mask", "mask.png")
        np.testing.assert_allclose(scene.centre_of_mass, [0.1, 0.0, 0.07], atol=0.02)


def test_the_largest_object_is_taken_and_the_others_are_listed(folder: Path) -> None:
    scene = scene_of(folder, "depth.png", "--intrinsics", "k.yaml")
    assert any("2 objects were found, and number 0 was taken" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], "Nothing to grasp"),
        (["depth.png"], "needs the camera's intrinsics"),
        (["cloud.npy", "--depth", "depth.png"], "one of them is enough"),
        (["cloud.npy", "--intrinsics", "k.yaml"], "say which: --object 0"),
        (["depth.png", "--intrinsics", "k.yaml", "--obstacles", "cloud.npy"], "leave out --obstacles"),
        (["depth.png", "--intrinsics", "k.yaml", "--at", "here"], "as 320,240"),
        (["depth.png", "--intrinsics", "k.yaml", "--unit", "m"], "wrong unit"),
        (["depth.png", "--intrinsics", "missing.yaml"], "No such file"),
    ],
)
def test_what_is_missing_or_wrong_is_said(words: list[str], expected: str, folder: Path) -> None:
    with pytest.raises(GraspmatchError, match=expected):
        scene_of(folder, *words)


def test_errors_of_a_capture_are_one_line_and_status_two(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = main(["plan", "--gripper", "kinova_kg3", "--depth", str(folder / "depth.png"), "--json"])
    assert status == 2
    assert "intrinsics" in json.loads(capsys.readouterr().out)["error"]
