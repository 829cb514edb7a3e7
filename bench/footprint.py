"""Memory and start-up times, each in fresh processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

PLAN = """
import json, sys, time
from pathlib import Path
import trimesh
import graspmatch.planner.plan
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.plan import plan
from setting import PAPER_OBJECTS, scenes

def memory_mb(entry):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(entry))

scene = next(iter(scenes(PAPER_OBJECTS, 1).values()))
Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
imported = memory_mb("VmRSS")
gripper = load_gripper(sys.argv[1])
begin = time.perf_counter()
plan(scene, gripper)
first = time.perf_counter() - begin
plan(scene, gripper)
print(json.dumps({"peak_mb": memory_mb("VmHWM") - imported, "first_plan_s": first}))
"""
"""The scene is made before memory is looked at, for reading a mesh is no part of planning. Linux only."""
IMPORT = "import time; begin = time.perf_counter(); import graspmatch; print(time.perf_counter() - begin)"


def footprint(gripper: str, repeats: int, *, fresh: bool) -> dict[str, float]:
    """Peak memory of planning above the interpreter, its imports and the scene [MB]; median seconds of importing the
    package and of the command's help; and, where a `fresh` machine is asked for, of the first plan, kernels compiled.
    """
    found = {
        "peak_mb": _plan(gripper)["peak_mb"],
        "import_s": float(np.median([float(_run([sys.executable, "-c", IMPORT])) for _ in range(repeats)])),
        "help_s": float(np.median([_help_seconds() for _ in range(repeats)])),
    }
    if fresh:
        with tempfile.TemporaryDirectory() as folder:
            found["first_plan_s"] = _plan(gripper, WARP_CACHE_PATH=folder)["first_plan_s"]
    return found


def _plan(gripper: str, **environment: str) -> dict[str, float]:
    return json.loads(_run([sys.executable, "-c", PLAN, gripper], **environment).splitlines()[-1])


def _help_seconds() -> float:
    begin = time.perf_counter()
    _run([str(Path(sys.executable).parent / "graspmatch"), "--help"])
    return time.perf_counter() - begin


def _run(command: list[str], **environment: str) -> str:
    here = Path(__file__).parent
    return subprocess.run(
        command, capture_output=True, text=True, check=True, cwd=here, env=os.environ | environment
    ).stdout
