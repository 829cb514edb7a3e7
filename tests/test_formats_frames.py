"""Where each format's numbers put the fingers: a grasp drawn by hand, the same in every file."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import h5py
import numpy as np
import pytest
import yaml

from graspmatch.formats.moveit import read_moveit, write_moveit
from graspmatch.formats.registry import read_grasps, write_grasps
from graspmatch.geometry import se3
from graspmatch.gripper.load import load_gripper
from graspmatch.types import GraspSet, Gripper
from test_graspnet import grasps_of

# The Franka Hand points straight down, its base 30 cm above (0.1, 0.2), and closes along the world's x. Its frame has z
# along the fingers and y along the closing: y is the world's x, z is the world's -z, and x = y cross z the world's y.
T_WORLD_HAND = np.array([[0, 1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, -1, 0.3], [0, 0, 0, 1]], dtype=float)
# ACRONYM and GraspGen have x along the closing: x is the world's x, z the world's -z, y = z cross x the world's -y.
T_WORLD_CANONICAL = np.array([[1, 0, 0, 0.1], [0, -1, 0, 0.2], [0, 0, -1, 0.3], [0, 0, 0, 1]], dtype=float)
# The fingers are 11.24 cm long from the base and 8 cm apart when open: tips at x = 0.1 -+ 0.04, y = 0.2, z = 0.1876.
TIPS = np.array([[0.06, 0.2, 0.1876], [0.14, 0.2, 0.1876]])
PREGRASP = [0.1, 0.2, 0.45]
# How ACRONYM's own tools draw the hand in their frame: the ends of the fingers [m].
ACRONYM_TIPS = np.array([[-0.041, 0, 0.11217], [0.041, 0, 0.11217]])


@pytest.fixture(scope="module")
def franka() -> Gripper:
    return load_gripper("franka_hand")


@pytest.fixture
def drawn(franka: Gripper) -> GraspSet:
    """The grasp of the drawing, with the hand wide open."""
    grasps = grasps_of(franka, 1)
    T = T_WORLD_HAND[None]
    return dataclasses.replace(
        grasps,
        T_world_gripper=T,
        T_world_pregrasp=T @ se3.translation(np.array([0.0, 0.0, -0.15])),
        grasp_joints=np.array([[0.0125]]),
        score=np.array([0.75]),
    )


def fingertips(grasps: GraspSet, hand: Gripper) -> np.ndarray:
    """Where the inner faces of the fingers' meshes meet the plane of their tips at the first grasp (2, 3)."""
    tips = []
    for outline in (outlines[0] for outlines in hand.preshapes[grasps.preshape[0]].finger_outlines):
        across = outline @ hand.closing
        tips.append((outline @ hand.approach).max() * hand.approach + across[np.argmin(np.abs(across))] * hand.closing)
    tips_world = se3.apply(grasps.T_world_gripper[0], np.array(tips))
    return tips_world[np.argsort(tips_world[:, 0])]


def assert_drawn(grasps: GraspSet, hand: Gripper) -> None:
    """Pose, pregrasp and the mesh's own fingertips are those of the drawing."""
    np.testing.assert_allclose(grasps.T_world_gripper[0], T_WORLD_HAND, atol=1e-6)
    np.testing.assert_allclose(grasps.T_world_pregrasp[0, :3, 3], PREGRASP, atol=1e-6)
    np.testing.assert_allclose(fingertips(grasps, hand), TIPS, atol=1e-6)


def test_the_drawing_is_right(drawn, franka):
    assert_drawn(drawn, franka)
    np.testing.assert_allclose(
        se3.apply(T_WORLD_CANONICAL, ACRONYM_TIPS), TIPS, atol=1.1e-3
    )  # their marker is 82 mm wide


@pytest.mark.parametrize("suffix", [".npz", ".yaml", ".moveit.yaml", ".npy", ".h5", ".json"])
def test_every_format_brings_the_fingers_back_to_where_they_were(drawn, franka, tmp_path, suffix):
    path = tmp_path / f"drawn{suffix}"
    write_grasps(drawn, path, franka)
    back = read_grasps(path, franka)
    assert_drawn(back, franka)
    np.testing.assert_array_equal(back.pregrasp_joints, [[0.04]])
    np.testing.assert_array_equal(back.score, [0.75])
    assert back.joint_names == ("finger_joint1",)
    if suffix == ".npy":  # GraspNet has no joints
        assert np.isnan(back.grasp_joints).all()
    else:
        np.testing.assert_array_equal(back.grasp_joints, [[0.0125]])


def test_isaac_has_the_pose_of_the_base_link(drawn, franka, tmp_path):
    write_grasps(drawn, tmp_path / "drawn.yaml", franka)
    entry = yaml.safe_load((tmp_path / "drawn.yaml").read_text())["grasps"]["grasp_0"]
    assert entry["position"] == [0.1, 0.2, 0.3]
    # Half a turn about the axis between x and y: it swaps them and turns z over.
    quaternion = [entry["orientation"]["w"], *entry["orientation"]["xyz"]]
    np.testing.assert_allclose(np.abs(quaternion), [0, 0.5**0.5, 0.5**0.5, 0], atol=1e-12)
    assert entry["cspace_position"] == {"finger_joint1": 0.0125}


def test_acronym_has_the_base_with_x_along_the_closing(drawn, franka, tmp_path):
    write_grasps(drawn, tmp_path / "drawn.h5", franka)
    file: Any  # h5py's types know not what a name leads to
    with h5py.File(tmp_path / "drawn.h5") as file:
        transforms = np.array(file["grasps/transforms"])
        np.testing.assert_allclose(transforms, [T_WORLD_CANONICAL], atol=1e-12)
        np.testing.assert_allclose(se3.apply(transforms[0], ACRONYM_TIPS), TIPS, atol=1.1e-3)
        success = np.array(file["grasps/qualities/flex/object_in_gripper"])
        assert (success.tolist(), success.dtype.kind) == ([1], "i")
        assert transforms.dtype == np.float64
        assert file["gripper/type"][()] == b"panda"
        assert file["gripper/configuration"][()].tolist() == [0.04]
        assert isinstance(file["object/file"][()], bytes)
        assert file["object/scale"][()] == 1.0
        assert file["object/com"].shape == (3,)
        assert np.isnan(file["object/mass"][()])
        assert file["grasps/qualities/flex/object_motion_during_shaking_angular"].shape == (1,)


def test_a_file_as_in_the_acronym_data_set_is_read(franka, tmp_path):
    with h5py.File(tmp_path / "Mug_0.01.h5", "w") as file:
        file["grasps/transforms"] = np.array([np.eye(4), T_WORLD_CANONICAL])
        file["grasps/qualities/flex/object_in_gripper"] = np.array([0, 1])
        file["gripper/type"] = b"panda"
        file["gripper/configuration"] = np.array([0.04])
        file["object/file"] = b"meshes/Mug/mug.obj"
        file["object/scale"] = 0.01
    grasps = read_grasps(tmp_path / "Mug_0.01.h5", franka)
    assert_drawn(grasps, franka)  # the one that held comes first
    assert grasps.score.tolist() == [1, 0]
    assert grasps.provenance.gripper == "franka_hand"
    assert grasps.pregrasp_joints.tolist() == [[0.04], [0.04]]
    assert np.isnan(grasps.grasp_joints).all()


def test_graspgen_has_the_base_with_x_along_the_closing(drawn, franka, tmp_path):
    write_grasps(drawn, tmp_path / "drawn.json", franka)
    document = json.loads((tmp_path / "drawn.json").read_text())
    np.testing.assert_allclose(document["grasps"]["transforms"], [T_WORLD_CANONICAL], atol=1e-12)
    assert document["grasps"]["object_in_gripper"] == [True]
    assert document["object"]["scale"] == 1.0
    only_theirs = {"object": document["object"], "grasps": document["grasps"]}
    (tmp_path / "theirs.json").write_text(json.dumps(only_theirs))
    back = read_grasps(tmp_path / "theirs.json", franka)
    assert_drawn(back, franka)
    assert back.score.tolist() == [1.0]


def test_transforms_that_another_tool_moved_count_more_than_our_block(drawn, franka, tmp_path):
    write_grasps(drawn, tmp_path / "drawn.json", franka)
    document = json.loads((tmp_path / "drawn.json").read_text())
    document["grasps"]["transforms"][0][2][3] += 0.05
    (tmp_path / "moved.json").write_text(json.dumps(document))
    moved = read_grasps(tmp_path / "moved.json", franka)
    np.testing.assert_allclose(moved.T_world_gripper[0, :3, 3], [0.1, 0.2, 0.35], atol=1e-9)
    np.testing.assert_allclose(moved.T_world_pregrasp[0, :3, 3], [0.1, 0.2, 0.5], atol=1e-9)
    assert np.isnan(moved.grasp_joints).all()


def test_graspgens_yaml_is_of_the_canonical_frame_when_told_so(franka, tmp_path):
    # As GraspGen writes it: no frame is named. A half turn about x: the canonical frame of the drawing.
    text = """
    format: isaac_grasp
    format_version: 1.0
    grasps: {grasp_0: {confidence: 0.9, position: [0.1, 0.2, 0.3], orientation: {w: 0.0, xyz: [1.0, 0.0, 0.0]}}}
    """
    (tmp_path / "graspgen.yml").write_text(text)
    assert_drawn(read_grasps(tmp_path / "graspgen.yml", franka, frame="canonical"), franka)
    as_base = read_grasps(tmp_path / "graspgen.yml", franka)
    np.testing.assert_allclose(as_base.T_world_gripper[0], T_WORLD_CANONICAL, atol=1e-9)


def test_moveit_has_the_pose_the_way_and_both_postures(drawn, franka, tmp_path):
    write_grasps(drawn, tmp_path / "drawn.moveit.yaml", franka)
    (message,) = yaml.safe_load((tmp_path / "drawn.moveit.yaml").read_text())
    pose = message["grasp_pose"]["pose"]
    assert pose["position"] == {"x": 0.1, "y": 0.2, "z": 0.3}
    np.testing.assert_allclose(
        [abs(pose["orientation"][name]) for name in "xyzw"], [0.5**0.5, 0.5**0.5, 0, 0], atol=1e-12
    )
    approach = message["pre_grasp_approach"]
    assert approach["direction"]["header"]["frame_id"] == message["grasp_pose"]["header"]["frame_id"] == "world"
    np.testing.assert_allclose([approach["direction"]["vector"][axis] for axis in "xyz"], [0, 0, -1], atol=1e-12)
    assert approach["desired_distance"] == pytest.approx(0.15)
    assert message["post_grasp_retreat"]["direction"]["vector"] == {"x": 0.0, "y": 0.0, "z": 1.0}
    assert message["pre_grasp_posture"] == {"joint_names": ["finger_joint1"], "points": [{"positions": [0.04]}]}
    assert message["grasp_posture"]["points"] == [{"positions": [0.0125]}]
    assert (message["grasp_quality"], message["max_contact_force"]) == (0.75, 40.0)
    # ROS refuses keys that the type lacks.
    assert set(message) == {
        "id", "pre_grasp_posture", "grasp_posture", "grasp_pose", "grasp_quality", "pre_grasp_approach",
        "post_grasp_retreat", "max_contact_force", "allowed_touch_objects",
    }  # fmt: skip


def test_moveits_parent_link_may_be_another_than_the_base(drawn, franka, tmp_path):
    # The hand is mounted 2 cm before the arm's last link and turned by a quarter about their common z.
    T_parent_gripper = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0.02], [0, 0, 0, 1]], dtype=float)
    path = tmp_path / "drawn.moveit.yaml"
    write_moveit(drawn, path, franka, frame_id="base", T_parent_gripper=T_parent_gripper)
    (message,) = yaml.safe_load(path.read_text())
    position = message["grasp_pose"]["pose"]["position"]
    np.testing.assert_allclose([position[axis] for axis in "xyz"], [0.1, 0.2, 0.32], atol=1e-12)
    assert_drawn(read_moveit(path, franka, T_parent_gripper=T_parent_gripper), franka)


def test_moveits_way_in_the_frame_of_the_hand_is_understood(franka, tmp_path):
    half = 0.5**0.5
    message = {
        "grasp_pose": {
            "header": {"frame_id": "world"},
            "pose": {"position": {"x": 0.1, "y": 0.2, "z": 0.3}, "orientation": {"x": half, "y": half, "z": 0, "w": 0}},
        },
        "pre_grasp_approach": {
            "direction": {"header": {"frame_id": "panda_hand"}, "vector": {"x": 0, "y": 0, "z": 1}},
            "desired_distance": 0.15,
        },
        "grasp_quality": 0.5,
    }
    (tmp_path / "echo.yaml").write_text(yaml.safe_dump(message) + "---\n")  # as `rostopic echo` prints it
    assert_drawn(read_grasps(tmp_path / "echo.yaml", franka), franka)
    np.testing.assert_allclose(read_grasps(tmp_path / "echo.yaml").T_world_pregrasp[0, :3, 3], PREGRASP, atol=1e-6)


def test_rows_that_graspnets_own_tools_read_and_wrote(drawn, franka, tmp_path):
    """GraspNet API 1.2.11 drew the fingers of our row at TIPS, and saved the second row here for these tips."""
    write_grasps(drawn, tmp_path / "ours.npy", franka)
    ours = [0.75, 0.08, 0.02, 0.02, 0, 1, 0, 0, 0, -1, -1, 0, 0, 0.1, 0.2, 0.2076, -1]
    np.testing.assert_allclose(np.load(tmp_path / "ours.npy"), [ours], atol=1e-6)
    theirs = [0.9, 0.05, 0.02, 0.03, 0, 1, 0, 0, 0, 1, 1, 0, 0, 0.1, 0.2, 0.5, -1]
    np.save(tmp_path / "theirs.npy", np.array([theirs]))  # drawn with tips at (0.1 -+ 0.025, 0.2, 0.53), from below
    grasps = read_grasps(tmp_path / "theirs.npy", franka)
    tips = fingertips(grasps, franka)
    np.testing.assert_allclose(tips[:, 1:], [[0.2, 0.53], [0.2, 0.53]], atol=1e-6)
    np.testing.assert_allclose(tips.mean(axis=0), [0.1, 0.2, 0.53], atol=1e-6)
    assert 0.05 <= tips[1, 0] - tips[0, 0] <= 0.058  # the narrowest preshape that takes 5 cm


@pytest.mark.parametrize("name", ["franka_hand", "robotiq_2f85", "barrett_bh282", "kinova_kg3"])
@pytest.mark.parametrize("suffix", [".h5", ".json"])
def test_canonical_transforms_point_every_hand_along_z(name, suffix, tmp_path):
    hand = load_gripper(name)
    path = tmp_path / f"grasps{suffix}"
    write_grasps(grasps_of(hand), path, hand)
    file: Any
    if suffix == ".h5":
        with h5py.File(path, "a") as file:
            del file["graspmatch"]
            transforms = np.array(file["grasps/transforms"])
    else:
        document = json.loads(path.read_text())
        del document["graspmatch"]
        path.write_text(json.dumps(document))
        transforms = np.array(document["grasps"]["transforms"])
    back = read_grasps(path, hand)  # of another tool, as far as one can see
    expected = grasps_of(hand)
    held = np.argsort(expected.score < 0.5, kind="stable")
    np.testing.assert_allclose(back.T_world_gripper, expected.T_world_gripper[held], atol=1e-6)
    np.testing.assert_allclose(back.T_world_pregrasp, expected.T_world_pregrasp[held], atol=1e-6)
    R = expected.T_world_gripper[:, :3, :3]
    np.testing.assert_allclose(transforms[:, :3, 2], R @ hand.approach, atol=1e-9)
    np.testing.assert_allclose(transforms[:, :3, 0], R @ hand.closing, atol=1e-9)
    np.testing.assert_array_equal(transforms[:, :3, 3], expected.T_world_gripper[:, :3, 3])
