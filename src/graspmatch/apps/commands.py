"""What the subcommands do."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich import box
from rich.console import Console
from rich.table import Table

from graspmatch.apps import report
from graspmatch.config import PlannerConfig
from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import check_place, write_atomically
from graspmatch.formats.registry import read_grasps, write_grasps, writer_of
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet, Gripper

NOT_FOUND = 3
"""Exit status when there is no grasp."""

PICTURED = 3
"""A picture shows the hand at so many of the best grasps."""


@dataclass(frozen=True)
class Speech:
    """Where text for people goes: to stdout, to stderr where stdout is for JSON, or nowhere."""

    as_json: bool = False
    quiet: bool = False

    def show(self, what: object) -> None:
        """Print text or a table."""
        stream = sys.stderr if self.as_json else sys.stdout
        # A log file has room for whole tables; a terminal knows its own width.
        console = Console(file=stream, quiet=self.quiet, width=None if stream.isatty() else 140)
        console.print(what, highlight=False, markup=False, soft_wrap=isinstance(what, str))

    @contextlib.contextmanager
    def progress(self, message: str) -> Iterator[None]:
        """Show one line while something runs, if someone is looking; what it prints goes to stderr."""
        console = Console(stderr=True, quiet=self.quiet)
        status = console.status(message) if console.is_terminal else contextlib.nullcontext()
        with status, contextlib.redirect_stdout(sys.stderr):
            yield


def plan_file(
    path: Path,
    gripper_name: str,
    config: PlannerConfig,
    say: Speech,
    *,
    description: Path | None,
    outputs: Sequence[Path],
    picture: Path | None,
    table: float | Literal["auto"] | None,
    unit: Literal["auto", "m", "mm", "cm"],
    obstacles: Path | None,
    starts: Path | None,
) -> int:
    """Plan grasps for the object of a file, show and write them; the result is the exit status."""
    check_outputs(outputs, picture)
    with say.progress(f"Reading {path.name}"):
        scene = Scene.read(path, table=table, unit=unit, obstacles=obstacles)
        start_grasps = None if starts is None else read_grasps(starts)
    gripper = load(gripper_name, description, config, say)
    return plan_and_report(scene, gripper, config, say, outputs=outputs, picture=picture, starts=start_grasps)


def demo(folder: Path, config: PlannerConfig, say: Speech) -> int:
    """Plan grasps for a mug made by code and write every kind of file to a folder."""
    from graspmatch.scene.shapes import mug

    outputs, picture = [folder / "grasps.yaml", folder / "grasps.npz"], folder / "grasps.png"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GraspmatchError(f"Cannot make the folder {folder}: {error.strerror}.") from error
    check_outputs(outputs, picture)
    scene = Scene.from_mesh(mug())
    gripper = load("franka_hand", None, config, say)
    return plan_and_report(scene, gripper, config, say, outputs=outputs, picture=picture)


def list_grippers(*, as_json: bool) -> int:
    """Show the built-in hands; reads their cards only."""
    from graspmatch.gripper.card import preshape_joints, read_card
    from graspmatch.gripper.zoo import card_path, known_grippers

    cards = [read_card(card_path(name)) for name in known_grippers()]
    counts = [len(preshape_joints(card, card.joint_names)) for card in cards]
    if as_json:
        records = [
            {
                "name": card.name,
                "title": card.title,
                "fingers": [finger.name for finger in card.fingers],
                "joint_names": list(card.joint_names),
                "preshapes": count,
                "opening": card.opening,
                "finger_force": card.finger_force,
            }
            for card, count in zip(cards, counts, strict=True)
        ]
        print(json.dumps({"grippers": records}))
        return 0
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("name", "title", "fingers", "joints", "preshapes", "opening mm", "force N"):
        table.add_column(name, justify="left" if name in ("name", "title") else "right")
    for card, count in zip(cards, counts, strict=True):
        numbers = (len(card.fingers), len(card.joints), count, round(1000 * card.opening), round(card.finger_force))
        table.add_row(card.name, card.title, *map(str, numbers))
    Speech().show(table)
    return 0


def check_outputs(outputs: Sequence[Path], picture: Path | None) -> None:
    """Refuse what cannot be written before anything is computed."""
    for path in outputs:
        writer_of(path)
        check_place(path)
    if picture is not None:
        if picture.suffix.lower() != ".png":
            raise GraspmatchError(f"Cannot write {picture}: a picture has the suffix .png.")
        check_place(picture)


def load(name: str, description: Path | None, config: PlannerConfig, say: Speech) -> Gripper:
    """The hand, once it is known that there is one of this name and a device to plan on."""
    from graspmatch.gripper.load import load_gripper
    from graspmatch.gripper.zoo import card_path
    from graspmatch.kernels.launch import resolve_device

    card_path(name)
    resolve_device(config.device)
    with say.progress(f"Loading {name} (the first time, its preshapes are computed)"):
        return load_gripper(name, description=description)


def plan_and_report(
    scene: Scene,
    gripper: Gripper,
    config: PlannerConfig,
    say: Speech,
    *,
    outputs: Sequence[Path],
    picture: Path | None,
    starts: GraspSet | None = None,
) -> int:
    """Plan, write the files where there are grasps, show what came out."""
    from graspmatch.planner.plan import plan

    begin = time.perf_counter()
    poses = None if starts is None else starts.T_world_gripper
    with say.progress("Planning (the first time, the kernels are compiled)"):
        grasps = plan(scene, gripper, config, starts_world_gripper=poses)
    planned = f"Planned in {time.perf_counter() - begin:.2f} s on {grasps.provenance.device}"
    if len(grasps):
        write_all(scene, gripper, grasps, say, outputs=outputs, picture=picture)
    for note in scene.notes:
        say.show(f"Note: {note}")
    if len(grasps):
        say.show(report.table_of_grasps(grasps, gripper))
        say.show(f"{planned}: {report.timing(grasps.provenance.seconds)}.")
        for path in [*outputs, *([picture] if picture else [])]:
            say.show(f"Wrote {path}")
    else:
        say.show(grasps.explain())
        say.show(f"{planned}. No file was written." if outputs or picture else f"{planned}.")
    if say.as_json:
        print(json.dumps(report.record_of_grasps(grasps, gripper), allow_nan=False))
    return 0 if len(grasps) else NOT_FOUND


def write_all(
    scene: Scene, gripper: Gripper, grasps: GraspSet, say: Speech, *, outputs: Sequence[Path], picture: Path | None
) -> None:
    """Write the grasps and their picture."""
    for path in outputs:
        write_grasps(grasps, path, gripper)
    if picture is None:
        return
    from graspmatch.apps.picture import picture_of_grasps
    from graspmatch.gripper.kinematics import link_poses

    def draw(temporary: Path) -> None:
        picture_of_grasps(scene, gripper, grasps, temporary, link_poses=link_poses, count=PICTURED)

    with say.progress("Drawing"):
        write_atomically(picture, draw)
