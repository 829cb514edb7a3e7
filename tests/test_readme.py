"""What the README and the pages of docs/ show is run, and what they name exists."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import hands
from graspmatch.apps.cli import parse
from graspmatch.config import PlannerConfig
from graspmatch.geometry import se3
from graspmatch.gripper.card import postures, read_card
from graspmatch.gripper.zoo import card_path, known_grippers
from graspmatch.scene.shapes import mug

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [README, *DOCS]
METHOD = (ROOT / "docs" / "method.md").read_text()
PYTHON = {page: "\n".join(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)) for page in PAGES}
COMMANDS = [
    line.split("#")[0] for page in PAGES for line in page.read_text().splitlines() if line.startswith("    graspmatch ")
]
FILES = r"```(?:toml|xml)\n((?:# |<!-- )([\w.]+)(?: -->)?\n.*?)```"
"""A block that begins with a comment of one file name is that file."""
AXES = {"+x": [1, 0, 0], "+y": [0, 1, 0], "+z": [0, 0, 1], "−z": [0, 0, -1]}


@pytest.fixture
def folder_of_a_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the pages' code runs: with a mug as mesh, and as the cloud of a camera 60 cm above it that looks down."""
    import trimesh

    trimesh.Trimesh(mug().vertices, mug().faces).export(str(tmp_path / "mug.stl"))
    T_world_camera = se3.from_parts(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    np.save(tmp_path / "cloud.npy", se3.apply(se3.inverse(T_world_camera), mug().vertices))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", [page for page in PAGES if PYTHON[page]], ids=lambda page: page.name)
def test_python_of_the_pages_runs(page: Path, folder_of_a_reader: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From top to bottom, as it is read."""
    for content, name in re.findall(FILES, page.read_text(), re.DOTALL):
        (folder_of_a_reader / name).write_text(content)
    exec(compile(PYTHON[page], page.name, "exec"), {})
    if page == README:
        assert "grasps for franka_hand" in capsys.readouterr().out
    if page.name == "grippers.md":
        grasps = re.search(r"(\d+) grasps for my_hand", capsys.readouterr().out)
        assert grasps is not None
        assert int(grasps.group(1)) > 0


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_of_the_pages_are_understood(command: str) -> None:
    assert parse(shlex.split(command)[1:])


def test_the_readme_shows_commands_and_python() -> None:
    assert len([line for line in README.read_text().splitlines() if line.startswith("    graspmatch ")]) >= 3
    assert PYTHON[README]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_the_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)", page.read_text()):
        assert target.startswith("https://") or (page.parent / target).is_file(), target


def test_functions_and_tests_that_the_method_names_exist() -> None:
    named = re.findall(r"`([\w/]+\.py): (\w+)`", METHOD)
    assert len(named) > 30
    for file, function in named:
        path = ROOT / file if file.startswith("tests/") else ROOT / "src" / "graspmatch" / file
        assert f"def {function}(" in path.read_text(), f"{file}: {function}"
    tests = "".join(path.read_text() for path in (ROOT / "tests").glob("test_*.py"))
    for function in re.findall(r"`(test_\w+)`", METHOD):
        assert f"def {function}(" in tests, function


def test_defaults_that_the_method_names_are_those_of_the_configuration() -> None:
    rows = re.findall(r"^\| .+ \| `(\w+)\.(\w+)`.* \| ([^|]+) \|$", METHOD, re.MULTILINE)
    checked = 0
    for stage, name, default in rows:
        if hasattr(PlannerConfig(), stage):
            assert float(default.split()[0].strip(",")) == getattr(getattr(PlannerConfig(), stage), name), name
            checked += 1
    assert checked >= 10


def test_the_table_of_hands_is_made_from_the_cards() -> None:
    assert hands.readme_with_table(README.read_text()) == README.read_text()


@pytest.mark.parametrize("name", known_grippers())
def test_tables_of_the_built_in_hands_say_what_the_cards_say(name: str) -> None:
    card = read_card(card_path(name))
    counts = f"{len(card.fingers)} | {len(card.joints)} | {len(postures(card, card.joint_names))}"
    numbers = f"{1000 * card.opening:.0f} | {card.finger_force:.0f}"
    samples = f"{card.samples.method}, {1000 * card.samples.voxel_size:.0f} mm"
    assert f"| `{name}` | {counts} | {numbers} | {samples} |" in (ROOT / "docs" / "grippers.md").read_text()
    row = rf"\| `{name}` \| `{card.base_link}` \| (\S+) \| (\S+) \|"
    axes = re.search(row, (ROOT / "docs" / "conventions.md").read_text())
    assert axes
    np.testing.assert_array_equal([AXES[axis] for axis in axes.groups()], [card.approach, card.closing])
