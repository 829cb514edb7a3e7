"""`graspmatch grippers add`: what is proposed for real hands, against values checked by hand, and for made-up ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from graspmatch.apps.cli import main
from graspmatch.gripper.card import postures
from graspmatch.gripper.kinematics import load_hand
from graspmatch.gripper.load import load_gripper
from graspmatch.gripper.propose.card_text import card_text
from graspmatch.gripper.propose.check import check_hand
from graspmatch.gripper.propose.proposal import Proposal, propose
from graspmatch.types import GraspmatchError


@dataclass(frozen=True)
class Known:
    """A hand, and what a person who knows it reads off its file."""

    file: str
    base: str
    approach: list[float]
    closing: list[float]
    tool_centre_point: list[float]
    """[m]"""
    drives: dict[str, int]
    """Sense in which each driven joint closes; 0: it spreads or turns the wrist."""
    fingers: int
    opening: tuple[float, float]
    """At least and at most [m]."""


FINGERS = ("ff", "mf", "rf")
ALLEGRO = {f"{f}j{i}": int(i > 0) for f in FINGERS for i in range(4)} | {"thj0": 0, "thj1": 0, "thj2": 1, "thj3": 1}
SHADOW = {f"rh_{f}J{i}": int(i < 4) for f in ("FF", "MF", "RF", "LF") for i in (4, 3, 2)}
SHADOW |= {
    "rh_LFJ5": 0,
    "rh_WRJ2": 0,
    "rh_WRJ1": 0,
    "rh_THJ5": 0,
    "rh_THJ4": 0,
    "rh_THJ3": 0,
    "rh_THJ2": 1,
    "rh_THJ1": 1,
}

HANDS = {
    "franka": Known(
        "franka_emika_panda/hand.xml",
        "hand",
        [0, 0, 1],
        [0, 1, 0],
        [0, 0, 0.103],
        {"finger_joint1": -1},
        2,
        (0.079, 0.081),
    ),
    "2f85": Known(
        "robotiq_2f85/2f85.xml",
        "base_mount",
        [0, 0, 1],
        [1, 0, 0],
        [0, 0, 0.147],
        {"right_driver_joint": 1},
        2,
        (0.083, 0.087),
    ),
    "bh282": Known(
        "barrett_bh282/derived/bh282.urdf",
        "base_link",
        [0, 0, 1],
        [0, 1, 0],
        [0, 0, 0.145],
        {"bh_j32_joint": 1, "bh_j11_joint": 0, "bh_j12_joint": 1, "bh_j22_joint": 1},
        3,
        (0.28, 0.32),
    ),
    "bh280": Known(
        "barrett_bh280_dex_urdf/barrett_hand/bhand_model.urdf",
        "base_link",
        [0, 0, 1],
        [0, 1, 0],
        [0, 0, 0.155],
        {
            "finger_1_prox_joint": 0,
            "finger_1_med_joint": -1,
            "finger_2_prox_joint": 0,
            "finger_2_med_joint": -1,
            "finger_3_med_joint": -1,
        },
        3,
        (0.28, 0.33),
    ),
    "kg3": Known(
        "kinova_kg3/derived/kg3.urdf",
        "j2s7s300_link_7",
        [0, 0, -1],
        [0, 1, 0],
        [0, 0, -0.195],
        {f"j2s7s300_joint_finger_{i}": 1 for i in (1, 2, 3)},
        3,
        (0.17, 0.2),
    ),
    "robotiq_3f": Known(
        "robotiq_3f/derived/robotiq_3f.urdf",
        "palm",
        [0, 1, 0],
        [1, 0, 0],
        [0, 0.15, 0],
        {
            "palm_finger_1_joint": 0,
            "finger_1_joint_1": 1,
            "palm_finger_2_joint": 0,
            "finger_2_joint_1": 1,
            "finger_middle_joint_1": 1,
        },
        3,
        (0.15, 0.18),
    ),
    "allegro": Known(
        "wonik_allegro/right_hand.xml", "palm", [1, 0, 0], [0, 0, 1], [0.1, 0.01, 0.0], ALLEGRO, 4, (0.08, 0.14)
    ),
    "shadow": Known(
        "shadow_hand/right_hand.xml", "rh_forearm", [1, 0, 0], [0, 0, 1], [0.075, 0.0, 0.36], SHADOW, 5, (0.06, 0.14)
    ),
}
PROPOSED: dict[str, Proposal] = {}


def proposed(name: str, shared_data: Path) -> Proposal:
    """Each hand is looked at once."""
    if name not in PROPOSED:
        PROPOSED[name] = propose(shared_data / "grippers" / HANDS[name].file)
    return PROPOSED[name]


def angle(a: np.ndarray, b: list[float]) -> float:
    """Between two directions [degrees]."""
    return float(np.degrees(np.arccos(np.clip(a @ np.array(b) / np.linalg.norm(b), -1, 1))))


@pytest.mark.parametrize("name", HANDS)
def test_real_hands_are_understood_as_a_person_does(name: str, shared_data: Path) -> None:
    known, found = HANDS[name], proposed(name, shared_data)
    assert found.mechanism.description.base_link == known.base
    assert angle(found.frames.approach, known.approach) < 10
    assert min(angle(found.frames.closing, known.closing), angle(-found.frames.closing, known.closing)) < 10
    np.testing.assert_allclose(found.frames.tool_centre_point, known.tool_centre_point, atol=0.02)
    senses = dict(zip(found.mechanism.joint_names, found.roles.closes.astype(int).tolist(), strict=True))
    assert senses == known.drives
    assert len(found.mechanism.branches) == known.fingers
    assert known.opening[0] <= found.frames.opening <= known.opening[1]


@pytest.mark.parametrize("name", HANDS)
def test_proposed_cards_can_be_read_and_have_no_faults(name: str, shared_data: Path, tmp_path: Path) -> None:
    found = proposed(name, shared_data)
    card = tmp_path / "hand.toml"
    card.write_text(card_text(found, str(found.mechanism.description.path)))
    hand = load_hand(card)
    assert check_hand(hand, found.touching) == []
    assert len(postures(hand.card, hand.joint_names)) >= 4


TONGS = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="{palm}">
      {free}
      <geom type="box" size="0.02 0.06 0.01" pos="0 0 -0.01"/>
      <body name="a">
        <joint {left} type="slide" axis="0 -1 0" range="0 0.04"/>
        <geom type="box" size="0.01 0.005 0.03" pos="0 0.045 0.03"/>
      </body>
      <body name="b">
        <joint {right} type="slide" axis="0 1 0" range="{range}"/>
        <geom type="box" size="0.01 0.005 0.03" pos="0 -0.045 0.03"/>
      </body>
    </body>
  </worldbody>
  {extra}
</mujoco>
"""
WHOLE = {
    "palm": "palm",
    "free": "",
    "left": 'name="l"',
    "right": 'name="r"',
    "range": "0 0.04",
    "extra": '<equality><joint joint1="r" joint2="l"/></equality>',
}


def tongs(folder: Path, **changes: str) -> Path:
    """Two plates that slide towards each other along y."""
    path = folder / "tongs.xml"
    path.write_text(TONGS.format(**(WHOLE | changes)))
    return path


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"free": '<freejoint name="float"/>'},
        {"extra": "", "left": "", "right": ""},
        {"palm": ""},
        {"extra": '<actuator><position joint="l"/><position joint="r"/></actuator>'},
    ],
    ids=["equality", "free base", "unnamed joints", "unnamed palm", "actuators"],
)
def test_tongs_are_understood_however_they_are_written(changes: dict[str, str], tmp_path: Path) -> None:
    found = propose(tongs(tmp_path, **changes))
    np.testing.assert_allclose(found.frames.approach, [0, 0, 1])
    np.testing.assert_allclose(found.frames.closing, [0, 1, 0])
    np.testing.assert_allclose(found.frames.tool_centre_point, [0, 0, 0.048], atol=0.015)
    assert found.frames.opening == pytest.approx(0.08, abs=0.001)
    assert set(found.roles.closes) == {1.0}
    assert found.notes == []


def test_a_command_writes_a_card_a_picture_and_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["grippers", "add", str(tongs(tmp_path)), "-o", str(tmp_path / "cards")]) == 0
    out = capsys.readouterr().out
    assert "approach" in out
    assert "the way the palm looks" in out
    card = tmp_path / "cards" / "tongs.toml"
    assert (tmp_path / "cards" / "tongs.png").stat().st_size > 10_000
    assert sum(not preshape.is_fingertips for preshape in load_gripper(card).preshapes) == 10
    assert main(["grippers", "add", str(tongs(tmp_path)), "-o", str(tmp_path / "cards")]) == 2
    assert "exists" in capsys.readouterr().err


def two_hands(folder: Path) -> Path:
    """A world with two pairs of tongs."""
    body = TONGS.format(**WHOLE).split("<worldbody>")[1].split("</worldbody>")[0]
    other = body
    for name in ("palm", "a", "b", "l", "r"):
        other = other.replace(f'name="{name}"', f'name="other_{name}"')
    other = other.replace("<body name", '<body pos="1 0 0" name', 1)
    path = folder / "two.xml"
    path.write_text(f"<mujoco><worldbody>{body}{other}</worldbody></mujoco>")
    return path


def test_of_several_hands_one_is_chosen_by_its_root(tmp_path: Path) -> None:
    with pytest.raises(GraspmatchError, match=r"2 hands.*'palm', 'other_palm'"):
        propose(two_hands(tmp_path))
    found = propose(two_hands(tmp_path), root="other_palm")
    assert found.mechanism.description.base_link == "other_palm"
    assert set(found.mechanism.joint_names) == {"other_l", "other_r"}


URDF = """<robot name="hand">
  <link name="base"><visual><geometry>{shape}</geometry></visual></link>
  <link name="one"><visual><origin xyz="0 0.05 0.05"/><geometry><box size="0.02 0.01 0.08"/></geometry></visual></link>
  <link name="two"><visual><origin xyz="0 -0.05 0.05"/><geometry><box size="0.02 0.01 0.08"/></geometry></visual></link>
  <joint name="first" type="revolute"><parent link="base"/><child link="one"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="{upper}" effort="1" velocity="1"/></joint>
  <joint name="second" type="revolute"><parent link="base"/><child link="two"/><axis xyz="-1 0 0"/>
    <limit lower="0" upper="{upper}" effort="1" velocity="1"/></joint>
  {extra}
</robot>"""
BOX = '<box size="0.1 0.1 0.02"/>'
LOOP = '<joint name="third" type="revolute"><parent link="one"/><child link="two"/></joint>'


def urdf(folder: Path, *, shape: str = BOX, upper: str = "0.5", extra: str = "") -> Path:
    """Two fingers that turn towards each other about x; all links are visual only and have no inertia."""
    path = folder / "hand.urdf"
    path.write_text(URDF.format(shape=shape, upper=upper, extra=extra))
    return path


def test_visual_links_without_inertia_are_a_hand_too(tmp_path: Path) -> None:
    found = propose(urdf(tmp_path))
    np.testing.assert_allclose(found.frames.approach, [0, 0, 1])
    assert found.roles.closes.tolist() == [1, 1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"extra": LOOP}, "'two' hangs on two joints, 'second' and 'third'.*mimic"),
        ({"upper": "0"}, "limits of first, second leave no room"),
        ({"upper": "0.01"}, "joint 'first' has a range of 0.57 degrees"),
        ({"shape": '<mesh filename="gone.stl"/>'}, "link 'base' needs the mesh 'gone.stl', which is not there"),
        ({"shape": '<box size="100 100 20"/>'}, "link 'base' is 100 m across.*scale"),
        (
            {"extra": '<joint name="lost" type="fixed"><parent link="base"/><child link="nobody"/></joint>'},
            "'lost'.*'nobody'",
        ),
    ],
)
def test_broken_descriptions_are_told_by_link_or_joint_and_remedy(
    changes: dict[str, str], message: str, tmp_path: Path
) -> None:
    with pytest.raises(GraspmatchError, match=message):
        propose(urdf(tmp_path, **changes))


def test_joints_that_nothing_moves_are_noted(tmp_path: Path) -> None:
    extra = '<actuator><position joint="l"/></actuator>'
    found = propose(tongs(tmp_path, extra=extra))
    assert any("Nothing moves the joint 'r'" in note for note in found.notes)


def test_a_drive_that_is_named_by_a_transmission_is_the_only_one(tmp_path: Path) -> None:
    extra = '<transmission name="t"><joint name="first"/><actuator name="m"/></transmission>'
    found = propose(urdf(tmp_path, extra=extra))
    assert found.mechanism.joint_names == ("first",)


def linkage(folder: Path) -> Path:
    """A hand whose two fingers are each a link and a rod beside it, all following one joint, loops left open."""
    parts = []
    for side, sign in (("left", 1), ("right", -1)):
        mimic = "" if side == "left" else '<mimic joint="left_link_joint"/>'
        for name, y, length in (("link", 0.05, 0.1), ("rod", 0.035, 0.06)):
            follow = mimic if name == "link" else '<mimic joint="left_link_joint"/>'
            parts.append(
                f'''<link name="{side}_{name}"><collision><origin xyz="0 0 {length / 2}"/>
                <geometry><box size="0.02 0.01 {length}"/></geometry></collision></link>
                <joint name="{side}_{name}_joint" type="revolute"><parent link="base"/><child link="{side}_{name}"/>
                <origin xyz="0 {sign * y} 0.01"/><axis xyz="{sign} 0 0"/>
                <limit lower="0" upper="0.3" effort="5" velocity="1"/>{follow}</joint>'''
            )
    path = folder / "linkage.urdf"
    base = '<link name="base"><collision><geometry><box size="0.05 0.12 0.02"/></geometry></collision></link>'
    path.write_text(f"<robot name='linkage'>{base}{''.join(parts)}</robot>")
    return path


def test_parts_of_a_linkage_that_only_follow_are_one_finger(tmp_path: Path) -> None:
    found = propose(linkage(tmp_path))
    assert found.mechanism.joint_names == ("left_link_joint",)
    assert len(found.mechanism.branches) == 2
    assert found.postures.steps == 10


def test_a_jaw_that_closes_on_a_fixed_one_is_a_hand(tmp_path: Path) -> None:
    text = TONGS.format(**(WHOLE | {"extra": ""})).replace(
        '<joint name="r" type="slide" axis="0 1 0" range="0 0.04"/>', ""
    )
    (tmp_path / "jaw.xml").write_text(text)
    found = propose(tmp_path / "jaw.xml")
    assert found.mechanism.joint_names == ("l",)
    np.testing.assert_allclose(found.frames.closing, [0, 1, 0])
    assert found.frames.opening == pytest.approx(0.08, abs=0.005)
