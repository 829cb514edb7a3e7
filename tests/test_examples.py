"""The examples run as they are, are short, and do what they say."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
NEEDS = {"view": "viser", "torch_tensors": "torch"}
ARGUMENTS = {"view": ["--seconds", "0.2", "--port", "8610"]}
SAYS = {
    "plan": "Wrote grasps.yaml",
    "own_gripper": "grasps for two_plates from",
    "depth_camera": "The best one, in the world",
    "simulate": "of 3 held",
    "view": "Open http://127.0.0.1:",
    "refine_other": "of theirs",
    "torch_tensors": "torch.Size([",
}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path: Path, tmp_path: Path) -> None:
    needed = NEEDS.get(path.stem)
    if needed and find_spec(needed) is None:
        pytest.skip(f"needs {needed}, which is not installed")
    command = [sys.executable, str(path), *ARGUMENTS.get(path.stem, [])]
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": "", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert SAYS[path.stem] in done.stdout
    assert not done.stdout.startswith("0 grasps")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) < 60


def test_there_is_an_example_of_everything() -> None:
    assert {path.stem for path in EXAMPLES} == set(SAYS)
