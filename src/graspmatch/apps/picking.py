"""`graspmatch plan --all`: grasps for every object of a capture, and the order of picking."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Literal

from rich import box
from rich.table import Table as TextTable

from graspmatch.apps import report
from graspmatch.apps.capture import read_scenes
from graspmatch.apps.hand import Hand, hand_of
from graspmatch.apps.options import Plan, Seeds
from graspmatch.apps.outputs import NOT_FOUND, Outputs, write_all
from graspmatch.apps.robot import arm_of
from graspmatch.apps.speech import Speech
from graspmatch.config import PlannerConfig
from graspmatch.errors import GraspmatchError
from graspmatch.planner.arm import Arm
from graspmatch.planner.order import Pick, plan_all
from graspmatch.planner.waypoints import waypoints


def plan_every(
    command: Plan, table: float | Literal["auto"] | None, config: PlannerConfig, outputs: Outputs, say: Speech
) -> int:
    """Plan for all objects, write the files of each with its number in their names; the result is the exit status."""
    if command.seeds != Seeds():
        raise GraspmatchError("--seeds are for one object: leave out --all, or name it (--object, --at, --mask).")
    with say.progress("Reading the scene"):
        scenes = read_scenes(
            command.input, command.capture, table=table, unit=command.unit, obstacles=command.obstacles
        )
    hand = hand_of(command, config, say)
    arm = arm_of(command.robot, hand.gripper)
    begin = time.perf_counter()
    with say.progress(f"Planning for {len(scenes)} objects (the first time, the kernels are compiled)"):
        picks = plan_all(scenes, hand.gripper, config, reach=arm)
    for note in dict.fromkeys(note for pick in picks for note in pick.scene.notes):
        say.show(f"Note: {note}")
    say.show(table_of_picks(picks))
    say.show(f"Planned in {time.perf_counter() - begin:.2f} s.")
    for pick in picks:
        if len(pick.grasps):
            write_all(pick.scene, hand, pick.grasps, say, numbered(outputs, pick.number))
        else:
            say.show(f"Object {pick.number}: {pick.grasps.explain()}")
    if say.as_json:
        print(json.dumps({"picks": [_record(pick, hand, config, arm) for pick in picks]}, allow_nan=False))
    return 0 if any(len(pick.grasps) for pick in picks) else NOT_FOUND


def table_of_picks(picks: tuple[Pick, ...]) -> TextTable:
    """One object a row, in the order of picking."""
    table = TextTable(title="Order of picking", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("", "object", "grasps", "score", "why here"):
        table.add_column(name, justify="left" if name == "why here" else "right")
    for place, pick in enumerate(picks):
        able = bool(len(pick.grasps))
        score = f"{pick.grasps.score[0]:.2f}" if able else "-"
        table.add_row(str(place + 1) if able else "-", str(pick.number), str(len(pick.grasps)), score, pick.reason)
    return table


def numbered(outputs: Outputs, number: int) -> Outputs:
    """The files of one object: grasps.yaml becomes grasps-2.yaml."""
    return replace(
        outputs,
        grasps=tuple(_numbered(path, number) for path in outputs.grasps),
        picture=_numbered(outputs.picture, number) if outputs.picture else None,
    )


def _numbered(path: Path, number: int) -> Path:
    stem, dot, suffixes = path.name.partition(".")
    return path.with_name(f"{stem}-{number}{dot}{suffixes}")


def _record(pick: Pick, hand: Hand, config: PlannerConfig, arm: Arm | None) -> dict[str, object]:
    ways = waypoints(pick.grasps, pick.scene, hand.gripper, config, arm=arm)
    record = {
        "object": pick.number,
        "reason": pick.reason,
        "room": pick.room,
        "centre": pick.scene.centre_of_mass.tolist(),
    }
    return report.finite_or_null(record) | report.record_of_grasps(pick.grasps, hand.gripper, ways, arm)
