"""The built-in Barrett and Kinova hands against the makers' own files: same frames, same surfaces."""

from __future__ import annotations

import itertools
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
    view_grid,
)


@dataclass(frozen=True)
class Case:
    """A built-in hand and the file that it stands for."""

    name: str
    real: str
    views: tuple[list[float], list[float]]
    """Opposite corners of the box between the fingers from which the inner surface is seen [m]."""
    spread: dict[str, tuple[float, ...]]
    """Joints that spread the fingers, and values at which to compare [rad]."""

    @property
    def card(self) -> Card:
        return read_card(ZOO / self.name / "card.toml")

    def postures(self) -> list[dict[str, float]]:
        """Open, half and closed, at every spread."""
        return [self.posture(f) | s for f in (0.0, 0.5, 1.0) for s in self.spreads()]

    def spreads(self) -> list[dict[str, float]]:
        return [dict(zip(self.spread, values, strict=True)) for values in itertools.product(*self.spread.values())]

    def posture(self, fraction: float) -> dict[str, float]:
        """Joint values at a fraction of the closing motion, followers that only the card couples included."""
        card = self.card
        values = card.open_joints + fraction * (card.closed_joints - card.open_joints)
        driven = dict(zip(card.joint_names, values.tolist(), strict=True))
        return driven | {name: c.offset + c.multiplier * driven[c.joint] for name, c in card.couplings.items()}


BARRETT = Case(
    name="barrett_bh282",
    real="barrett_bh282/derived/bh282.urdf",
    views=([-0.03, -0.03, 0.08], [0.03, 0.03, 0.16]),
    spread={"bh_j11_joint": (0.0, np.pi / 2, np.pi)},
)
KG3 = Case(
    name="kinova_kg3",
    real="kinova_kg3/derived/kg3.urdf",
    views=([-0.02, -0.02, -0.18], [0.02, 0.02, -0.13]),
    spread={},
)
CASES = pytest.mark.parametrize("case", [BARRETT, KG3], ids=lambda case: case.name)


def built_in(case: Case, posture: dict[str, float]) -> PosedHand:
    return pose_hand(ZOO / case.name / f"{case.name}.xml", case.card.base_link, posture)


def real(case: Case, posture: dict[str, float]) -> PosedHand:
    path: Path = SHARED_GRIPPERS / case.real
    if not path.is_file():
        pytest.skip(f"The maker's file {case.real} is not beside the project, at ../shared/data/grippers.")
    return pose_hand(path, case.card.base_link, posture)


def views(case: Case) -> Float[np.ndarray, "v 3"]:
    return view_grid(*case.views, [2, 2, 2])


@CASES
def test_links_and_joints_have_the_names_and_ranges_of_the_real_file(case: Case):
    ours, theirs = built_in(case, {}), real(case, {})
    assert_same_names(ours, theirs)


@CASES
def test_frames_are_those_of_the_real_file_at_any_posture(case: Case):
    for posture in case.postures():
        assert_same_frames(built_in(case, posture), real(case, posture))


@CASES
def test_inner_surfaces_agree_within_5_mm(case: Case):
    for posture in case.postures():
        assert_inner_surfaces_agree(built_in(case, posture), real(case, posture), views(case))


@CASES
def test_outsides_agree_within_8_mm(case: Case):
    posture = case.postures()[0]
    assert_outsides_agree(built_in(case, posture), real(case, posture))


@CASES
def test_one_card_serves_the_built_in_hand_and_the_real_file(case: Case):
    for hand in (built_in(case, {}), real(case, {})):
        card = case.card
        assert card.base_link in hand.T_base_link
        assert {*card.palm, *(link for finger in card.fingers for link in finger.links)} <= hand.T_base_link.keys()
        assert {*card.joints, *card.couplings} <= hand.joints.keys()
        for name, joint in card.joints.items():
            low, high = hand.ranges[name]
            assert low <= joint.open <= high
            assert joint.closed is None or low < joint.closed <= high


@CASES
def test_every_driven_joint_has_an_actuator(case: Case):
    model = mujoco.MjModel.from_xml_path(str(ZOO / case.name / f"{case.name}.xml"))
    assert {model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)} == set(case.card.joints)


@CASES
def test_the_actuators_close_the_fingers_in_simulation(case: Case):
    """Half of the way, where no finger meets another; the tips are left to their couplings or springs."""
    card = case.card
    model = mujoco.MjModel.from_xml_path(str(ZOO / case.name / f"{case.name}.xml"))
    model.opt.gravity[:] = 0
    data = mujoco.MjData(model)
    aims = {name: case.posture(0.5)[name] for name in card.joint_names}
    data.ctrl[:] = [aims[model.joint(model.actuator_trnid[i, 0]).name] for i in range(model.nu)]
    mujoco.mj_step(model, data, nstep=500)
    assert {name: float(data.joint(name).qpos[0]) for name in aims} == pytest.approx(aims, abs=0.03)
    assert data.ncon == 0
    assert np.abs(data.qvel).max() < 0.05
