"""What the subcommands do."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from rich import box
from rich.table import Table

from graspmatch.apps import report
from graspmatch.apps.capture import read_scene
from graspmatch.apps.options import Capture
from graspmatch.apps.speech import Speech
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
class Outputs:
    """The files to write."""

    grasps: tuple[Path, ...] = ()
    picture: Path | None = None

    @property
    def all(self) -> tuple[Path, ...]:
        """Every one of them."""
        return (*self.grasps, self.picture) if self.picture else self.grasps

    def check(self) -> None:
        """Refuse what cannot be written, before anything is computed."""
        for path in self.grasps:
            writer_of(path)
        if self.picture and self.picture.suffix.lower() != ".png":
            raise GraspmatchError(f"Cannot write {self.picture}: a picture has the suffix .png.")
        for path in self.all:
            check_place(path)


@dataclass(frozen=True)
class Hand:
    """A gripper, and where its links are."""

    gripper: Gripper
    link_poses: Callable[[Float[np.ndarray, "d"]], Float[np.ndarray, "l 4 4"]]
    """Driven joint values to the poses of `gripper.links` in the gripper frame."""


def plan_file(
    path: Path | None,
    gripper_name: str,
    config: PlannerConfig,
    say: Speech,
    *,
    description: Path | None,
    outputs: Outputs,
    table: float | Literal["auto"] | None,
    unit: Literal["auto", "m", "mm", "cm"],
    obstacles: Path | None,
    capture: Capture,
    starts: Path | None,
    view: bool,
) -> int:
    """Plan grasps for the object of a file, show and write them; the result is the exit status."""
    outputs.check()
    if view:
        from graspmatch.apps.viewer.command import check_library

        check_library()
    with say.progress("Reading the scene"):
        scene = read_scene(path, capture, table=table, unit=unit, obstacles=obstacles)
    hand = load_hand(gripper_name, description, config, say)
    start_grasps = None if starts is None else read_grasps(starts, hand.gripper)
    return plan_and_report(scene, hand, config, say, outputs, starts=start_grasps, view=view)


def demo(folder: Path, config: PlannerConfig, say: Speech) -> int:
    """Plan grasps for a mug made by code and write every kind of file to a folder."""
    from graspmatch.scene.shapes import mug

    outputs = Outputs((folder / "grasps.yaml", folder / "grasps.npz"), folder / "grasps.png")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GraspmatchError(f"Cannot make the folder {folder}: {error.strerror}.") from error
    outputs.check()
    scene = Scene.from_mesh(mug())
    return plan_and_report(scene, load_hand("franka_hand", None, config, say), config, say, outputs)


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


def load_hand(name: str, description: Path | None, config: PlannerConfig, say: Speech) -> Hand:
    """The hand, once it is known that there is one of this name and a device to plan on."""
    from graspmatch.gripper import kinematics
    from graspmatch.gripper.load import load_gripper
    from graspmatch.gripper.zoo import card_path
    from graspmatch.kernels.launch import resolve_device

    card = card_path(name)
    resolve_device(config.device)
    with say.progress(f"Loading {name} (the first time, its preshapes are computed)"):
        gripper = load_gripper(name, description=description)
        model = kinematics.load_hand(card, description)
    return Hand(gripper, lambda joints: kinematics.pose_links(model, joints))


def plan_and_report(
    scene: Scene,
    hand: Hand,
    config: PlannerConfig,
    say: Speech,
    outputs: Outputs,
    *,
    starts: GraspSet | None = None,
    view: bool = False,
) -> int:
    """Plan, write the files where there are grasps, show what came out; the result is the exit status."""
    from graspmatch.planner.plan import plan
    from graspmatch.planner.recording import Recording

    recording = Recording() if view else None
    begin = time.perf_counter()
    poses = None if starts is None else starts.T_world_gripper
    with say.progress("Planning (the first time, the kernels are compiled)"):
        grasps = plan(scene, hand.gripper, config, starts_world_gripper=poses, recording=recording)
    planned = f"Planned in {time.perf_counter() - begin:.2f} s on {grasps.provenance.device}"
    for note in scene.notes:
        say.show(f"Note: {note}")
    if len(grasps):
        say.show(report.table_of_grasps(grasps, hand.gripper))
        say.show(f"{planned}: {report.timing(grasps.provenance.seconds)}.")
        write_all(scene, hand, grasps, say, outputs)
    else:
        say.show(grasps.explain())
        say.show(f"{planned}; no file was written." if outputs.all else f"{planned}.")
    record = report.record_of_grasps(grasps, hand.gripper) if say.as_json else {}
    if recording is not None:
        from graspmatch.apps.viewer.command import serve
        from graspmatch.apps.viewer.shown import shown_of

        serve(shown_of(hand, grasps, scene, recording, config.device), config, say, record)
    elif say.as_json:
        print(json.dumps(record, allow_nan=False))
    return 0 if len(grasps) else NOT_FOUND


def write_all(scene: Scene, hand: Hand, grasps: GraspSet, say: Speech, outputs: Outputs) -> None:
    """Write the grasps and their picture."""
    for path in outputs.grasps:
        write_grasps(grasps, path, hand.gripper)
        say.show(f"Wrote {path}")
    if outputs.picture is None:
        return
    from graspmatch.apps.picture import picture_of_grasps

    def draw(temporary: Path) -> None:
        picture_of_grasps(scene, hand.gripper, grasps, temporary, link_poses=hand.link_poses, count=PICTURED)

    with say.progress("Drawing"):
        write_atomically(outputs.picture, draw)
    say.show(f"Wrote {outputs.picture}")
