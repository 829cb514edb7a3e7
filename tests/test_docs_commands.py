"""The commands that README and docs/ print are run, from the top of each page to its end, by one who has the files."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from depth_scenes import Box, Cylinder, K, Setting, noisy, render
from graspmatch.apps.cli import main
from graspmatch.gripper.zoo import card_path
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import mug

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SETTING = Setting((Box(0.0, 0, (0.05, 0.1, 0.12), 0.3), Cylinder(0.16, 0.02, 0.03, 0.1)))

NOT_RUN = {
    "bench": "takes minutes; tests/test_bench.py has a small one",
    "view": "stays until it is ended; tests/test_viewer_page.py looks at it",
    "--view": "the same",
    "recording.mcap": "needs a bag; tests/test_depth_bags.py makes some",
    "theirs.h5": "needs h5py; tests/test_formats_convert.py has it",
    "seeds.npz": "made of theirs.h5",
    "--robot": "needs an arm; tests/test_arm.py has one",
    "--seeds": "needs grasps of others; tests/test_seeds.py has some",
    "menagerie:wonik_allegro/right_hand": "needs MuJoCo Menagerie; tests/test_find_description.py reads such names",
}
"""Words of commands that are parsed only, in tests/test_readme.py, and why."""


def commands_of_pages() -> dict[Path, list[list[str]]]:
    """The words of each command that is run, under the first page that has it."""
    known: set[str] = set()
    found: dict[Path, list[list[str]]] = {page: [] for page in PAGES}
    for page in PAGES:
        for line in page.read_text().splitlines():
            words = shlex.split(line.split(" #")[0])[1:] if line.startswith("    graspmatch ") else []
            if words and not NOT_RUN.keys() & set(words) and shlex.join(words) not in known:
                known.add(shlex.join(words))
                found[page].append(words)
    return found


COMMANDS = commands_of_pages()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All files that the pages speak of."""
    import trimesh

    folder = tmp_path_factory.mktemp("files")
    trimesh.Trimesh(mug().vertices, mug().faces).export(str(folder / "mug.stl"))
    cloud = Scene.from_mesh(mug()).target.points
    trimesh.PointCloud(cloud).export(str(folder / "cloud.ply"))
    depth = noisy(render(SETTING)[0], np.random.default_rng(0))
    Image.fromarray(np.round(1000 * depth).astype(np.uint16)).save(folder / "depth.png")
    (folder / "camera_info.yaml").write_text(f"width: 640\nheight: 480\nk: {K.ravel().tolist()}\n")
    np.savetxt(folder / "pose.txt", SETTING.camera.pose)
    write_scene(depth, folder / "scene.pcd")
    (folder / "path" / "to").mkdir(parents=True)
    zoo = card_path("franka_hand").parent
    shutil.copy(zoo / "franka_hand.xml", folder / "path" / "to" / "hand.xml")
    for name, content in re.findall(
        r"```(?:toml|xml)\n(?:# |<!-- )([\w.]+)(?: -->)?\n(.*?)```", (ROOT / "docs/grippers.md").read_text(), re.DOTALL
    ):
        (folder / "path" / "to" / name).write_text(content)
    shutil.copy(folder / "path" / "to" / "my_hand.xml", folder / "my_hand.urdf")  # by its content, not by its name
    return folder


def write_scene(depth: np.ndarray, path: Path) -> None:
    """The cloud of a depth image, as PCD with rows."""
    columns, rows = np.meshgrid((np.arange(640) - K[0, 2]) / K[0, 0], (np.arange(480) - K[1, 2]) / K[1, 1])
    points = np.where(depth > 0, depth, np.nan)[..., None] * np.dstack([columns, rows, np.ones(depth.shape)])
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 640\nHEIGHT 480\n"
    head += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 307200\nDATA binary\n"
    path.write_bytes(head.encode() + points.astype("<f4").tobytes())


@pytest.fixture
def here(files: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(files)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    yield files
    assert Path(os.getcwd()) == files


@pytest.mark.parametrize("page", [page for page in PAGES if COMMANDS[page]], ids=lambda page: page.name)
def test_commands_of_the_pages_do_what_they_say(page: Path, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if page.name in ("simulation.md", "formats.md"):  # they begin with grasps that were planned before
        for name in ("grasps.yaml", "grasps.npz"):
            assert main(["plan", "mug.stl", "--gripper", "franka_hand", "--count", "4", "-o", name, "--quiet"]) == 0
    for words in COMMANDS[page]:
        if words[0] == "simulate" and "--first" not in words:
            words = [*words, "--first", "1"]  # each takes a while
        status = main(words)
        said = capsys.readouterr()
        assert status == 0, f"{words}: {said.err} {said.out}"
        for option in ("-o", "--picture", "--video", "--strip"):
            for i, word in enumerate(words):
                if word == option:
                    assert (here / words[i + 1]).stat().st_size > 0


def test_every_page_with_commands_is_run() -> None:
    assert sum(map(len, COMMANDS.values())) >= 15
