"""Descriptions by name: in MuJoCo Menagerie, in robot_descriptions, in ROS packages."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspmatch.gripper.find_description import find_description
from graspmatch.gripper.kinematics import load_hand
from graspmatch.gripper.zoo import card_path
from graspmatch.types import GraspmatchError


@pytest.fixture
def menagerie(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two models of one hand, and one of another."""
    for name in ("wonik/right_hand.xml", "wonik/left_hand.xml", "robotiq/2f85.xml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("<mujoco/>")
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("wonik/left_hand", "wonik/left_hand.xml"),
        ("wonik/left_hand.xml", "wonik/left_hand.xml"),
        ("wonik", "wonik/right_hand.xml"),
        ("robotiq", "robotiq/2f85.xml"),
    ],
)
def test_models_of_the_menagerie_are_found_by_name(name: str, file: str, menagerie: Path) -> None:
    assert find_description(f"menagerie:{name}") == (menagerie / file).resolve()
    assert find_description(Path(f"menagerie:{name}")) == (menagerie / file).resolve()


def test_unknown_models_are_told_with_what_there_is(menagerie: Path) -> None:
    with pytest.raises(GraspmatchError, match="It has wonik/left_hand, wonik/right_hand"):
        find_description("menagerie:wonik/both_hands")
    with pytest.raises(GraspmatchError, match="no folder shadow"):
        find_description("menagerie:shadow/right_hand")


def test_ros_packages_are_looked_for_on_their_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hand_description" / "urdf").mkdir(parents=True)
    file = tmp_path / "hand_description" / "urdf" / "hand.urdf"
    file.write_text("<robot/>")
    with pytest.raises(GraspmatchError, match="'hand_description' on ROS_PACKAGE_PATH"):
        find_description("package://hand_description/urdf/hand.urdf")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    assert find_description("package://hand_description/urdf/hand.urdf") == file.resolve()
    assert find_description(Path("package://hand_description/urdf/hand.urdf")) == file.resolve()


def test_other_references_are_paths(tmp_path: Path) -> None:
    assert find_description(tmp_path / "hand.urdf") == tmp_path / "hand.urdf"
    assert find_description("C:hand.urdf") == Path("C:hand.urdf").absolute()


def test_hands_whose_description_is_elsewhere_say_where(menagerie: Path) -> None:
    with pytest.raises(GraspmatchError, match=r"right_hand.xml of MuJoCo Menagerie; give that file with --description"):
        load_hand(card_path("shadow"))
    with pytest.raises(GraspmatchError, match="xacro expanded; give that file with --description"):
        load_hand(card_path("robotiq_3f"))


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("allegro", None),
        ("shadow", None),
        ("barrett_bh280", "barrett_bh280_dex_urdf/barrett_hand/bhand_model.urdf"),
        ("robotiq_3f", "robotiq_3f/derived/robotiq_3f.urdf"),
    ],
)
def test_cards_without_a_shape_of_their_own_fit_the_makers_files(
    name: str, file: str | None, shared_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MENAGERIE_ROOT", str(shared_data / "grippers"))
    hand = load_hand(card_path(name), None if file is None else shared_data / "grippers" / file)
    assert hand.joint_names == hand.card.joint_names
