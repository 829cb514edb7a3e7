"""What every benchmark prints with its figures: the machine, the commit, and the objects."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import mug

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "bench" / "results"
PAPER_OBJECTS = ROOT / ".." / "shared" / "data" / "objects" / "paper"


def machine() -> dict[str, str]:
    """Where and of what the figures are."""
    return {
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "python": platform.python_version(),
        "warp": version("warp-lang"),
        "commit": _commit(),
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _commit() -> str:
    """Short hash, with a + where files differ from it."""
    git = ["git", "-C", str(ROOT)]
    commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    changes = subprocess.run([*git, "status", "--porcelain", "src"], capture_output=True, text=True, check=False)
    return (commit.stdout.strip() or "unknown") + ("+" if changes.stdout.strip() else "")


def scenes(folder: Path = PAPER_OBJECTS) -> dict[str, Scene]:
    """Every object of a folder of NAME/mesh.stl; the mug made by code where there is no such folder."""
    files = sorted(folder.glob("*/mesh.stl"))
    if not files:
        return {"mug": Scene.from_mesh(mug())}
    return {file.parent.name: Scene.from_mesh(file) for file in files}
