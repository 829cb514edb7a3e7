"""The floors of the package, the size of its files and what importing it costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "graspmatch"
MODULES = sorted(PACKAGE.rglob("*.py"))
FRONT_DOOR = PACKAGE / "__init__.py"  # imports from every floor

FLOORS = [
    {"errors"},
    {"geometry"},
    {"kernels"},
    {"types", "config"},
    {"ranges"},
    {"gripper", "scene", "formats"},
    {"planner", "simulate"},
    {"apps"},
]
FLOOR_OF = {name: floor for floor, names in enumerate(FLOORS) for name in names}

VAGUE_NAMES = {"utils", "util", "helpers", "helper", "common", "misc", "manager", "managers"}
HEAVY = ["warp", "mujoco", "trimesh", "matplotlib", "scipy", "rich", "tyro", "yaml", "viser"]


def dotted_name(path: Path) -> str:
    """Name under which a file is imported."""
    parts = ("graspmatch", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_names(source: str, module: str) -> Iterator[str]:
    """Everything of graspmatch that a module imports, inside functions too, as dotted names."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "graspmatch")
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(module.split(".")[: -node.level]) if node.level else ""
            origin = ".".join(part for part in (base, node.module) if part)
            if origin.split(".")[0] == "graspmatch":
                yield from (f"{origin}.{alias.name}" for alias in node.names)


def part_of(name: str) -> str:
    """The package or module below graspmatch that a dotted name belongs to."""
    return name.split(".")[1] if "." in name else ""


def forbidden_imports(source: str, module: str) -> list[str]:
    """Imports of a module that do not go down: to its own part, or to a strictly lower floor."""
    own = part_of(module)
    return [
        name
        for name in imported_names(source, module)
        if part_of(name) != own and not FLOOR_OF.get(part_of(name), len(FLOORS)) < FLOOR_OF[own]
    ]


@pytest.mark.parametrize("path", [path for path in MODULES if path != FRONT_DOOR], ids=dotted_name)
def test_imports_go_down_only(path: Path) -> None:
    assert forbidden_imports(path.read_text(), dotted_name(path)) == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("graspmatch.planner.plan", "from graspmatch.simulate.lift import lift"),
        ("graspmatch.simulate.lift", "def f():\n    import graspmatch.planner.plan"),
        ("graspmatch.gripper.load", "from graspmatch.scene import scene"),
        ("graspmatch.geometry.se3", "from graspmatch import types"),
        ("graspmatch.types", "from graspmatch.config import PlannerConfig"),
        ("graspmatch.scene.files", "from ..formats import npz"),
        ("graspmatch.planner.plan", "import graspmatch"),
        ("graspmatch.planner.plan", "from graspmatch import plan"),
    ],
)
def test_imports_that_go_up_or_sideways_are_found(module: str, source: str) -> None:
    assert forbidden_imports(source, module) != []


def test_every_part_stands_on_a_floor() -> None:
    parts = {path.relative_to(PACKAGE).with_suffix("").parts[0] for path in MODULES} - {"__init__"}
    assert parts <= set(FLOOR_OF)


@pytest.mark.parametrize("path", MODULES, ids=dotted_name)
def test_files_are_short_enough_to_read_in_one_sitting(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 400


@pytest.mark.parametrize("path", MODULES, ids=dotted_name)
def test_names_say_what_a_module_is_about(path: Path) -> None:
    assert not VAGUE_NAMES & set(dotted_name(path).split("."))


def test_importing_graspmatch_loads_numpy_only() -> None:
    code = f"import sys, graspmatch; print([name for name in {HEAVY} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
