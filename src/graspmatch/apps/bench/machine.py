"""What is printed with every figure: the machine, the versions, the commit."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

PACKAGE = Path(__file__).parents[2]


def machine() -> dict[str, str]:
    """Where and of what the figures are."""
    return {
        "processor": _processor(),
        "cores": str(usable_cores()),
        "python": platform.python_version(),
        "warp": version("warp-lang"),
        "mujoco": version("mujoco"),
        "graspmatch": version("graspmatch"),
        "commit": _commit(),
    }


def described(about: dict[str, str]) -> str:
    """The same in one line."""
    return (
        f"graspmatch {about['graspmatch']} at commit {about['commit']}, {about['processor']}, {about['cores']} cores, "
        f"MuJoCo {about['mujoco']}, Warp {about['warp']}"
    )


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _commit() -> str:
    """Short hash of the checkout that the package runs from, with a + where its source differs; else unknown."""
    git = ["git", "-C", str(PACKAGE)]
    try:
        commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
        changes = subprocess.run([*git, "status", "--porcelain", "."], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return "unknown"
    return (commit.stdout.strip() or "unknown") + ("+" if changes.stdout.strip() else "")
