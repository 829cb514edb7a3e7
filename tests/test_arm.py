"""Inverse kinematics of an arm: against MuJoCo, and along straight ways."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from arm_robot import write_arm
from graspmatch.apps.cli import main
from graspmatch.geometry import se3
from graspmatch.planner.arm import ANGLE_TOLERANCE, POSITION_TOLERANCE, Arm
from graspmatch.planner.path import OUT_OF_REACH
from graspmatch.planner.plan import plan
from graspmatch.planner.waypoints import waypoints
from graspmatch.scene.shapes import mug
from graspmatch.types import GraspmatchError
from test_path import scene_with
from test_planner import SMALL

DOWN = np.diag([1.0, -1.0, -1.0])

SLIDES = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="gantry" pos="0 0 1" quat="0.9238795 0 0 0.3826834">
      <joint name="x" type="slide" axis="1 0 0" range="-0.5 0.5"/>
      <geom type="sphere" size="0.01"/>
      <body name="arm" pos="0.1 0 0" euler="0.2 0 0">
        <joint name="y" type="slide" axis="0 1 0" range="-0.5 0.5"/>
        <geom type="sphere" size="0.01"/>
        <body name="wrist" pos="0 0 -0.3">
          <joint name="turn" axis="0 0.6 0.8" pos="0.02 0 0.01" range="-2 2"/>
          <joint name="tilt" axis="1 0 0" pos="0 0 0.05" range="-2 2"/>
          <geom type="sphere" size="0.01"/>
          <body name="tool" pos="0 0.1 -0.1"><geom type="sphere" size="0.01"/></body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory, toy) -> Arm:
    return Arm.read(write_arm(tmp_path_factory.mktemp("arm")), toy, tip="flange")


def test_positions_agree_with_mujoco(tmp_path: Path, toy):
    """Slides, axes beside the origin and two joints of one body included."""
    (tmp_path / "slides.xml").write_text(SLIDES)
    arm = Arm.read(tmp_path / "slides.xml", toy, tip="tool")
    assert arm.joint_names == ("x", "y", "turn", "tilt")
    model = mujoco.MjModel.from_xml_string(SLIDES)
    data = mujoco.MjData(model)
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (10, 4))
    for values, T in zip(q, arm.tip(q), strict=True):
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        body = model.body("tool").id
        np.testing.assert_allclose(T[:3, 3], data.xpos[body], atol=1e-9)
        np.testing.assert_allclose(T[:3, :3], data.xmat[body].reshape(3, 3), atol=1e-9)


def test_poses_that_were_reached_are_reached_again(arm):
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (60, 7))
    T = arm.tip(q)
    found = arm.follow(T[:, None])[:, 0]
    there = np.isfinite(found).all(axis=1)
    assert there.mean() > 0.8  # from few starts, in all of the joints' range
    assert (found[there] >= arm.lower - 1e-9).all()
    assert (found[there] <= arm.upper + 1e-9).all()
    error = se3.inverse(arm.tip(found[there])) @ T[there]
    assert np.linalg.norm(error[:, :3, 3], axis=-1).max() < POSITION_TOLERANCE
    cosine = (np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    assert np.arccos(np.clip(cosine, -1, 1)).max() < 1.01 * ANGLE_TOLERANCE


def test_what_is_too_far_or_in_the_base_is_not_reached(arm):
    places = np.array([[0.5, 0, 0.2], [1.5, 0, 0.2], [0.95, 0, 0.2], [0, 0, 0.2], [-0.5, 0, 0.2]])
    T = se3.from_parts(DOWN, places)
    np.testing.assert_array_equal(arm(T[:, None]), [True, False, False, False, True])


def test_a_way_is_gone_without_a_jump(arm):
    """Hands that come down by 15 cm: neighbouring poses of the way have neighbouring joint values."""
    down = np.linspace(0.35, 0.2, 13)[:, None] * np.array([0, 0, 1.0])
    ways = se3.from_parts(DOWN, np.array([0.45, -0.2, 0.0]) + down)[None]
    joints = arm.follow(ways)[0]
    assert np.isfinite(joints).all()
    assert np.abs(np.diff(joints, axis=0)).max() < 0.2


def test_every_way_is_followed_as_if_it_were_alone(arm):
    T = se3.from_parts(DOWN, np.random.default_rng(2).uniform([0.2, -0.6, 0.1], [0.8, 0.6, 0.4], (12, 3)))
    together = arm.follow(T[:, None])
    for i in range(len(T)):
        np.testing.assert_allclose(arm.follow(T[i : i + 1, None])[0], together[i], atol=1e-6)


def test_base_and_mount_move_what_is_reached(arm, toy):
    T_world_base = se3.from_parts(se3.rotation_exp(np.array([0, 0, 1.0])), np.array([1.0, 2.0, 0.5]))
    T_tip_gripper = se3.from_parts(se3.rotation_exp(np.array([0, 0, 0.5])), np.array([0, 0, 0.1]))
    moved = replace(arm, T_world_base=T_world_base, T_tip_gripper=T_tip_gripper)
    T = se3.from_parts(DOWN, np.array([[0.5, 0.1, 0.3]]))
    there = T_world_base @ T @ T_tip_gripper
    np.testing.assert_allclose(moved.follow(there[:, None]), arm.follow(T[:, None]), atol=1e-6)


def test_a_plan_for_an_arm_says_how_it_gets_there(arm, toy):
    """The box is 55 cm before the robot, so that not all of its sides are reached."""
    scene = scene_with()
    base = replace(arm, T_world_base=se3.translation(np.array([-0.6, 0, 0])))
    grasps = plan(scene, toy, SMALL, reach=base)
    assert len(grasps) > 0, grasps.explain()
    assert grasps.tally[OUT_OF_REACH] > 0
    joints = waypoints(grasps, scene, toy, SMALL, arm=base).arm_joints
    assert joints.shape == (len(grasps), 4, 7)
    assert np.isfinite(joints).all()
    tips = base.T_world_base @ arm.tip(joints[:, 1])
    assert np.linalg.norm((tips - grasps.T_world_gripper)[:, :3, 3], axis=-1).max() < POSITION_TOLERANCE


@pytest.mark.parametrize(
    ("change", "tip", "expected"),
    [
        (("flange", "flange"), None, "has no link 'palm'.*Known: .*link7, flange"),
        (("flange", "flange"), "link0", "no joint moves the link 'link0'"),
        (('type="revolute"', 'type="floating"'), "flange", "MuJoCo cannot read the robot"),
        (("<robot", "<robo"), "flange", "Cannot read the robot|cannot read the robot"),
    ],
)
def test_a_robot_that_cannot_be_used_is_an_error(tmp_path: Path, toy, change, tip, expected):
    path = write_arm(tmp_path)
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(GraspmatchError, match=expected):
        Arm.read(path, toy, tip=tip)


def test_an_arm_with_a_ball_joint_is_an_error(tmp_path: Path, toy):
    ball = SLIDES.replace('type="slide" axis="0 1 0" range="-0.5 0.5"', 'type="ball"')
    (tmp_path / "ball.xml").write_text(ball)
    with pytest.raises(GraspmatchError, match="joint 'y' is no hinge and no slide"):
        Arm.read(tmp_path / "ball.xml", toy, tip="tool")


def test_a_robot_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The mug is 60 cm before the robot; the straight way in is 10 cm long."""
    trimesh.Trimesh(mug().vertices, mug().faces).export(str(tmp_path / "mug.stl"))
    words = ["plan", str(tmp_path / "mug.stl"), "--gripper", "robotiq_2f85", "--device", "cpu", "--json", "--fast"]
    words += ["--robot", str(write_arm(tmp_path)), "--approach-distance", "0.1", "--robot-base=-0.6,0,0,1,0,0,0"]
    assert main([*words, "--robot-tip", "flange"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["tally"][OUT_OF_REACH] > 0
    for grasp in record["grasps"]:
        assert [len(step["arm_joints"]) for step in grasp["way"]] == [7, 7, 7, 7]
        assert None not in grasp["way"][0]["arm_joints"].values()
        away = np.array(grasp["T_world_gripper"]) - np.array(grasp["T_world_pregrasp"])
        assert np.linalg.norm(away[:3, 3]) == pytest.approx(0.1)
    assert main(words) == 2  # the robot has no link of the name of the hand's base
    assert "has no link 'base_mount'" in json.loads(capsys.readouterr().out)["error"]
