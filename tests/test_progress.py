"""Progress is shown to people who look, and to nobody else."""

from __future__ import annotations

import io
import json
import os
import pty
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from graspmatch.apps.speech import Speech


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_sees_what_is_being_done(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with Speech().progress("Counting", total=2) as done:
        done()
        done()
    assert "Counting" in terminal.getvalue()
    assert "2/2" in terminal.getvalue()


@pytest.mark.parametrize(("speech", "is_terminal"), [(Speech(quiet=True), True), (Speech(), False)])
def test_nobody_else_sees_anything(speech: Speech, is_terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal() if is_terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    with speech.progress("Counting", total=1) as done:
        done()
    assert stream.getvalue() == ""


def test_what_is_printed_meanwhile_stays_off_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    with Speech(as_json=True).progress("Counting"):
        print("a library's remark")
    said = capsys.readouterr()
    assert said.out == ""
    assert "a library's remark" in said.err


def test_json_is_all_that_reaches_stdout_while_a_terminal_shows_progress(tmp_path: Path) -> None:
    import trimesh

    from graspmatch.scene.shapes import mug

    trimesh.Trimesh(mug().vertices, mug().faces).export(str(tmp_path / "mug.stl"))
    words = ["plan", str(tmp_path / "mug.stl"), "--gripper", "franka_hand", "--device", "cpu", "--json"]
    ours, theirs = pty.openpty()
    said: list[bytes] = []
    listener = threading.Thread(target=listen, args=(ours, said))
    listener.start()
    done = subprocess.run(
        [sys.executable, "-m", "graspmatch.apps.cli", *words],
        stdout=subprocess.PIPE,
        stderr=theirs,
        env={**os.environ, "TERM": "xterm"},
        timeout=120,
        check=True,
    )
    os.close(theirs)
    listener.join()
    assert len(json.loads(done.stdout)["grasps"]) > 0
    assert "Planning" in b"".join(said).decode()


def listen(terminal: int, said: list[bytes]) -> None:
    """Keep what comes out of a terminal until the last who writes to it has closed it."""
    while True:
        try:
            heard = os.read(terminal, 65536)
        except OSError:  # how Linux says that nobody is left
            break
        if not heard:
            break
        said.append(heard)
    os.close(terminal)
