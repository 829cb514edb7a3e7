"""`graspmatch view` and `plan --view` as programs: what they print, where they listen, how they end."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from graspmatch.apps.cli import main
from graspmatch.scene.shapes import mug

pytest.importorskip("viser", reason="needs viser: pip install 'graspmatch[view]'")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import trimesh

    folder = tmp_path_factory.mktemp("view")
    trimesh.Trimesh(mug().vertices, mug().faces).export(str(folder / "mug.stl"))
    words = ["plan", str(folder / "mug.stl"), "--gripper", "franka_hand", "--count", "5", "--device", "cpu", "--quiet"]
    assert main([*words, "-o", str(folder / "grasps.npz"), "-o", str(folder / "grasps.yaml")]) == 0
    return folder


@contextmanager
def running(*words: str) -> Iterator[tuple[subprocess.Popen, dict[str, Any]]]:
    """A command that serves a page, and the one object that it prints."""
    command = [sys.executable, "-m", "graspmatch.apps.cli", *words, "--json"]
    # Children of a shell's background jobs ignore Ctrl-C unless told otherwise; a terminal's do not.
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert process.stdout is not None
        yield process, json.loads(process.stdout.readline())
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("name", ["grasps.npz", "grasps.yaml"])
def test_a_file_is_shown_until_it_is_ended(name: str, folder: Path) -> None:
    words = ["view", str(folder / name), "--object", str(folder / "mug.stl"), "--port", "8390", "--device", "cpu"]
    with running(*words) as (process, said):
        assert said["grasps"] == 5
        with urllib.request.urlopen(said["url"], timeout=30) as page:
            assert page.status == 200
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=30)
        assert process.returncode == 0
        assert rest == ""


def test_only_this_machine_is_served(folder: Path) -> None:
    with running("view", str(folder / "grasps.npz"), "--port", "8490", "--device", "cpu") as (_, said):
        port = int(said["url"].rsplit(":", 1)[1])
        with socket.socket() as other:
            # Another address of this machine: a server that listens everywhere would answer there.
            assert other.connect_ex(("127.0.0.2", port)) != 0


def test_planning_ends_with_the_page(folder: Path) -> None:
    words = ["plan", str(folder / "mug.stl"), "--gripper", "franka_hand", "--count", "3", "--device", "cpu", "--view"]
    with running(*words) as (_, said):
        assert len(said["grasps"]) == 3
        assert said["url"].startswith("http://127.0.0.1:")


def test_grasps_of_another_hand_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(folder / "grasps.npz"), "--gripper", "barrett_bh282", "--device", "cpu"]) == 2
    assert "barrett_bh282 has" in capsys.readouterr().err


def test_what_is_missing_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["view", str(folder / "grasps.npz")]) == 2
    assert "graspmatch[view]" in capsys.readouterr().err
