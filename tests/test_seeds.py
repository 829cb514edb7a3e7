"""Seeds from elsewhere: files of other planners and hands, and mixtures of Gaussians."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspmatch.apps.cli import main
from graspmatch.apps.options import Seeds
from graspmatch.apps.seeds import MOST, handover, start_of
from graspmatch.config import PlannerConfig
from graspmatch.errors import GraspmatchError
from graspmatch.formats.mixture import read_mixture
from graspmatch.formats.registry import read_grasps, write_grasps
from graspmatch.geometry import se3
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.plan import plan
from graspmatch.planner.seed import sample_gaussians
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import mug

ROW = [0.9, 0.03, 0.02, 0.02, 0, 1, 0, 0, 0, -1, -1, 0, 0, -0.033, 0, 0.1, -1]
"""Straight down on either side of the wall of a mug, as GraspNet writes it."""
MIXTURE = """
[[gaussian]]
position = [0.0, 0.0, 0.25]
wxyz = [0.0, 1.0, 0.0, 0.0]
sigma_position = 0.01
sigma_angle = 0.1

[[gaussian]]
position = [-0.2, 0.0, 0.05]
wxyz = [0.7071068, 0.0, 0.7071068, 0.0]
weight = 3
"""


@pytest.fixture(scope="module")
def franka():
    return load_gripper("franka_hand")


@pytest.fixture(scope="module")
def kg3():
    return load_gripper("kinova_kg3")


@pytest.fixture
def rows(tmp_path: Path) -> Path:
    np.save(tmp_path / "rows.npy", [ROW])
    return tmp_path / "rows.npy"


def test_grasps_of_another_hand_keep_tool_centre_and_axes(franka, kg3):
    """Both hands hold the same point, from the same side, with the fingers across the same line."""
    T_world_franka = se3.from_parts(se3.rotation_exp(np.array([0.3, 2.0, -1.0])), np.array([0.4, 0.1, 0.3]))
    T_world_kg3 = T_world_franka @ handover(franka, kg3)
    for T, hand in ((T_world_franka, franka), (T_world_kg3, kg3)):
        tool = se3.apply(T, hand.tool_centre_point[None])[0]
        np.testing.assert_allclose(tool, se3.apply(T_world_franka, franka.tool_centre_point[None])[0], atol=1e-9)
        for axis in ("approach", "closing"):
            np.testing.assert_allclose(
                T[:3, :3] @ getattr(hand, axis), T_world_franka[:3, :3] @ getattr(franka, axis), atol=1e-9
            )


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".yaml", ".json"])
def test_every_format_starts_another_hand_at_the_same_place(franka, kg3, rows: Path, tmp_path: Path, suffix: str):
    """Our own files and ACRONYM's say which hand they are of; of GraspGen's the option does."""
    path = tmp_path / f"seeds{suffix}"
    grasps = read_grasps(rows, franka)
    write_grasps(grasps, path, franka)
    start = start_of(Seeds(seeds=path, seeds_gripper="franka_hand"), kg3, PlannerConfig())
    assert start.T_world_gripper is not None
    np.testing.assert_allclose(start.T_world_gripper, grasps.T_world_gripper @ handover(franka, kg3), atol=1e-6)
    if suffix in (".npz", ".yaml"):
        told = start_of(Seeds(seeds=path), kg3, PlannerConfig())
        assert told.T_world_gripper is not None
        np.testing.assert_allclose(told.T_world_gripper, start.T_world_gripper, atol=1e-9)
        assert "of franka_hand in" in told.notes[0]


def test_poses_of_acronym_and_graspgen_are_canonical(franka, tmp_path: Path):
    """+z approach, +x closing, in the frame of the object, which is somewhere in the world."""
    import h5py

    T_object_canonical = se3.from_parts(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.2]))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["grasps/transforms"] = T_object_canonical[None]
        file["grasps/qualities/flex/object_in_gripper"] = [1]
        file["gripper/type"] = "panda"
    record = {"grasps": {"transforms": [T_object_canonical.tolist()], "object_in_gripper": [True]}}
    (tmp_path / "a.json").write_text(json.dumps(record))
    for name in ("a.h5", "a.json"):
        start = start_of(Seeds(seeds=tmp_path / name, seeds_pose="1,2,3,1,0,0,0"), franka, PlannerConfig())
        assert start.T_world_gripper is not None
        T = start.T_world_gripper[0]
        np.testing.assert_allclose(T[:3, 3], [1, 2, 3.2])
        np.testing.assert_allclose(T[:3, :3] @ franka.approach, [0, 0, -1], atol=1e-9)
        np.testing.assert_allclose(T[:3, :3] @ franka.closing, [1, 0, 0], atol=1e-9)


def test_canonical_poses_of_isaac_files_are_asked_for(franka, tmp_path: Path):
    (tmp_path / "a.yaml").write_text(
        "format: isaac_grasp\nformat_version: 1.0\ngrasps:\n  grasp_0:\n    confidence: 1.0\n"
        "    position: [0, 0, 0.2]\n    orientation: {w: 0, xyz: [1, 0, 0]}\n"
    )
    base, canonical = (
        start_of(Seeds(seeds=tmp_path / "a.yaml", seeds_frame=frame), franka, PlannerConfig()).T_world_gripper
        for frame in ("base", "canonical")
    )
    assert base is not None
    assert canonical is not None
    np.testing.assert_allclose(base[0, :3, :3] @ franka.closing, [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(canonical[0, :3, :3] @ franka.closing, [1, 0, 0], atol=1e-9)


def test_seeds_are_refined_by_matching(franka, rows: Path):
    """A hand that is 2 cm and 15 degrees off the wall of the mug finds it; the loss falls."""
    scene = Scene.from_mesh(mug())
    T = read_grasps(rows, franka).T_world_gripper
    off = T @ se3.from_parts(se3.rotation_exp(np.array([0.0, 0.26, 0.0])), np.array([0.0, 0.02, -0.02]))
    grasps = plan(scene, franka, PlannerConfig(device="cpu"), starts_world_gripper=off)
    assert len(grasps) > 0, grasps.explain()
    assert grasps.score[0] > 0.5
    assert np.linalg.norm(grasps.T_world_gripper[0, :3, 3] - off[0, :3, 3]) < 0.08


def test_of_many_grasps_the_best_are_started_from(franka, tmp_path: Path):
    many = np.tile(ROW, (MOST + 20, 1))
    many[:, 0] = np.linspace(0, 1, len(many))
    many[:, 13] = many[:, 0]
    np.save(tmp_path / "many.npy", many)
    start = start_of(Seeds(seeds=tmp_path / "many.npy"), franka, PlannerConfig())
    assert start.T_world_gripper is not None
    assert len(start.T_world_gripper) == MOST
    assert start.T_world_gripper[:, 0, 3].min() > 20 / len(many) - 0.01
    assert f"the best {MOST} of {MOST + 20} grasps" in start.notes[0]


def test_a_mixture_is_read_and_drawn_from(franka, tmp_path: Path):
    (tmp_path / "mixture.toml").write_text(MIXTURE)
    config = start_of(Seeds(seeds=tmp_path / "mixture.toml"), franka, PlannerConfig()).config
    assert config.seeding.pattern == "gaussians"
    poses = sample_gaussians(config.seeding.gaussians, 4000, np.random.default_rng(0))
    first = poses[:, 2, 3] > 0.2
    assert first.mean() == pytest.approx(0.25, abs=0.03)
    np.testing.assert_allclose(poses[first][:, :3, 3].mean(axis=0), [0, 0, 0.25], atol=0.002)
    np.testing.assert_allclose(poses[first][:, :3, 3].std(axis=0), 0.01, rtol=0.1)
    approach = poses[~first][:, :3, :3] @ franka.approach
    np.testing.assert_allclose(approach.mean(axis=0), [0.96, 0, 0], atol=0.03)  # spread by 0.2 rad


def test_a_mixture_of_canonical_poses_of_another_hand_is_moved(franka, kg3, tmp_path: Path):
    (tmp_path / "mixture.toml").write_text(MIXTURE)
    options = Seeds(
        seeds=tmp_path / "mixture.toml",
        seeds_frame="canonical",
        seeds_gripper="franka_hand",
        seeds_pose="1,0,0,1,0,0,0",
    )
    gaussian = start_of(options, kg3, PlannerConfig()).config.seeding.gaussians[0]
    T = se3.from_parts(se3.matrix_from_quaternion(np.array(gaussian.wxyz)), np.array(gaussian.position))
    np.testing.assert_allclose(T[:3, :3] @ kg3.approach, [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(T[:3, :3] @ kg3.closing, [1, 0, 0], atol=1e-6)
    tool = se3.apply(T, kg3.tool_centre_point[None])[0]
    np.testing.assert_allclose(tool, [1, 0, 0.25 - franka.tool_centre_point @ franka.approach], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("[[gaussian]]", "[[pose]]"), "tables \\[\\[gaussian\\]\\] and nothing else"),
        (("[[gaussian]]", "[[gaussian"), "is not TOML"),
        (("position = [0.0, 0.0, 0.25]", "position = [0.0, 0.25]"), "gaussian 0: 'position'.*3 finite numbers"),
        (("position = [0.0, 0.0, 0.25]", ""), "gaussian 0 has no 'position'. Known: .*sigma_angle"),
        (("weight = 3", "wait = 3"), "gaussian 1 has 'wait'. Known: .*weight"),
        (("weight = 3", "weight = -1"), "must not be negative"),
        (("sigma_angle = 0.1", "sigma_angle = nan"), "one finite number"),
        (("wxyz = [0.0, 1.0, 0.0, 0.0]", "wxyz = [0.0, 2.0, 0.0, 0.0]"), "quaternion has the length 2"),
    ],
)
def test_a_mixture_that_is_none_says_what_is_wrong(tmp_path: Path, change, expected):
    (tmp_path / "mixture.toml").write_text(MIXTURE.replace(*change))
    with pytest.raises(GraspmatchError, match=expected):
        read_mixture(tmp_path / "mixture.toml")


def test_seeds_on_the_command_line(tmp_path: Path, rows: Path, capsys):
    trimesh.Trimesh(mug().vertices, mug().faces).export(str(tmp_path / "mug.stl"))
    (tmp_path / "mixture.toml").write_text(MIXTURE)
    words = ["plan", str(tmp_path / "mug.stl"), "--gripper", "franka_hand", "--device", "cpu", "--json", "--fast"]
    for name in ("rows.npy", "mixture.toml"):
        assert main([*words, "--seeds", str(tmp_path / name)]) == 0
        output = capsys.readouterr()
        assert json.loads(output.out)["grasps"]
        assert f"Hands start from {'1 grasp in' if name == 'rows.npy' else 'the Gaussians of'} {name}" in output.err
    for extra, expected in (
        (["--seeds", str(tmp_path / "none.npy")], "Cannot read"),
        (["--seeds", str(rows), "--seeds-pose", "1,2"], "A pose must be"),
        (["--seeds", str(rows), "--seeds-gripper", "franca"], "No gripper named 'franca'"),
        (["--robot-tip", "flange"], "need the robot itself"),
        (["--approach-distance", "3"], "approach_distance is 3"),
    ):
        assert main([*words, *extra]) == 2
        assert expected in json.loads(capsys.readouterr().out)["error"]
