"""What the subcommands do."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich import box
from rich.table import Table

from graspmatch.apps import report
from graspmatch.apps.capture import read_scene
from graspmatch.apps.hand import Hand, hand_of, load_hand
from graspmatch.apps.options import Plan
from graspmatch.apps.outputs import NOT_FOUND, Outputs, write_all
from graspmatch.apps.robot import arm_of
from graspmatch.apps.seeds import Start, start_of
from graspmatch.apps.speech import Speech
from graspmatch.config import PlannerConfig, fast
from graspmatch.errors import GraspmatchError
from graspmatch.scene.scene import Scene

if TYPE_CHECKING:
    from graspmatch.planner.arm import Arm


def plan_command(command: Plan, table: float | Literal["auto"] | None, say: Speech) -> int:
    """Plan grasps for the object of a file, or all, show and write them; the result is the exit status."""
    outputs = Outputs(command.output, command.picture)
    outputs.check()
    config = fast(command.config) if command.fast else command.config
    if command.all:
        if command.view:
            raise GraspmatchError("--view shows the grasps of one object; choose it with --object N in place of --all.")
        from graspmatch.apps.picking import plan_every

        return plan_every(command, table, config, outputs, say)
    if command.view:
        from graspmatch.apps.viewer.command import check_library

        check_library()
    with say.progress("Reading the scene"):
        scene = read_scene(command.input, command.capture, table=table, unit=command.unit, obstacles=command.obstacles)
    hand = hand_of(command, config, say)
    start, arm = start_of(command.seeds, hand.gripper, config), arm_of(command.robot, hand.gripper)
    return plan_and_report(scene, hand, start, say, outputs, arm=arm, view=command.view)


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
    return plan_and_report(scene, load_hand("franka_hand", None, config, say), Start(config), say, outputs)


def list_grippers(*, as_json: bool) -> int:
    """Show the built-in hands; reads their cards only."""
    from graspmatch.gripper.card import postures, read_card
    from graspmatch.gripper.zoo import card_path, known_grippers

    cards = [read_card(card_path(name)) for name in known_grippers()]
    counts = [len(postures(card, card.joint_names)) for card in cards]
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


def plan_and_report(
    scene: Scene,
    hand: Hand,
    start: Start,
    say: Speech,
    outputs: Outputs,
    *,
    arm: Arm | None = None,
    view: bool = False,
) -> int:
    """Plan, write the files where there are grasps, show what came out; the result is the exit status."""
    from graspmatch.planner.plan import plan
    from graspmatch.planner.recording import Recording
    from graspmatch.planner.waypoints import waypoints

    recording = Recording() if view else None
    begin = time.perf_counter()
    with say.progress("Planning (the first time, the kernels are compiled)"):
        grasps = plan(
            scene,
            hand.gripper,
            start.config,
            starts_world_gripper=start.T_world_gripper,
            reach=arm,
            recording=recording,
        )
    planned = f"Planned in {time.perf_counter() - begin:.2f} s on {grasps.provenance.device}"
    for note in (*scene.notes, *start.notes):
        say.show(f"Note: {note}")
    if len(grasps):
        say.show(report.table_of_grasps(grasps, hand.gripper))
        say.show(f"{planned}: {report.timing(grasps.provenance.seconds)}.")
        write_all(scene, hand, grasps, say, outputs)
    else:
        say.show(grasps.explain())
        say.show(f"{planned}; no file was written." if outputs.all else f"{planned}.")
    record = {}
    if say.as_json:
        ways = waypoints(grasps, scene, hand.gripper, start.config, arm=arm)
        record = report.record_of_grasps(grasps, hand.gripper, ways, arm)
    if recording is not None:
        from graspmatch.apps.viewer.command import serve
        from graspmatch.apps.viewer.shown import shown_of

        serve(shown_of(hand, grasps, scene, recording, start.config.device), start.config, say, record)
    elif say.as_json:
        print(json.dumps(record, allow_nan=False))
    return 0 if len(grasps) else NOT_FOUND
