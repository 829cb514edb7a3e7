"""The built-in Franka and Robotiq 2F-85 hands against the published files: same frames, same surfaces, able to hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pytest
from jaxtyping import Float

from graspmatch.gripper.card import Card, read_card
from zoo_measure import (
    SHARED_GRIPPERS,
    ZOO,
    PosedHand,
    assert_inner_surfaces_agree,
    assert_outsides_agree,
    assert_same_frames,
    assert_same_names,
    pose_hand,
    reaches,
    view_grid,
)


@dataclass(frozen=True)
class Case:
    """A built-in hand and the file that it stands for."""

    name: str
    real: str
    rest: dict[str, float]
    """Passive joints that springs hold still while the fingers move freely."""
    gaps: tuple[float, float, float]
    """Clear distance between the pads open, half closed and closed [m]."""
    depth: tuple[float, float]
    """Reach of the view points along the approach [m]."""
    command_open: float
    command_closed: float

    @property
    def card(self) -> Card:
        return read_card(ZOO / self.name / "card.toml")

    @property
    def path(self) -> Path:
        return ZOO / self.name / f"{self.name}.xml"

    def posture(self, fraction: float) -> dict[str, float]:
        """Joint values at a fraction of the closing motion."""
        card = self.card
        values = card.open_joints + fraction * (card.closed_joints - card.open_joints)
        return dict(zip(card.joint_names, values.tolist(), strict=True)) | self.rest

    def postures(self) -> list[dict[str, float]]:
        """Open, half and closed."""
        return [self.posture(fraction) for fraction in (0.0, 0.5, 1.0)]

    def views(self, gap: float) -> Float[np.ndarray, "v 3"]:
        """View points between the fingers, from the palm to the middle of the pads."""
        points = view_grid([-0.45 * gap, -0.006, self.depth[0]], [0.45 * gap, 0.006, self.depth[1]], [3, 2, 3])
        closing, approach = self.card.closing, self.card.approach
        return points @ np.stack([closing, np.cross(approach, closing), approach])


FRANKA = Case(
    name="franka_hand",
    real="franka_emika_panda/hand.xml",
    rest={},
    gaps=(0.08, 0.04, 0.0),
    depth=(0.07, 0.105),
    command_open=255.0,
    command_closed=0.0,
)
ROBOTIQ = Case(
    name="robotiq_2f85",
    real="robotiq_2f85/2f85.xml",
    rest={"right_coupler_joint": 0.0, "left_coupler_joint": 0.0},
    gaps=(0.085, 0.0446, 0.0),
    depth=(0.1, 0.145),
    command_open=0.0,
    command_closed=255.0,
)
CASES = pytest.mark.parametrize("case", [FRANKA, ROBOTIQ], ids=lambda case: case.name)


def built_in(case: Case, posture: dict[str, float]) -> PosedHand:
    return pose_hand(case.path, case.card.base_link, posture)


def real(case: Case, posture: dict[str, float]) -> PosedHand:
    path = SHARED_GRIPPERS / case.real
    if not path.is_file():
        pytest.skip(f"The published file {case.real} is not beside the project, at ../shared/data/grippers.")
    return pose_hand(path, case.card.base_link, posture)


@CASES
def test_links_and_joints_have_the_names_and_ranges_of_the_real_file(case: Case):
    ours, theirs = built_in(case, case.posture(0.0)), real(case, case.posture(0.0))
    assert_same_names(ours, theirs)


@CASES
def test_frames_are_those_of_the_real_file_at_any_posture(case: Case):
    for posture in case.postures():
        assert_same_frames(built_in(case, posture), real(case, posture))


@CASES
def test_inner_surfaces_agree_within_5_mm(case: Case):
    for posture, gap in zip(case.postures(), case.gaps, strict=True):
        assert_inner_surfaces_agree(built_in(case, posture), real(case, posture), case.views(gap))


@CASES
def test_outsides_agree_within_8_mm(case: Case):
    posture = case.posture(0.0)
    assert_outsides_agree(built_in(case, posture), real(case, posture))


@CASES
def test_one_card_serves_the_built_in_hand_and_the_real_file(case: Case):
    card = case.card
    for hand in (built_in(case, case.posture(0.0)), real(case, case.posture(0.0))):
        assert card.base_link in hand.T_base_link
        assert {*card.palm, *(link for finger in card.fingers for link in finger.links)} <= hand.T_base_link.keys()
        for name, joint in card.joints.items():
            low, high = hand.ranges[name]
            assert joint.closed is not None
            assert low <= min(joint.open, joint.closed) <= max(joint.open, joint.closed) <= high


@CASES
def test_pads_of_the_open_hand_are_the_opening_apart_at_the_tool_centre_point(case: Case):
    card = case.card
    surface = built_in(case, case.posture(0.0)).surface
    # Beside the tool centre point, because the Franka's pads have a groove in the middle.
    view = card.tool_centre_point + 0.005 * np.cross(card.approach, card.closing) + 0.003 * card.approach
    inside, beyond = card.opening / 2 - 0.001, card.opening / 2 + 0.001
    for side in (-1, 1):
        points = view + side * np.array([[inside], [beyond]]) * card.closing
        assert reaches(surface, view, points).tolist() == [True, False]


@CASES
def test_closed_pads_hold_a_box_against_gravity(case: Case):
    model = hand_around_a_box(case)
    data = mujoco.MjData(model)
    for name, value in built_in(case, case.posture(0.0)).joints.items():
        data.joint(name).qpos = value
    data.ctrl[0] = case.command_closed
    model.opt.gravity[:] = 0.0
    mujoco.mj_step(model, data, nstep=750)
    before = data.body("box").xpos.copy()
    model.opt.gravity[2] = -9.81
    mujoco.mj_step(model, data, nstep=1000)
    assert np.linalg.norm(data.body("box").xpos - before) < 0.002


@CASES
def test_free_fingers_close_without_touching_the_hand_itself(case: Case):
    model = mujoco.MjModel.from_xml_path(str(case.path))
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    for fraction in np.linspace(0.0, 0.9, 10):
        data.ctrl[0] = case.command_open + fraction * (case.command_closed - case.command_open)
        mujoco.mj_step(model, data, nstep=300)
        assert data.ncon == 0, f"touches at {fraction:.1f} of the way"


def hand_around_a_box(case: Case) -> mujoco.MjModel:
    """The hand pointing down, and a box of 30 mm and 0.3 kg between its open fingers."""
    spec = mujoco.MjSpec.from_file(str(case.path))
    spec.option.timestep = 0.002
    hand = spec.body(case.card.base_link)
    hand.pos, hand.quat = [0, 0, 0.5], [0, 1, 0, 0]
    box = spec.worldbody.add_body(name="box", pos=[0, 0, 0.5 - case.depth[1]])
    box.add_freejoint()
    box.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.015, 0.015, 0.03], mass=0.3)
    return spec.compile()
