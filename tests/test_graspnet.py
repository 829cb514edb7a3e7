"""GraspNet's rows: where they put the fingertips, and that poses survive the way out and back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from graspmatch.apps.cli import main
from graspmatch.errors import GraspmatchError
from graspmatch.formats.graspnet import COLUMNS, read_graspnet, write_graspnet
from graspmatch.formats.jaw import jaw
from graspmatch.formats.registry import read_grasps, write_grasps
from graspmatch.geometry import se3
from graspmatch.gripper.load import load_gripper
from graspmatch.scene.shapes import mug
from graspmatch.types import GraspSet, Gripper, Provenance

# Approach along +z at height 0.5, closing along +x: columns x = (0, 0, 1), y = (1, 0, 0), z = x cross y = (0, 1, 0).
ROW = [0.9, 0.05, 0.02, 0.03, 0, 1, 0, 0, 0, 1, 1, 0, 0, 0.1, 0.2, 0.5, -1]


def grasps_of(gripper: Gripper, n: int = 12) -> GraspSet:
    """Random poses of a hand, best first, in all of its preshapes."""
    rng = np.random.default_rng(2)
    rotations = se3.matrix_from_quaternion(se3.random_quaternions(n, rng))
    preshape = np.arange(n) % len(gripper.preshapes)
    joints = np.array([shape.joints for shape in gripper.preshapes])[preshape]
    T = se3.from_parts(rotations, rng.normal(size=(n, 3)))
    return GraspSet(
        joint_names=gripper.joint_names,
        preshape_names=tuple(shape.name for shape in gripper.preshapes),
        T_world_gripper=T,
        T_world_pregrasp=T @ gripper.T_gripper_pregrasp,
        preshape=preshape,
        pregrasp_joints=joints,
        grasp_joints=joints,
        score=np.sort(rng.random(n))[::-1].copy(),
        clearance=np.zeros(n),
        matching_error=np.zeros(n),
        loss=np.zeros(n),
        quality=np.zeros(n),
        fingers_touching=np.full(n, 2),
        tally={"candidates": n},
        provenance=Provenance(gripper.name, gripper.content_hash, "", 0, "cpu", "0", "", {}),
    )


def fingertips(row: np.ndarray) -> np.ndarray:
    """Where the format puts the two fingertips (2, 3)."""
    rotation = row[4:13].reshape(3, 3)
    tip = row[13:16] + row[3] * rotation[:, 0]
    return np.array([tip - row[1] / 2 * rotation[:, 1], tip + row[1] / 2 * rotation[:, 1]])


def test_a_written_row_puts_the_fingertips_where_the_hand_has_them(toy, tmp_path):
    # The toy points down (its z is -z of the world), its y is x of the world, and its palm is 0.3 m up over (0.1, 0.2).
    T = np.array([[0, 1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, -1, 0.3], [0, 0, 0, 1]], dtype=float)
    grasps = grasps_of(toy, 3)
    grasps.T_world_gripper[:] = T
    write_grasps(grasps, tmp_path / "grasps.npy", toy)
    rows = np.load(tmp_path / "grasps.npy", allow_pickle=False)
    assert rows.shape == (3, COLUMNS)
    assert rows.dtype == np.float64
    for row, half in zip(rows, (0.03, 0.021, 0.012), strict=True):  # open, 30 % and 60 % of the 30 mm stroke
        np.testing.assert_allclose(fingertips(row), [[0.1 - half, 0.2, 0.24], [0.1 + half, 0.2, 0.24]], atol=1e-6)
        np.testing.assert_allclose(row[4:13].reshape(3, 3), [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-12)
        assert row[[2, 3, 16]].tolist() == [0.02, 0.02, -1]
    np.testing.assert_array_equal(rows[:, 0], grasps.score)


def test_a_row_that_is_read_puts_the_hands_fingertips_there(toy, tmp_path):
    np.save(tmp_path / "grasps.npy", np.array([ROW]))
    grasps = read_grasps(tmp_path / "grasps.npy", toy)
    assert toy.preshapes[grasps.preshape[0]].joints.tolist() == [0.0]  # 50 mm: 60 mm fit, 42 mm do not
    corners = np.array([[0, -0.025, 0.06], [0, 0.025, 0.06]])  # 50 mm apart in the hand's tip plane
    np.testing.assert_allclose(
        se3.apply(grasps.T_world_gripper[0], corners), [[0.075, 0.2, 0.53], [0.125, 0.2, 0.53]], atol=1e-6
    )
    np.testing.assert_allclose(grasps.T_world_gripper[0, :3, :3] @ [0, 0, 1], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(grasps.T_world_pregrasp[0, :3, 3], [0.1, 0.2, 0.53 - 0.06 - 0.15], atol=1e-6)


@pytest.mark.parametrize(
    ("width", "expected"), [(0.0, 5), (0.0239, 2), (0.024, 2), (0.029, 4), (0.035, 1), (0.055, 0), (0.09, 0)]
)
def test_the_narrowest_preshape_that_is_wide_enough_is_chosen(toy, tmp_path, width, expected):
    np.save(tmp_path / "grasps.npy", np.array([[ROW[0], width, *ROW[2:]]], dtype=np.float32))
    grasps = read_grasps(tmp_path / "grasps.npy", toy)
    assert grasps.preshape.tolist() == [expected]
    assert grasps.pregrasp_joints[0].tolist() == toy.preshapes[expected].joints.tolist()


@pytest.mark.parametrize("name", ["toy", "franka_hand", "robotiq_2f85"])
def test_poses_and_preshapes_of_two_finger_hands_come_back(toy, tmp_path, name):
    hand = toy if name == "toy" else load_gripper(name)
    grasps = grasps_of(hand)
    write_grasps(grasps, tmp_path / "grasps.npy", hand)
    back = read_grasps(tmp_path / "grasps.npy", hand)
    np.testing.assert_allclose(back.T_world_gripper, grasps.T_world_gripper, atol=1e-6)
    np.testing.assert_allclose(back.T_world_pregrasp, grasps.T_world_pregrasp, atol=1e-6)
    # Fingertip preshapes may have the posture of another: what comes back is one that is as wide.
    np.testing.assert_allclose(back.pregrasp_joints, grasps.pregrasp_joints, atol=1e-6)
    np.testing.assert_array_equal(back.score, grasps.score)
    assert back.joint_names == hand.joint_names


@pytest.mark.parametrize(("name", "opening"), [("franka_hand", 0.080), ("robotiq_2f85", 0.085)])
def test_the_jaw_of_an_open_hand_is_as_wide_as_its_maker_says(name, opening):
    hand = load_gripper(name)
    assert jaw(hand.preshapes[0], hand).opening == pytest.approx(opening, abs=5e-4)
    openings = [jaw(preshape, hand).opening for preshape in hand.preshapes if not preshape.is_fingertips]
    assert openings == sorted(openings, reverse=True)


def test_any_hand_starts_from_graspnets_poses(tmp_path):
    barrett = load_gripper("barrett_bh282")
    np.save(tmp_path / "grasps.npy", np.array([ROW]))
    grasps = read_grasps(tmp_path / "grasps.npy", barrett)
    R = grasps.T_world_gripper[0, :3, :3]
    np.testing.assert_allclose(R @ barrett.approach, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(R @ barrett.closing, [1, 0, 0], atol=1e-9)
    fingers = barrett.preshapes[grasps.preshape[0]].finger_outlines
    foremost = max(se3.apply(grasps.T_world_gripper[0], outline[0])[:, 2].max() for outline in fingers)
    assert foremost == pytest.approx(0.53)


def test_hands_of_more_fingers_are_not_written(tmp_path):
    barrett = load_gripper("barrett_bh282")
    with pytest.raises(GraspmatchError, match=r"two fingers, barrett_bh282 has 3\. Possible: \.npz, \.yaml"):
        write_graspnet(grasps_of(barrett), tmp_path / "grasps.npy", barrett)
    assert not (tmp_path / "grasps.npy").exists()


def test_rows_come_back_best_first_and_what_they_do_not_say_is_unknown(toy, tmp_path):
    rows = np.tile(ROW, (3, 1))
    rows[:, 0] = [0.2, 0.8, 0.5]
    np.save(tmp_path / "grasps.npy", rows)
    grasps = read_graspnet(tmp_path / "grasps.npy", toy)
    assert grasps.score.tolist() == [0.8, 0.5, 0.2]
    assert np.isnan(grasps.grasp_joints).all()
    assert np.isnan(grasps.clearance).all()
    assert (grasps.fingers_touching == -1).all()


def test_an_empty_group_is_an_empty_set(toy, tmp_path):
    np.save(tmp_path / "grasps.npy", np.zeros((0, COLUMNS)))
    assert len(read_graspnet(tmp_path / "grasps.npy", toy)) == 0
    write_graspnet(grasps_of(toy, 0), tmp_path / "again.npy", toy)
    assert np.load(tmp_path / "again.npy").shape == (0, COLUMNS)


def changed(column: int, value: float) -> np.ndarray:
    """The row with another number."""
    row = np.array([ROW], dtype=float)
    row[0, column] = value
    return row


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (np.zeros((5, 3)), r"shape \(5, 3\), expected floats of the shape \(n, 17\)"),
        (np.zeros(17), r"shape \(17,\)"),
        (np.zeros((2, 17), dtype=int), "holds int64"),
        (changed(1, np.nan), "row 0 has a number that is not finite"),
        (changed(15, np.inf), "row 0 has a number that is not finite"),
        (changed(4, 0.1), "row 0 are no rotation"),
        (changed(5, -1), "row 0 are no rotation"),  # a mirror
    ],
)
def test_what_is_no_grasp_group_is_one_clear_line(toy, tmp_path, rows, said):
    np.save(tmp_path / "grasps.npy", rows)
    with pytest.raises(GraspmatchError, match=said) as caught:
        read_graspnet(tmp_path / "grasps.npy", toy)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"words", b"\x93NUMPY\x01\x00", b"PK\x03\x04"])
def test_what_is_no_array_is_one_clear_line(toy, tmp_path, content):
    (tmp_path / "grasps.npy").write_bytes(content)
    with pytest.raises(GraspmatchError, match=r"no \.npy file of numbers") as caught:
        read_graspnet(tmp_path / "grasps.npy", toy)
    assert "\n" not in str(caught.value)


def test_pickles_and_missing_files_are_refused(toy, tmp_path):
    np.save(tmp_path / "grasps.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(GraspmatchError, match=r"no \.npy file of numbers"):
        read_graspnet(tmp_path / "grasps.npy", toy)
    with pytest.raises(GraspmatchError, match="No such file"):
        read_graspnet(tmp_path / "missing.npy", toy)


def test_reading_without_a_hand_says_what_is_missing(tmp_path):
    np.save(tmp_path / "grasps.npy", np.array([ROW]))
    with pytest.raises(GraspmatchError, match=r"read_grasps\(path, gripper\)"):
        read_grasps(tmp_path / "grasps.npy")


def test_a_plan_starts_from_graspnets_poses_and_writes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import trimesh

    trimesh.Trimesh(mug().vertices, mug().faces).export(str(tmp_path / "mug.stl"))
    # Straight down on either side of the wall that is away from the handle, 1 cm into the mug of 9 cm.
    rows = np.array([[0.9, 0.03, 0.02, 0.02, 0, 1, 0, 0, 0, -1, -1, 0, 0, -0.033, 0, 0.1, -1]])
    np.save(tmp_path / "starts.npy", rows)
    words = ["--gripper", "franka_hand", "--device", "cpu", "--json", "--quiet"]
    words += ["--seeds", str(tmp_path / "starts.npy"), "-o", str(tmp_path / "out.npy")]
    assert main(["plan", str(tmp_path / "mug.stl"), *words]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["tally"]["candidates"] == 10  # the one pose with every preshape
    written = np.load(tmp_path / "out.npy")
    assert written.shape == (len(record["grasps"]), COLUMNS)
    np.testing.assert_allclose(written[:, 0], [grasp["score"] for grasp in record["grasps"]])
