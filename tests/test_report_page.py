"""The page of `graspmatch report`: whole, safe, and in need of nothing else."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from graspmatch.apps.cli import main
from graspmatch.config import PlannerConfig, RankingConfig, SeedingConfig
from graspmatch.formats.registry import write_grasps
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import mug
from graspmatch.types import GraspSet

CONFIG = PlannerConfig(
    device="cpu", ranking=RankingConfig(count=5), seeding=SeedingConfig(points=40, above=2, batches=1)
)


class Reader(HTMLParser):
    """What a page is made of: tags that are open, whatever it loads, and its text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.loads: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.loads += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def read(page: Path) -> Reader:
    reader = Reader()
    reader.feed(page.read_text())
    assert reader.open == []
    return reader


@pytest.fixture(scope="module")
def grasps() -> GraspSet:
    return plan(replace(Scene.from_mesh(mug()), source="mug.stl"), load_gripper("franka_hand"), CONFIG)


@pytest.fixture
def folder(tmp_path: Path, grasps: GraspSet) -> Path:
    import trimesh

    trimesh.Trimesh(mug().vertices, mug().faces).export(str(tmp_path / "mug.stl"))
    write_grasps(grasps, tmp_path / "mug.npz")
    return tmp_path


def verdicts(count: int) -> dict:
    return {
        "protocol": "lift",
        "engine": "MuJoCo",
        "mass": 0.2,
        "settings": {"friction": 0.6},
        "held": [True] * (count - 1) + [False],
        "reason": [""] * (count - 1) + ["slipped in the lift"],
    }


def report(folder: Path, *words: str) -> int:
    return main(["report", str(folder / "mug.npz"), "-o", str(folder / "report.html"), *words])


def test_the_page_holds_picture_table_tally_times_and_verdicts(folder: Path, grasps: GraspSet) -> None:
    (folder / "verdicts.json").write_text(json.dumps(verdicts(len(grasps))))
    words = ["--object", str(folder / "mug.stl"), "--verdicts", str(folder / "verdicts.json"), "--quiet"]
    assert report(folder, *words) == 0
    page = read(folder / "report.html")
    assert len(page.loads) == 1
    assert page.loads[0].startswith("data:image/webp;base64,")
    for said in (f"{len(grasps)} grasps of mug.stl", "slipped in the lift", "candidates", "match", "franka_hand"):
        assert said in page.text
    assert page.text.count("close_") == len(grasps)
    assert f"{len(grasps) - 1} of {len(grasps)} held" in page.text
    for reason, count in grasps.tally.items():
        assert reason in page.text or not count


def test_nothing_is_loaded_from_elsewhere(folder: Path) -> None:
    assert report(folder, "--quiet") == 0
    text = (folder / "report.html").read_text()
    assert read(folder / "report.html").loads == []
    assert not re.search(r"https?://|url\(|@import", text)


def test_names_in_a_file_cannot_write_the_page(folder: Path, grasps: GraspSet) -> None:
    evil = "<script>alert(1)</script>"
    bad = replace(
        grasps,
        preshape_names=tuple(evil for _ in grasps.preshape_names),
        tally={"candidates": 9, evil: 3},
        provenance=replace(grasps.provenance, source=evil, version=evil, device=evil, config=evil),
    )
    write_grasps(bad, folder / "mug.npz")
    assert report(folder, "--quiet") == 0
    page = read(folder / "report.html")
    assert "script" not in page.tags
    assert evil in page.text


def test_an_empty_set_says_why(folder: Path, grasps: GraspSet) -> None:
    write_grasps(replace(grasps.best(0), advice="The hand does not fit."), folder / "mug.npz")
    assert report(folder, "--quiet") == 0
    text = read(folder / "report.html").text
    assert "0 grasps" in text
    assert "The hand does not fit." in text


def test_json_says_what_was_written(folder: Path, grasps: GraspSet, capsys: pytest.CaptureFixture[str]) -> None:
    assert report(folder, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["grasps"] == len(grasps)
    assert said["bytes"] == (folder / "report.html").stat().st_size


@pytest.mark.parametrize("content", ["[]", "{", '{"held": 3}', "[" * 5000])
def test_other_files_are_no_verdicts(folder: Path, content: str, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "verdicts.json").write_text(content)
    assert report(folder, "--verdicts", str(folder / "verdicts.json")) == 2
    assert "simulate --json" in capsys.readouterr().err


def test_verdicts_on_other_grasps_are_refused(folder: Path, grasps: GraspSet) -> None:
    (folder / "verdicts.json").write_text(json.dumps(verdicts(len(grasps) + 1)))
    assert report(folder, "--verdicts", str(folder / "verdicts.json")) == 2


def test_unknown_numbers_are_question_marks(folder: Path, grasps: GraspSet) -> None:
    unknown = replace(grasps, quality=np.full(len(grasps), np.nan), loss=np.full(len(grasps), np.nan))
    write_grasps(unknown, folder / "mug.npz")
    assert report(folder, "--quiet") == 0
    assert read(folder / "report.html").text.count("?") == 2 * len(grasps)
