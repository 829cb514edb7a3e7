"""`graspmatch simulate` as it is used: a file of grasps and a mesh in, verdicts out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from graspmatch.apps.cli import main
from graspmatch.formats.npz import write_npz
from graspmatch.formats.registry import write_grasps
from graspmatch.geometry.se3 import translation
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tin, and grasps of it as every kind of file."""
    folder = tmp_path_factory.mktemp("simulate")
    tin = trimesh.creation.cylinder(radius=0.03, height=0.1, sections=48)
    tin.apply_translation([0, 0, 0.05])
    tin.export(folder / "tin.stl")
    gripper = load_gripper("franka_hand")
    grasps = plan(Scene.from_mesh(folder / "tin.stl"), gripper).best(3)
    for name in ("grasps.yaml", "grasps.npz", "grasps.npy"):
        write_grasps(grasps, folder / name, gripper)
    return folder


def simulate(folder: Path, grasps: str, *options: str) -> list[str]:
    return ["simulate", str(folder / grasps), "--object", str(folder / "tin.stl"), *options]


def planned(folder: Path) -> GraspSet:
    from graspmatch.formats.npz import read_npz

    return read_npz(folder / "grasps.npz")


def test_a_file_says_which_hand_it_is_for_and_every_grasp_gets_a_verdict(folder: Path, capsys) -> None:
    assert main(simulate(folder, "grasps.yaml", "--json")) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["protocol"] == "lift"
    assert report["settings"]["friction"] == 0.6
    assert len(report["held"]) == 3
    assert any(report["held"])
    assert all(bool(reason) != held for reason, held in zip(report["reason"], report["held"], strict=True))


def test_every_format_gives_the_same_verdicts(folder: Path, capsys) -> None:
    held = []
    for name in ("grasps.npz", "grasps.yaml", "grasps.npy"):
        main(simulate(folder, name, "--json", "--gripper", "franka_hand"))
        held.append(json.loads(capsys.readouterr().out)["held"])
    assert held[0] == held[1] == held[2]


def test_friction_mass_and_protocol_reach_the_physics(folder: Path, capsys) -> None:
    status = main(simulate(folder, "grasps.npz", "--json", "--friction", "0.02", "--mass", "0.6", "--first", "1"))
    slippery = json.loads(capsys.readouterr().out)
    assert (status, slippery["held"], slippery["mass"]) == (3, [False], 0.6)
    main(simulate(folder, "grasps.npz", "--json", "--protocol", "tug", "--first", "1"))
    assert json.loads(capsys.readouterr().out)["mass"] == 1.0


def test_the_table_may_be_at_any_height(folder: Path, tmp_path: Path, capsys) -> None:
    tin = trimesh.load(folder / "tin.stl")
    tin.apply_translation([0, 0, 0.4])
    tin.export(tmp_path / "tin.stl")
    up, grasps = translation(np.array([0.0, 0.0, 0.4])), planned(folder)
    raised = replace(grasps, T_world_gripper=up @ grasps.T_world_gripper, T_world_pregrasp=up @ grasps.T_world_pregrasp)
    write_npz(raised, tmp_path / "grasps.npz")
    main(simulate(folder, "grasps.npz", "--json"))
    low = json.loads(capsys.readouterr().out)
    main(simulate(tmp_path, "grasps.npz", "--json"))
    assert json.loads(capsys.readouterr().out)["held"] == low["held"]


def test_a_strip_of_pictures_shows_the_lift(folder: Path, tmp_path: Path, capsys) -> None:
    path = tmp_path / "strip.png"
    main(simulate(folder, "grasps.npz", "--first", "1", "--strip", str(path), "--quiet"))
    assert Image.open(path).width > 1000
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--friction", "-1"], "friction"),
        (["--first", "0"], "first"),
        (["--mass", "0"], "mass"),
        (["--video", "lift.avi"], ".mp4"),
        (["--video", "nowhere/lift.gif"], "nowhere"),
        (["--gripper", "kinova_kg3"], "joint"),
        (["--gripper", "franca_hand"], "franka_hand"),
        (["--table", "z=0.3"], "table"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(folder: Path, capsys, options: list[str], message: str) -> None:
    assert main(simulate(folder, "grasps.npz", *options)) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ")
    assert "\n" not in error
    assert message in error


def test_a_cloud_and_a_toppling_object_are_refused(folder: Path, tmp_path: Path, capsys) -> None:
    np.savetxt(tmp_path / "cloud.xyz", np.random.default_rng(0).random((50, 3)) * 0.05)
    stick = trimesh.creation.box(extents=(0.01, 0.01, 0.3))
    stick.apply_transform(trimesh.transformations.rotation_matrix(0.4, (1, 0, 0)))
    stick.export(tmp_path / "stick.stl")
    for name, message in (("cloud.xyz", "needs a mesh"), ("stick.stl", "does not stand")):
        assert main(["simulate", str(folder / "grasps.npz"), "--object", str(tmp_path / name)]) == 2
        assert message in capsys.readouterr().err


def test_an_empty_file_of_grasps_has_no_verdicts(folder: Path, tmp_path: Path, capsys) -> None:
    write_npz(planned(folder).best(0), tmp_path / "grasps.npz")
    status = main(["simulate", str(tmp_path / "grasps.npz"), "--object", str(folder / "tin.stl"), "--json"])
    assert status == 3
    assert json.loads(capsys.readouterr().out)["held"] == []


def test_parts_that_leave_out_some_of_the_mesh_are_said_to(folder: Path, tmp_path: Path, capsys) -> None:
    tin = trimesh.load(folder / "tin.stl")
    tin.export(tmp_path / "tin.stl")
    lower = trimesh.creation.cylinder(radius=0.03, height=0.05, sections=48)
    lower.apply_translation([0, 0, 0.025])
    (tmp_path / "convex").mkdir()
    lower.export(tmp_path / "convex" / "lower.stl")
    options = ["--object", str(tmp_path / "tin.stl"), "--first", "1"]
    main(["simulate", str(folder / "grasps.npz"), *options])
    said = " ".join("".join(capsys.readouterr()).split())
    assert "a twentieth of the mesh is 50 mm or more from the convex parts that stand for it" in said
    main(simulate(folder, "grasps.npz", "--first", "1"))
    assert "convex parts that" not in " ".join("".join(capsys.readouterr()).split())
