"""The command line: what goes wrong is one line and a status, what goes right is a table, files and one JSON object."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from graspmatch.apps import report
from graspmatch.apps.cli import main, parse
from graspmatch.apps.options import Plan
from graspmatch.formats.registry import read_grasps
from graspmatch.scene.shapes import mug

Captured = pytest.CaptureFixture[str]


@pytest.fixture
def mug_file(tmp_path: Path) -> Path:
    """A mug as an STL file in metres."""
    import trimesh

    path = tmp_path / "mug.stl"
    trimesh.Trimesh(mug().vertices, mug().faces).export(str(path))
    return path


def parse_plan(*words: str) -> Plan:
    """The command of `graspmatch plan` with these options."""
    command = parse(["plan", "mug.stl", "--gripper", "franka_hand", *words])
    assert isinstance(command, Plan)
    return command


def fails_with_one_line(captured: Captured, *words: str) -> str:
    """The error message; there is one line of it, with these words, and no traceback."""
    output = captured.readouterr()
    lines = output.err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert all(word in lines[0] for word in words)
    assert output.out == ""
    return lines[0]


def test_an_unknown_gripper_lists_the_known_ones(mug_file: Path, capsys: Captured) -> None:
    assert main(["plan", str(mug_file), "--gripper", "franca"]) == 2
    fails_with_one_line(capsys, "franca", "franka_hand", "barrett_bh282", "kinova_kg3", "robotiq_2f85")


def test_a_missing_card_is_named(mug_file: Path, capsys: Captured) -> None:
    assert main(["plan", str(mug_file), "--gripper", "my_hand.toml"]) == 2
    fails_with_one_line(capsys, "my_hand.toml")


def test_a_missing_input_is_named(tmp_path: Path, capsys: Captured) -> None:
    assert main(["plan", str(tmp_path / "cup.stl"), "--gripper", "franka_hand"]) == 2
    fails_with_one_line(capsys, "cup.stl")


def test_an_unknown_suffix_of_the_output_lists_the_known_ones(mug_file: Path, capsys: Captured) -> None:
    assert main(["plan", str(mug_file), "--gripper", "franka_hand", "-o", "grasps.txt"]) == 2
    fails_with_one_line(capsys, "grasps.txt", ".npz", ".yaml")


def test_a_picture_is_a_png(mug_file: Path, capsys: Captured) -> None:
    assert main(["plan", str(mug_file), "--gripper", "franka_hand", "--picture", "grasps.gif"]) == 2
    fails_with_one_line(capsys, "grasps.gif", ".png")


@pytest.mark.parametrize("option", ["-o", "--picture"])
def test_an_unwritable_output_is_refused_before_planning(
    mug_file: Path, tmp_path: Path, capsys: Captured, option: str
) -> None:
    target = tmp_path / "missing" / ("grasps.npz" if option == "-o" else "grasps.png")
    assert main(["plan", str(mug_file), "--gripper", "franka_hand", option, str(target)]) == 2
    fails_with_one_line(capsys, "missing", "make it first")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mug.stl"]


def test_a_table_above_the_object_is_refused(mug_file: Path, tmp_path: Path, capsys: Captured) -> None:
    target = tmp_path / "grasps.npz"
    assert main(["plan", str(mug_file), "--gripper", "franka_hand", "--table", "z=0.5", "-o", str(target)]) == 2
    fails_with_one_line(capsys, "table", "above")
    assert not target.exists()


@pytest.mark.parametrize("table", ["floor", "z=", "nan", "z=inf"])
def test_a_table_that_is_no_height_says_what_is_possible(mug_file: Path, capsys: Captured, table: str) -> None:
    assert main(["plan", str(mug_file), "--gripper", "franka_hand", "--table", table]) == 2
    fails_with_one_line(capsys, "table")


def test_an_absent_device_lists_the_available_ones(mug_file: Path, capsys: Captured) -> None:
    assert main(["plan", str(mug_file), "--gripper", "franka_hand", "--device", "cuda:99"]) == 2
    fails_with_one_line(capsys, "cuda:99", "Available: cpu")


def test_millimetres_are_asked_about(tmp_path: Path, capsys: Captured) -> None:
    import trimesh

    trimesh.Trimesh(1000 * mug().vertices, mug().faces).export(str(tmp_path / "mug.stl"))
    assert main(["plan", str(tmp_path / "mug.stl"), "--gripper", "franka_hand"]) == 2
    fails_with_one_line(capsys, "millimetres", "--unit mm")


def test_an_error_in_json_mode_is_a_json_object(tmp_path: Path, capsys: Captured) -> None:
    assert main(["plan", str(tmp_path / "cup.stl"), "--gripper", "franka_hand", "--json"]) == 2
    output = capsys.readouterr()
    assert "cup.stl" in json.loads(output.out)["error"]
    assert output.err.startswith("error: ")


def test_debug_shows_where_an_error_comes_from(tmp_path: Path, capsys: Captured) -> None:
    assert main(["plan", str(tmp_path / "cup.stl"), "--gripper", "franka_hand", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_a_fault_of_ours_is_one_line_too(capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**_: object) -> int:
        raise RuntimeError("two\nlines")

    monkeypatch.setattr("graspmatch.apps.commands.list_grippers", fail)
    assert main(["grippers"]) == 1
    fails_with_one_line(capsys, "RuntimeError", "two lines", "--debug")


def test_options_that_do_not_exist_leave_with_status_2(capsys: Captured) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["plan", "mug.stl", "--gripper", "franka_hand", "--seeed", "7"])
    assert caught.value.code == 2


def test_the_configuration_is_the_command_line() -> None:
    words = ["--seed", "7", "--device", "cpu", "--matching.iterations", "60", "--ranking.distinct-angle", "0.5"]
    config = parse_plan(*words).config
    assert (config.seed, config.device, config.matching.iterations) == (7, "cpu", 60)
    assert config.ranking.distinct_angle == 0.5


def test_short_forms_are_the_same_options() -> None:
    short = parse_plan("--method=icp", "--count", "5")
    long = parse_plan("--matching.method", "icp", "--ranking.count", "5")
    assert short == long
    assert (short.config.matching.method, short.config.ranking.count) == ("icp", 5)


@pytest.mark.skipif(os.name == "nt", reason="pipes of POSIX systems")
@pytest.mark.parametrize("words", [["bench", "--help"], ["grippers"], ["grippers", "--json"]])
def test_output_that_nobody_reads_on_is_no_error(words: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([sys.executable, "-m", "graspmatch.apps.cli", *words], stdout=writing, stderr=subprocess.PIPE)
    os.close(writing)
    assert done.stderr == b""
    assert done.returncode == 141


def test_a_pipe_of_ours_that_breaks_is_a_fault() -> None:
    code = (
        "import sys\nfrom graspmatch.apps import cli\n"
        "def run(command):\n    raise BrokenPipeError('a worker died')\n"
        "cli.run = run\nsys.exit(cli.main(['grippers']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert "a worker died" in done.stderr


def test_help_is_fast_and_loads_nothing_heavy() -> None:
    code = (
        "import sys\nfrom graspmatch.apps.cli import main\n"
        "try:\n    main(['plan', '--help'])\nexcept SystemExit:\n    pass\n"
        "print([name for name in ('warp', 'mujoco', 'trimesh', 'scipy', 'matplotlib') if name in sys.modules])"
    )
    begin = time.perf_counter()
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert time.perf_counter() - begin < 3  # 0.3 s on an idle machine
    assert "--matching.method" in result.stdout
    assert result.stdout.splitlines()[-1] == "[]"


def test_grippers_lists_every_hand_without_loading_it(capsys: Captured) -> None:
    assert main(["grippers"]) == 0
    table = capsys.readouterr().out
    assert main(["grippers", "--json"]) == 0
    hands = json.loads(capsys.readouterr().out)["grippers"]
    assert {"franka_hand", "barrett_bh282", "kinova_kg3", "robotiq_2f85"} <= {hand["name"] for hand in hands}
    assert all(hand["name"] in table for hand in hands)
    assert all(hand["preshapes"] > 0 and hand["opening"] > 0 for hand in hands)


def test_a_plan_is_a_table_files_and_one_json_object(mug_file: Path, tmp_path: Path, capsys: Captured) -> None:
    outputs = [tmp_path / "grasps.npz", tmp_path / "grasps.yaml"]
    words = ["--seed", "7", "--device", "cpu", "--count", "3", "--json"]
    assert main(["plan", str(mug_file), "--gripper", "franka_hand", "-o", *map(str, outputs[:1]), *words]) == 0
    output = capsys.readouterr()
    record = json.loads(output.out)
    grasps = read_grasps(outputs[0])
    assert 0 < len(record["grasps"]) == len(grasps) <= 3
    assert record["grasps"][0]["T_world_gripper"] == grasps.T_world_gripper[0].tolist()
    assert list(record["grasps"][0]["grasp_joints"]) == list(grasps.joint_names)
    assert record["provenance"]["seed"] == 7
    assert record["tally"]["candidates"] > 0
    assert sum(record["seconds"].values()) > 0
    assert "preshape" in output.err

    assert main(["plan", str(mug_file), "--gripper", "franka_hand", "-o", str(outputs[1]), *words[:-1], "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    np.testing.assert_allclose(read_grasps(outputs[1]).T_world_gripper, grasps.T_world_gripper, atol=1e-6)


def test_no_grasp_is_explained_and_writes_nothing(tmp_path: Path, capsys: Captured) -> None:
    import trimesh

    plate = tmp_path / "plate.stl"
    trimesh.creation.box((0.3, 0.3, 0.004)).export(str(plate))
    target = tmp_path / "grasps.yaml"
    words = ["--gripper", "franka_hand", "--device", "cpu", "-o", str(target)]
    assert main(["plan", str(plate), *words]) == 3
    assert "0 grasps for franka_hand" in capsys.readouterr().out
    assert main(["plan", str(plate), *words, "--json"]) == 3
    record = json.loads(capsys.readouterr().out)
    assert record["grasps"] == []
    assert "0 grasps" in record["explanation"]
    assert not target.exists()


def test_unknown_numbers_are_null_in_json() -> None:
    assert report.finite_or_null({"a": [1.0, float("nan")], "b": float("inf")}) == {"a": [1.0, None], "b": None}


def test_the_demo_writes_every_kind_of_file(tmp_path: Path, capsys: Captured) -> None:
    assert main(["demo", "--folder", str(tmp_path / "demo"), "--device", "cpu"]) == 0
    assert sorted(path.name for path in (tmp_path / "demo").iterdir()) == ["grasps.npz", "grasps.png", "grasps.yaml"]
    assert len(read_grasps(tmp_path / "demo" / "grasps.npz")) >= 10
    assert (tmp_path / "demo" / "grasps.png").read_bytes().startswith(b"\x89PNG")
    assert "grasps for franka_hand" in capsys.readouterr().out
