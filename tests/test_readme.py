"""What the README shows is run."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from graspmatch.apps.cli import parse
from graspmatch.scene.shapes import mug

README = (Path(__file__).parents[1] / "README.md").read_text()
PYTHON = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
COMMANDS = [line.split("#")[0] for line in README.splitlines() if line.startswith("    graspmatch ")]


@pytest.mark.parametrize("block", PYTHON)
def test_python_of_the_readme_runs(
    block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import trimesh

    trimesh.Trimesh(mug().vertices, mug().faces).export(str(tmp_path / "mug.stl"))
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "README.md", "exec"), {})
    assert "grasps for franka_hand" in capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_of_the_readme_are_understood(command: str) -> None:
    assert parse(shlex.split(command)[1:])


def test_the_readme_shows_commands_and_python() -> None:
    assert len(COMMANDS) >= 3
    assert len(PYTHON) >= 1
