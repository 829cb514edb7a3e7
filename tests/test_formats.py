"""Files of grasps: what is written comes back, and nothing else is taken for one."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import write_atomically
from graspmatch.formats.isaac import read_isaac, write_isaac
from graspmatch.formats.npz import read_npz, write_npz
from graspmatch.formats.registry import writer_of
from graspmatch.geometry import se3
from graspmatch.types import GraspSet, Provenance

JOINTS = ("left_finger", "right_finger")


def random_grasps(n: int, seed: int = 0) -> GraspSet:
    """Grasps without any meaning, best first."""
    rng = np.random.default_rng(seed)

    def poses() -> np.ndarray:
        rotations = se3.matrix_from_quaternion(se3.random_quaternions(n, rng))
        return se3.from_parts(rotations, rng.normal(size=(n, 3)))

    return GraspSet(
        joint_names=JOINTS,
        preshape_names=("open", "half"),
        T_world_gripper=poses(),
        T_world_pregrasp=poses(),
        preshape=rng.integers(0, 2, n),
        pregrasp_joints=rng.random((n, 2)),
        grasp_joints=rng.random((n, 2)),
        score=np.sort(rng.random(n))[::-1].copy(),
        clearance=rng.random(n) * 1e-6,
        matching_error=rng.random(n),
        loss=rng.random(n),
        quality=rng.random(n),
        fingers_touching=rng.integers(0, 3, n),
        tally={"candidates": n + 5, "in collision with the table": 5},
        provenance=Provenance("hand", "abc", '{"seed": 7}', 7, "cpu", "0.1.0", "mug.stl", {"match": 0.25}),
        advice="Try the größte hand: 100 % 'quoted' \"text\".",
    )


def assert_same(a: GraspSet, b: GraspSet, tolerance: float = 0.0) -> None:
    """Every field is equal, poses up to the tolerance."""
    for field in dataclasses.fields(GraspSet):
        expected, found = getattr(a, field.name), getattr(b, field.name)
        if field.name.startswith("T_"):
            np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
        elif isinstance(expected, np.ndarray):
            np.testing.assert_array_equal(found, expected)
        else:
            assert found == expected


@pytest.mark.parametrize("n", [0, 1, 7])
def test_npz_comes_back_exactly(tmp_path: Path, n: int) -> None:
    write_npz(random_grasps(n), tmp_path / "grasps.npz")
    assert_same(random_grasps(n), read_npz(tmp_path / "grasps.npz"))


def test_equal_grasps_make_equal_files(tmp_path: Path) -> None:
    for name in ("a.npz", "b.npz"):
        write_npz(random_grasps(3), tmp_path / name)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.parametrize("n", [0, 1, 7])
def test_isaac_yaml_comes_back_up_to_the_rounding_of_quaternions(tmp_path: Path, n: int) -> None:
    write_isaac(random_grasps(n), "base", tmp_path / "grasps.yaml")
    assert_same(random_grasps(n), read_isaac(tmp_path / "grasps.yaml"), tolerance=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_pose_survives_isaac_yaml(tmp_path: Path, seed: int) -> None:
    grasps = random_grasps(3, seed)
    write_isaac(grasps, "base", tmp_path / "grasps.yaml")
    assert_same(grasps, read_isaac(tmp_path / "grasps.yaml"), tolerance=1e-12)


def test_isaac_yaml_has_the_fields_that_the_editor_asks_for(tmp_path: Path) -> None:
    grasps = random_grasps(2)
    write_isaac(grasps, "panda_hand", tmp_path / "grasps.yaml")
    document = yaml.safe_load((tmp_path / "grasps.yaml").read_text())
    assert (document["format"], document["format_version"]) == ("isaac_grasp", 1.0)
    assert document["gripper_frame"] == document["gripper_frame_link"] == "panda_hand"
    assert document["object_frame"] == document["object_frame_link"]
    entry = document["grasps"]["grasp_1"]
    assert entry["confidence"] == grasps.score[1]
    assert entry["position"] == grasps.T_world_gripper[1, :3, 3].tolist()
    assert entry["cspace_position"] == dict(zip(JOINTS, grasps.grasp_joints[1], strict=True))
    assert entry["pregrasp_cspace_position"] == dict(zip(JOINTS, grasps.pregrasp_joints[1], strict=True))
    wxyz = np.array([entry["orientation"]["w"], *entry["orientation"]["xyz"]])
    np.testing.assert_allclose(se3.matrix_from_quaternion(wxyz), grasps.T_world_gripper[1, :3, :3], atol=1e-12)


FOREIGN = """
format: isaac_grasp
format_version: 1.0
gripper_frame_link: panda_hand
grasps:
  worse: {confidence: 0.2, position: [0, 0, 1], orientation: {w: 1, xyz: [0, 0, 0]}}
  better:
    confidence: 0.9
    position: [1, 2, 3]
    orientation: {w: 0, xyz: [0, 0, 1]}
    cspace_position: {finger: 0.01}
"""


def test_isaac_yaml_of_another_tool_is_read_best_first(tmp_path: Path) -> None:
    (tmp_path / "grasps.yaml").write_text(FOREIGN)
    grasps = read_isaac(tmp_path / "grasps.yaml")
    assert grasps.joint_names == ("finger",)
    assert grasps.score.tolist() == [0.9, 0.2]
    assert grasps.T_world_gripper[0].tolist() == [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    assert np.array_equal(grasps.T_world_gripper[1][:3, :3], np.eye(3))
    assert grasps.grasp_joints[0, 0] == 0.01


def test_what_another_tool_does_not_say_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "grasps.yaml").write_text(FOREIGN)
    grasps = read_isaac(tmp_path / "grasps.yaml")
    assert np.isnan(grasps.pregrasp_joints).all()
    assert np.isnan(grasps.T_world_pregrasp).all()
    assert np.isnan(grasps.clearance).all()
    assert (grasps.fingers_touching == -1).all()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a: [1, 2",
        "just words",
        "format: isaac_grasp",
        "{format: isaac_grasp, format_version: 1.0, grasps: [1, 2]}",
        "{format: isaac_grasp, format_version: 1.0, grasps: {a: {position: [0, 0, 0]}}}",
        "{format: isaac_grasp, format_version: 1.0, grasps: "
        "{a: {position: [0, 0], orientation: {w: 1, xyz: [0, 0, 0]}}}}",
        "{format: isaac_grasp, format_version: 1.0, grasps: "
        "{a: {position: [0, 0, .nan], orientation: {w: 1, xyz: [0, 0, 0]}}}}",
        "{format: isaac_grasp, format_version: 1.0, grasps: "
        "{a: {position: [0, 0, 0], orientation: {w: 0, xyz: [0, 0, 0]}}}}",
        "{format: isaac_grasp, format_version: 1.0, grasps: "
        "{a: {position: [0, 0, 0], orientation: {w: 2, xyz: [0, 0, 0]}}}}",
        "{format: isaac_grasp, format_version: 1.0, grasps: "
        "{a: {position: [0, 0, 0], orientation: {w: 1, xyz: [0, 0, 0]}, confidence: .inf}}}",
        "{format: isaac_grasp, format_version: 1.0, grasps: "
        "{a: {position: [0, 0, 0], orientation: {w: 1, xyz: [0, 0, 0]}, cspace_position: [1]}}}",
        "{format: isaac_grasp, format_version: 2.0, grasps: {}}",
        "format: isaac_grasp\nformat_version: 1.0\ngrasps: !!python/object/apply:os.getcwd []",
    ],
)
def test_bad_yaml_is_one_clear_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "grasps.yaml").write_text(text)
    with pytest.raises(GraspmatchError, match=r"grasps\.yaml") as caught:
        read_isaac(tmp_path / "grasps.yaml")
    assert "\n" not in str(caught.value)


def test_every_cut_of_an_npz_file_is_refused(tmp_path: Path) -> None:
    write_npz(random_grasps(2), tmp_path / "whole.npz")
    whole = (tmp_path / "whole.npz").read_bytes()
    for length in np.linspace(0, len(whole) - 1, 20).astype(int):
        (tmp_path / "cut.npz").write_bytes(whole[:length])
        with pytest.raises(GraspmatchError, match="damaged"):
            read_npz(tmp_path / "cut.npz")


def test_a_changed_byte_in_an_npz_file_is_refused_or_harmless(tmp_path: Path) -> None:
    write_npz(random_grasps(2), tmp_path / "whole.npz")
    whole = bytearray((tmp_path / "whole.npz").read_bytes())
    refused = 0
    for position in range(0, len(whole), 37):
        changed = whole.copy()
        changed[position] ^= 0x55
        (tmp_path / "changed.npz").write_bytes(changed)
        try:
            assert_same(random_grasps(2), read_npz(tmp_path / "changed.npz"))
        except GraspmatchError:
            refused += 1
    assert refused > 20


def test_npz_files_of_others_and_missing_files_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "points.npz", points=np.zeros((3, 3)))
    with pytest.raises(GraspmatchError, match="not a file of grasps"):
        read_npz(tmp_path / "points.npz")
    with pytest.raises(GraspmatchError, match="No such file"):
        read_npz(tmp_path / "missing.npz")
    with pytest.raises(GraspmatchError, match="No such file"):
        read_isaac(tmp_path / "missing.yaml")


def test_npz_arrays_that_do_not_fit_together_are_refused(tmp_path: Path) -> None:
    write_npz(random_grasps(3), tmp_path / "grasps.npz")
    with np.load(tmp_path / "grasps.npz") as file:
        contents: dict[str, Any] = dict(file) | {"grasp_joints": np.zeros((2, 2))}
    np.savez(tmp_path / "grasps.npz", **contents)
    with pytest.raises(GraspmatchError, match=r"'grasp_joints' has the shape \(2, 2\), expected \(3, 2\)"):
        read_npz(tmp_path / "grasps.npz")


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "grasps.npz"
    target.write_text("old")

    def fail(temporary: Path) -> None:
        temporary.write_text("half")
        raise RuntimeError("out of ideas")

    with pytest.raises(RuntimeError):
        write_atomically(target, fail)
    assert [path.name for path in tmp_path.iterdir()] == ["grasps.npz"]
    assert target.read_text() == "old"


def test_the_temporary_file_keeps_the_suffix_and_the_folder(tmp_path: Path) -> None:
    seen: list[Path] = []
    write_atomically(tmp_path / "picture.png", lambda temporary: (seen.append(temporary), temporary.touch())[1])
    assert seen[0].parent == tmp_path
    assert seen[0].suffix == ".png"
    assert [path.name for path in tmp_path.iterdir()] == ["picture.png"]


def test_unwritable_places_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grasps = random_grasps(1)
    with pytest.raises(GraspmatchError, match=r"there is no folder .*missing"):
        write_npz(grasps, tmp_path / "missing" / "grasps.npz")
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(GraspmatchError, match="it is a folder"):
        write_isaac(grasps, "base", tmp_path / "folder.yaml")

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("graspmatch.formats.files.os.replace", refuse)
    with pytest.raises(GraspmatchError, match="Permission denied"):
        write_npz(grasps, tmp_path / "grasps.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["folder.yaml"]


def test_an_unknown_suffix_lists_the_known_ones() -> None:
    with pytest.raises(GraspmatchError, match=r"suffix '\.txt'\. Known: \.npz, \.yaml, \.yml"):
        writer_of(Path("grasps.txt"))
