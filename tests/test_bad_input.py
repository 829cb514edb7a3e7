"""What people give by mistake: one line that says what is wrong and what is possible, from the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from depth_scenes import Box, Cylinder, K, Setting, render
from graspmatch.apps.cli import main

SETTING = Setting((Box(-0.12, 0, (0.08, 0.1, 0.12), 0.3), Cylinder(0.1, 0.02, 0.03, 0.1)))
CAMERA = "460,460,319.5,239.5"
TRUE, IDS = render(SETTING)
Captured = pytest.CaptureFixture[str]


def png(path: Path, depth: np.ndarray, steps_per_metre: float) -> Path:
    """A depth image of 16 bits."""
    Image.fromarray(np.clip(np.round(steps_per_metre * depth), 0, 65535).astype(np.uint16)).save(path)
    return path


def npy(path: Path, array: np.ndarray) -> Path:
    np.save(path, array)
    return path


def answer(capsys: Captured, *words: object) -> tuple[int, str, str]:
    """Exit status, the error of the JSON, and what people read."""
    status = main(["plan", "--gripper", "franka_hand", "--device", "cpu", "--json", *map(str, words)])
    output = capsys.readouterr()
    return status, json.loads(output.out).get("error", ""), output.err


def cloud_of(depth: np.ndarray) -> np.ndarray:
    v, u = np.nonzero(depth)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))], axis=-1)
    return depth[v, u][:, None] * rays


CAN = render(Setting((Cylinder(0, 0, 0.03, 0.06),), table=(0, 0), floor=None))[0]
EMPTY = render(Setting(()))[0]
MASK = np.where(IDS == 1, 255, 0).astype(np.uint8)

CASES: dict[str, tuple[Callable[[Path], list], tuple[str, ...]]] = {
    "depth in tenths of a millimetre": (
        lambda at: [png(at / "d.png", TRUE, 10_000), "--intrinsics", CAMERA],
        ("What is seen is 7", "is the unit right (--depth-scale"),
    ),
    "depth in millimetres, told to be metres": (
        lambda at: [png(at / "d.png", TRUE, 1000), "--depth-scale", 1, "--intrinsics", CAMERA],
        ("wrong unit", "--depth-scale", "0.001 (0.73 m)"),
    ),
    "depth in metres, told to be millimetres": (
        lambda at: ["--depth", npy(at / "d.npy", TRUE), "--depth-scale", 0.001, "--intrinsics", CAMERA],
        ("wrong unit", "--depth-scale", "1 (0.73 m)"),
    ),
    "a cloud in millimetres": (
        lambda at: [npy(at / "c.npy", 1000 * cloud_of(TRUE)), "--object", 0],
        ("millimetres", "--unit mm"),
    ),
    "no intrinsics": (lambda at: [png(at / "d.png", TRUE, 1000)], ("intrinsics", "--intrinsics")),
    "intrinsics of another image": (
        lambda at: [png(at / "d.png", TRUE, 1000), "--intrinsics", "1800,1800,1280,960"],
        ("intrinsics",),
    ),
    "a mask of another size": (
        lambda at: [png(at / "d.png", TRUE, 1000), "--intrinsics", CAMERA, "--mask", npy(at / "m.npy", MASK[::2, ::2])],
        ("320 x 240", "640 x 480"),
    ),
    "a mask of nothing": (
        lambda at: [png(at / "d.png", TRUE, 1000), "--intrinsics", CAMERA, "--mask", npy(at / "m.npy", 0 * MASK)],
        ("zero everywhere",),
    ),
    "no plane": (
        lambda at: [png(at / "d.png", CAN, 1000), "--intrinsics", CAMERA],
        ("No support plane was found", "--table"),
    ),
    "nothing on the plane": (
        lambda at: [png(at / "d.png", EMPTY, 1000), "--intrinsics", CAMERA],
        ("Nothing stands on the support plane", "--table"),
    ),
    "nothing seen": (lambda at: [png(at / "d.png", 0 * TRUE, 1000), "--intrinsics", CAMERA], ("depth",)),
    "a number that no object has": (
        lambda at: [png(at / "d.png", TRUE, 1000), "--intrinsics", CAMERA, "--object", 7],
        ("no object 7", "Found: 0:"),
    ),
    "a pixel without an object": (
        lambda at: [png(at / "d.png", TRUE, 1000), "--intrinsics", CAMERA, "--at", "5,5"],
        ("no object at the pixel 5,5", "Found: 0:"),
    ),
}


@pytest.mark.parametrize("name", list(CASES))
def test_bad_input_is_one_clear_line(name: str, tmp_path: Path, capsys: Captured):
    words, expected = CASES[name]
    status, message, shown = answer(capsys, *words(tmp_path))
    assert status == 2, message
    assert message
    assert "unexpected" not in message
    for part in expected:
        assert part in message, message
    assert shown.strip() == f"error: {message}"
    assert "\n" not in message


def test_floats_that_can_only_be_millimetres_are_taken_as_such(tmp_path: Path, capsys: Captured):
    words = ["--depth", npy(tmp_path / "d.npy", 1000 * TRUE), "--intrinsics", CAMERA, "--at", "410,235", "--fast"]
    status, _, shown = answer(capsys, *words)
    assert status == 0
    assert "Note: The depth image is taken as millimetres: its median is 729." in shown


def test_an_object_that_is_too_wide_is_said_to_be(tmp_path: Path, capsys: Captured):
    """A block of 14 cm, of which a camera sees three sides; the hand opens 8 cm. From a view nothing is sure, so those
    that are less sure must be asked not to come out."""
    wide = render(Setting((Box(0, 0, (0.14, 0.14, 0.14), 0.5),)))[0]
    words = [png(tmp_path / "d.png", wide, 1000), "--intrinsics", CAMERA, "--fast", "--ranking.least-confidence", 0.5]
    status, _, shown = answer(capsys, *words)
    assert status == 3
    assert "fell at this stage: " in shown
    assert "mm wide in every direction; franka_hand opens 80 mm wide" in shown
