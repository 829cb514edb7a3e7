"""`graspmatch convert`: from every format to every other, and what is said about what gets lost."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from graspmatch.apps.cli import main
from graspmatch.errors import GraspmatchError
from graspmatch.formats.registry import read_grasps, write_grasps
from graspmatch.gripper.load import load_gripper
from graspmatch.scene.shapes import mug
from graspmatch.types import GraspSet, Gripper
from test_graspnet import grasps_of

SUFFIXES = (".npz", ".yaml", ".moveit.yaml", ".npy", ".json", ".h5")
LOSSLESS = (".npz", ".yaml", ".json", ".h5")
Captured = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def franka() -> Gripper:
    return load_gripper("franka_hand")


@pytest.fixture
def grasps(franka: Gripper) -> GraspSet:
    made = grasps_of(franka, 5)
    return dataclasses.replace(made, grasp_joints=made.pregrasp_joints / 3, quality=np.linspace(-1, 1, 5))


@pytest.mark.parametrize("target", SUFFIXES)
@pytest.mark.parametrize("source", SUFFIXES)
def test_every_format_becomes_every_other(franka, grasps, tmp_path, capsys: Captured, source: str, target: str) -> None:
    write_grasps(grasps, tmp_path / f"a{source}", franka)
    files = [str(tmp_path / f"a{source}"), str(tmp_path / f"b{target}")]
    assert main(["convert", *files, "--gripper", "franka_hand"]) == 0
    assert f"Wrote 5 grasps to {files[1]}" in capsys.readouterr().out
    back = read_grasps(files[1], franka)
    np.testing.assert_allclose(back.T_world_gripper, grasps.T_world_gripper, atol=1e-6)
    np.testing.assert_allclose(back.T_world_pregrasp, grasps.T_world_pregrasp, atol=1e-6)
    np.testing.assert_array_equal(back.pregrasp_joints, grasps.pregrasp_joints)
    np.testing.assert_array_equal(back.score, grasps.score)
    assert back.provenance.gripper == "franka_hand"
    if ".npy" not in (source, target):
        np.testing.assert_array_equal(back.grasp_joints, grasps.grasp_joints)
    if source in LOSSLESS and target in LOSSLESS:
        for name in ("quality", "clearance", "fingers_touching", "preshape"):
            np.testing.assert_array_equal(getattr(back, name), getattr(grasps, name))
        assert back.provenance == grasps.provenance
        assert back.tally == grasps.tally


def test_a_file_that_names_its_hand_needs_no_option(franka, grasps, tmp_path, capsys: Captured) -> None:
    write_grasps(grasps, tmp_path / "a.npz", franka)
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "b.npy"), "--json"]) == 0
    output = capsys.readouterr()
    record = json.loads(output.out)
    assert (record["grasps"], record["gripper"], len(record["notes"])) == (5, "franka_hand", 1)
    assert "joint values" in record["notes"][0]
    assert "Wrote 5 grasps" in output.err
    assert np.load(tmp_path / "b.npy").shape == (5, 17)
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "c.json"), "--quiet"]) == 0
    assert main(["convert", str(tmp_path / "c.json"), str(tmp_path / "d.h5"), "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert len(read_grasps(tmp_path / "d.h5")) == 5


def test_unknown_joint_values_are_left_out_and_that_is_said(franka, grasps, tmp_path, capsys: Captured) -> None:
    write_grasps(grasps, tmp_path / "a.npy", franka)
    words = ["convert", str(tmp_path / "a.npy"), str(tmp_path / "b.yaml"), "--gripper", "franka_hand"]
    assert main(words) == 0
    assert "joint values at the grasp are not known" in capsys.readouterr().out
    entry = yaml.safe_load((tmp_path / "b.yaml").read_text())["grasps"]["grasp_0"]
    assert entry["cspace_position"] == {}
    assert entry["pregrasp_cspace_position"] == {"finger_joint1": 0.04}


FOREIGN = """
format: isaac_grasp
format_version: 1.0
gripper_frame: /World/panda_hand
grasps: {a: {confidence: 0.5, position: [0, 0, 0.2], orientation: {w: 0, xyz: [1, 0, 0]}}}
"""


def test_another_name_of_the_hand_is_said(tmp_path, capsys: Captured) -> None:
    (tmp_path / "a.yaml").write_text(FOREIGN)
    files = [str(tmp_path / "a.yaml"), str(tmp_path / "b.npz")]
    assert main(["convert", *files]) == 0  # .npz needs no hand
    capsys.readouterr()
    assert main(["convert", *files, "--gripper", "franka_hand"]) == 0
    assert "are of '/World/panda_hand'; they are taken as those of 'hand' of franka_hand" in capsys.readouterr().out
    assert read_grasps(files[1]).provenance.gripper == "franka_hand"
    assert main(["convert", files[0], str(tmp_path / "b.npy")]) == 2
    assert "for '/World/panda_hand', which is not built in: give --gripper" in capsys.readouterr().err


def test_graspgens_frame_is_an_option(tmp_path, capsys: Captured) -> None:
    (tmp_path / "a.yml").write_text(FOREIGN.replace("gripper_frame: /World/panda_hand", ""))
    words = ["convert", str(tmp_path / "a.yml"), str(tmp_path / "b.npz"), "--frame", "canonical"]
    assert main([*words, "--gripper", "franka_hand"]) == 0
    closing = read_grasps(tmp_path / "b.npz").T_world_gripper[0, :3, 1]
    np.testing.assert_allclose(closing, [1, 0, 0], atol=1e-12)  # x of the file is the y of the hand
    assert main(words) == 2
    assert "with the gripper given" in capsys.readouterr().err
    assert (
        main(["convert", str(tmp_path / "b.npz"), str(tmp_path / "c.yaml"), *words[3:], "--gripper", "franka_hand"])
        == 2
    )
    assert "YAML of other tools only" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("source", "target", "options", "said"),
    [
        ("a.npz", "b.npz", ("--gripper", "robotiq_2f85"), "is for franka_hand, not for robotiq_2f85"),
        ("a.npz", "b.txt", (), "no format of grasps has the suffix '.txt'"),
        ("a.npz", "missing/b.npz", (), "make it first"),
        ("none.npz", "b.npz", (), "No such file"),
        ("a.npy", "b.npz", (), "says nothing about the hand"),
        ("bare.json", "b.npz", (), "says nothing about the hand's frame"),
    ],
)
def test_what_cannot_be_converted_is_one_line(
    franka, grasps, tmp_path, capsys: Captured, source, target, options, said
):
    write_grasps(grasps, tmp_path / "a.npz", franka)
    write_grasps(grasps, tmp_path / "a.npy", franka)
    (tmp_path / "bare.json").write_text('{"grasps": {"transforms": [], "object_in_gripper": []}}')
    assert main(["convert", str(tmp_path / source), str(tmp_path / target), *options]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not (tmp_path / target).exists()


def test_verdicts_are_not_made_up(franka, grasps, tmp_path) -> None:
    unknown = dataclasses.replace(grasps, score=np.full(5, np.nan))
    for name in ("a.json", "a.h5"):
        with pytest.raises(GraspmatchError, match="grasp 0 has no score"):
            write_grasps(unknown, tmp_path / name, franka)
    from_nowhere = dataclasses.replace(grasps, T_world_pregrasp=np.full((5, 4, 4), np.nan))
    with pytest.raises(GraspmatchError, match="where the approach begins is not known"):
        write_grasps(from_nowhere, tmp_path / "a.moveit.yaml", franka)
    other_shapes = dataclasses.replace(grasps, preshape_names=("unknown",), preshape=np.zeros(5, dtype=int))
    with pytest.raises(GraspmatchError, match="width of a row is that of a preshape"):
        write_grasps(other_shapes, tmp_path / "a.npy", franka)
    with pytest.raises(GraspmatchError, match="without the hand"):
        write_grasps(grasps, tmp_path / "a.yaml")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_grasps_are_no_grasps_in_every_format(franka, tmp_path, suffix: str) -> None:
    write_grasps(grasps_of(franka, 0), tmp_path / f"none{suffix}", franka)
    none = read_grasps(tmp_path / f"none{suffix}", franka)
    assert len(none) == 0
    assert none.T_world_gripper.shape == none.T_world_pregrasp.shape == (0, 4, 4)


def test_without_h5py_the_error_says_what_to_install(franka, grasps, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(GraspmatchError, match=r"needs h5py: pip install h5py"):
        write_grasps(grasps, tmp_path / "a.h5", franka)
    with pytest.raises(GraspmatchError, match=r"needs h5py: pip install h5py"):
        read_grasps(tmp_path / "a.h5", franka)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_plan_starts_from_poses_in_any_format(franka, tmp_path: Path, capsys: Captured, suffix: str) -> None:
    trimesh.Trimesh(mug().vertices, mug().faces).export(str(tmp_path / "mug.stl"))
    # Straight down on either side of the wall that is away from the handle, 1 cm into the mug of 9 cm.
    np.save(tmp_path / "rows.npy", [[0.9, 0.03, 0.02, 0.02, 0, 1, 0, 0, 0, -1, -1, 0, 0, -0.033, 0, 0.1, -1]])
    starts = tmp_path / f"starts{suffix}"
    write_grasps(read_grasps(tmp_path / "rows.npy", franka), starts, franka)
    words = ["--gripper", "franka_hand", "--device", "cpu", "--json", "--quiet", "--seeds", str(starts)]
    assert main(["plan", str(tmp_path / "mug.stl"), *words]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["tally"]["candidates"] == 10  # the one pose with every preshape
    assert record["grasps"]
