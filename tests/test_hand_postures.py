"""Preshapes with a closing of their own, and fingers whose joints close as one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspmatch.geometry.se3 import translation
from graspmatch.gripper.card import closed_from, postures, read_card
from graspmatch.gripper.kinematics import HandModel, load_hand
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.close import contact_joints
from graspmatch.simulate.motion import Run
from graspmatch.simulate.stroke import stroke_from
from graspmatch.simulate.world import Physics, build_world, place
from graspmatch.types import GraspmatchError
from judge_scenes import cube
from toy_hand import CARD, COARSE, write_toy

PINCH = """
[[preshapes.poses]]
name = "pinch"
joints = { slide_left = 0.01 }
closed = { slide_left = 0.02 }
tool_centre_point = [0, 0, 0.05]
reach = 0.03
"""
WITH_PINCH = CARD.replace("[samples]", PINCH + "[samples]")


def test_a_pose_says_where_its_closing_ends(tmp_path: Path) -> None:
    card = read_card(write_toy(tmp_path, WITH_PINCH))
    assert [posture.closed[0] for posture in postures(card, card.joint_names)] == [0.03, 0.03, 0.03, 0.02]
    np.testing.assert_array_equal(closed_from(card, card.joint_names, np.array([0.01])), [0.02])
    np.testing.assert_array_equal(closed_from(card, card.joint_names, np.array([0.012])), [0.03])


def test_fingers_close_as_far_as_the_pose_says(tmp_path: Path) -> None:
    gripper = load_gripper(write_toy(tmp_path, WITH_PINCH), baking=COARSE)
    pinch = len(gripper.preshapes) - 1
    joints = contact_joints(np.array([0, pinch]), np.ones((2, 2)), gripper)
    np.testing.assert_allclose(joints, [[0.03], [0.02]])


def test_only_what_is_in_reach_is_inner_surface_of_a_precision_pose(tmp_path: Path) -> None:
    gripper = load_gripper(write_toy(tmp_path, WITH_PINCH), baking=COARSE)
    pinch = gripper.preshapes[-1].samples.points
    assert np.linalg.norm(pinch - [0, 0, 0.05], axis=-1).max() <= 0.03
    assert pinch[:, 2].min() > 0.02  # no palm
    assert gripper.preshapes[0].samples.points[:, 2].min() < 0.001


def test_a_pose_cannot_close_what_does_not_close(tmp_path: Path) -> None:
    card = WITH_PINCH.replace("closed = { slide_left", "closed = { slide_right")
    with pytest.raises(GraspmatchError, match="no driven joint that closes 'slide_right'"):
        read_card(write_toy(tmp_path, card))


CLAW = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="palm">
      <geom type="box" size="0.02 0.05 0.01" pos="0 0 -0.01"/>
      {fingers}
    </body>
  </worldbody>
</mujoco>
"""
FINGER = """
<body name="{side}_inner" pos="0 {y} 0">
  <joint name="{side}_1" axis="{axis} 0 0" range="-0.5 1.5"/>
  <geom type="box" size="0.008 0.006 0.025" pos="0 0 0.025"/>
  <body name="{side}_outer" pos="0 0 0.05">
    <joint name="{side}_2" axis="{axis} 0 0" range="0 1.5"/>
    <geom type="box" size="0.008 0.006 0.02" pos="0 0 0.02"/>
  </body>
</body>
"""
CLAW_CARD = """
name = "claw"
description = "claw.xml"
base_link = "palm"
approach = [0, 0, 1]
closing = [0, 1, 0]
tool_centre_point = [0, 0, 0.07]
finger_force = 10.0
opening = 0.08
palm = ["palm"]
[joints]
left_1 = { open = 0.0, closed = 0.6 }
left_2 = { open = 0.0, closed = 0.9 }
right_1 = { open = 0.0, closed = 0.6 }
right_2 = { open = 0.0, closed = 0.9 }
[[fingers]]
name = "left"
links = ["left_inner", "left_outer"]
joints = ["left_1", "left_2"]
[[fingers]]
name = "right"
links = ["right_inner", "right_outer"]
joints = ["right_1", "right_2"]
[preshapes]
steps = 0
[[preshapes.poses]]
name = "pinch"
joints = { left_1 = 0.1, right_1 = 0.1 }
closed = { left_1 = 0.4, left_2 = 0.15, right_1 = 0.4, right_2 = 0.15 }
[samples]
voxel_size = 0.005
"""


def claw(folder: Path) -> HandModel:
    """Two fingers of two hinges."""
    sides = (("left", 0.04, 1), ("right", -0.04, -1))
    fingers = "".join(FINGER.format(side=side, y=y, axis=axis) for side, y, axis in sides)
    (folder / "claw.xml").write_text(CLAW.format(fingers=fingers))
    (folder / "claw.toml").write_text(CLAW_CARD)
    return load_hand(folder / "claw.toml")


def test_one_joint_of_a_finger_leads_with_its_force(tmp_path: Path) -> None:
    hand = claw(tmp_path)
    stroke = stroke_from(hand, np.array([0.1, 0, 0.1, 0]))
    np.testing.assert_allclose(stroke.end, [0.4, 0.15, 0.4, 0.15])
    assert stroke.followers == {1: (0, pytest.approx(0.5)), 3: (2, pytest.approx(0.5))}
    # 10 N at the tip, which moves by about 9 cm for each radian of the inner joint, and 2 cm more by the outer one.
    np.testing.assert_allclose(stroke.force[[0, 2]], 1.1, atol=0.15)
    np.testing.assert_array_equal(stroke.force[[1, 3]], 0)


def test_the_joints_of_a_finger_close_in_proportion(tmp_path: Path) -> None:
    hand = claw(tmp_path)
    world = build_world(cube(), hand, Physics(0.002, 0.6, 0.005, gravity=False, has_table=False))
    run = Run(world, place(world, np.eye(4), translation(np.array([1.0, 0, 0])), np.array([0.1, 0, 0.1, 0])))
    worst = 0.0
    for _ in run.close(1.0, squeeze=0.2):
        q = run.data.qpos[world.drive_qpos]
        worst = max(worst, abs(q[1] - 0.5 * (q[0] - 0.1)), abs(q[3] - 0.5 * (q[2] - 0.1)))
    assert worst < 0.005
    np.testing.assert_allclose(run.data.qpos[world.drive_qpos], [0.4, 0.15, 0.4, 0.15], atol=0.01)
