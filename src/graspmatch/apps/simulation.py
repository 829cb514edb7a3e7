"""`graspmatch simulate`: the grasps of a file, tried one after the other."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from rich import box
from rich.table import Table

from graspmatch.apps.bench.objects import object_name
from graspmatch.apps.grasp_file import named_hand
from graspmatch.apps.options import Simulate
from graspmatch.apps.report import finite_or_null
from graspmatch.apps.speech import Speech
from graspmatch.config import LiftConfig
from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import check_place
from graspmatch.formats.registry import NO_HAND, read_grasps, suffix_of
from graspmatch.geometry.mesh import transformed
from graspmatch.geometry.se3 import translation
from graspmatch.gripper.kinematics import HandModel, load_hand
from graspmatch.gripper.load import load_gripper
from graspmatch.gripper.zoo import card_path
from graspmatch.ranges import check_ranges
from graspmatch.scene.scene import Scene
from graspmatch.simulate.convex import convex_parts
from graspmatch.simulate.judge import PROTOCOLS, ProtocolConfig, judge, try_grasp, world_of
from graspmatch.simulate.motion import Recording
from graspmatch.simulate.rigid_body import RigidBody, rigid_body
from graspmatch.simulate.settle import Settled, settle
from graspmatch.types import GraspSet, Plane, SimulationReport

FARTHEST, STEEPEST = 0.01, 5.0
"""An object that settles by more [m, degrees] is not where its grasps were planned."""
MISSING = 0.005
"""Convex parts that leave out a twentieth of a mesh by this much [m] are said to."""
NONE_HELD = 3
"""Exit status when no grasp holds."""


def simulate_file(command: Simulate, table: float | Literal["auto"] | None, say: Speech) -> int:
    """Try the grasps of a file on an object; show the verdicts, write the pictures; the result is the exit status."""
    _check(command)
    hand, grasps = _hand_and_grasps(command)
    config = _protocol(command)
    with say.progress(f"Reading {command.object.name} (the first time, its convex parts are computed)"):
        target, height = _target(command, table, config.mass, say)
    grasps = _moved(grasps, translation(np.array([0.0, 0.0, -height])))
    if command.first is not None:
        grasps = grasps.best(command.first)
    rest = _at_rest(target, config, say)
    grasps = _moved(grasps, rest.T_world_object)
    with say.progress("Simulating", total=len(grasps)) as done:
        report = judge(grasps, rest.target, hand, rest.T_world_object, config, watch=_counted(done))
    if len(report):
        say.show(table_of_verdicts(report))
    say.show(summary_of(report))
    if (command.video or command.strip) and len(grasps):
        _draw(command, grasps, rest, hand, config, say)
    if say.as_json:
        print(json.dumps(record_of_report(report), allow_nan=False))
    return 0 if report.held.any() else NONE_HELD


def _counted(done: Callable[[], None]) -> Callable[[Iterable[int]], Iterator[int]]:
    """Says after each grasp that it is done."""

    def watch(numbers: Iterable[int]) -> Iterator[int]:
        for number in numbers:
            yield number
            done()

    return watch


def table_of_verdicts(report: SimulationReport) -> Table:
    """One row per grasp."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("grasp", "verdict", "slip mm", "turn deg", "fingers"):
        table.add_column(name, justify="left" if name == "verdict" else "right")
    for i in range(len(report)):
        moved = f"{1000 * report.slip[i]:.1f}", f"{np.degrees(report.turn[i]):.1f}"
        table.add_row(str(i), report.reason[i] or "held", *moved, str(report.fingers_touching[i]))
    return table


def summary_of(report: SimulationReport) -> str:
    """How many held, and under which protocol."""
    if not len(report):
        return "The file has no grasps."
    settings = json.loads(report.settings)
    return (
        f"{int(report.held.sum())} of {len(report)} grasps held: protocol {report.protocol} version 1, friction "
        f"{settings['friction']:g}, mass {1000 * report.mass:.0f} g, {report.engine}, "
        f"{np.median(report.seconds):.2f} s each; convex parts reach "
        f"{1000 * report.bulge:.1f} mm beyond the mesh."
    )


def record_of_report(report: SimulationReport) -> dict[str, Any]:
    """The report as JSON."""
    content = asdict(report)
    arrays = {key: value.tolist() for key, value in content.items() if isinstance(value, np.ndarray)}
    return finite_or_null({**content, **arrays, "reason": list(report.reason), "settings": json.loads(report.settings)})


def _check(command: Simulate) -> None:
    """Refuse what makes no sense before anything is computed for it."""
    check_ranges(
        [  # name, value, least, most
            ("--friction", command.friction, 0, 10),
            ("--mass", command.mass, 1e-3, 100),
            ("--first", command.first, 1, 1e9),
        ]
    )
    for path, known in ((command.video, (".mp4", ".gif")), (command.strip, (".png",))):
        if path is not None:
            if path.suffix.lower() not in known:
                raise GraspmatchError(f"Cannot write {path}: it can be {' or '.join(known)}.")
            check_place(path)


def _hand_and_grasps(command: Simulate) -> tuple[HandModel, GraspSet]:
    """The hand that is asked for, or the one that the file names, and the grasps in the order of its joints."""
    if command.gripper is not None:
        card = card_path(command.gripper)
        needs_hand = suffix_of(command.grasps) in NO_HAND
        gripper = load_gripper(command.gripper, description=command.description) if needs_hand else None
        return load_hand(card, command.description), read_grasps(command.grasps, gripper)
    grasps = read_grasps(command.grasps)
    return load_hand(card_path(named_hand(grasps, command.grasps)), command.description), grasps


def _protocol(command: Simulate) -> ProtocolConfig:
    given = {"friction": command.friction, "mass": command.mass}
    return replace(PROTOCOLS[command.protocol](), **{name: value for name, value in given.items() if value is not None})


def _target(
    command: Simulate, table: float | Literal["auto"] | None, mass: float | None, say: Speech
) -> tuple[RigidBody, float]:
    """The object [m] above a table at z = 0, and the height of that table in the frame of the grasps."""
    scene = Scene.read(command.object, table=table, unit=command.unit)
    if scene.mesh is None:
        raise GraspmatchError(f"{command.object} is a cloud; the simulator needs a mesh.")
    if scene.table is None and command.protocol == "lift":
        raise GraspmatchError("Protocol lift needs a table: --table auto, or its height as --table z=0.02.")
    height = scene.table.offset if scene.table is not None else 0.0
    ready = command.object.parent / "convex"
    scaled = command.unit not in ("auto", "m")
    convex = convex_parts(scene.mesh, folder=ready if ready.is_dir() and not scaled else None)
    if convex.fidelity.gap > MISSING:
        say.show(
            f"Note: a twentieth of the mesh is {1000 * convex.fidelity.gap:.0f} mm or more from the convex parts that "
            "stand for it: what is missing there cannot be touched."
        )
    down = translation(np.array([0.0, 0.0, -height]))
    parts = tuple(transformed(part, down) for part in convex.parts)
    moved = transformed(scene.mesh, down)
    return rigid_body(object_name(command.object), moved, parts, bulge=convex.bulge, mass=mass), height


def _moved(grasps: GraspSet, T_new_old: Float[np.ndarray, "4 4"]) -> GraspSet:
    return replace(
        grasps,
        T_world_gripper=T_new_old @ grasps.T_world_gripper,
        T_world_pregrasp=T_new_old @ grasps.T_world_pregrasp,
    )


def _at_rest(target: RigidBody, config: ProtocolConfig, say: Speech) -> Settled:
    """Where the object comes to rest; without a table, where it is."""
    if not isinstance(config, LiftConfig):
        return Settled(target, np.eye(4), 0.0, topples=False)
    rest = settle(target, config.friction)
    if rest.topples:
        raise GraspmatchError(f"{target.name} does not stand as it is given: it falls over or rolls away.")
    moved = float(np.linalg.norm(rest.T_world_object[:3, 3]))
    tilt = float(np.degrees(np.arccos(np.clip(rest.T_world_object[2, 2], -1, 1))))
    what = f"settles by {1000 * moved:.0f} mm and {tilt:.0f} degrees on the table"
    if moved > FARTHEST or tilt > STEEPEST:
        raise GraspmatchError(f"{target.name} {what}: the grasps were planned for another pose. Check --table.")
    if moved > FARTHEST / 5 or tilt > STEEPEST / 5:
        say.show(f"Note: {target.name} {what}; its grasps are moved along.")
    if rest.levelled:
        say.show(f"Note: its foot was levelled by {1000 * rest.levelled:.0f} mm so that it stands.")
    return rest


def _draw(
    command: Simulate, grasps: GraspSet, rest: Settled, hand: HandModel, config: ProtocolConfig, say: Speech
) -> None:
    """Try the first grasp again with a recording, and draw it."""
    from graspmatch.apps.video import film_strip, key_moments, write_video

    shots = Recording()
    try_grasp(world_of(rest.target, hand, config), grasps, 0, rest.T_world_object, config, shots)
    captions = [f"{phase}, {time:.1f} s" for phase, time in zip(shots.phases, shots.times, strict=True)]
    poses = (np.stack(shots.T_world_link), np.stack(shots.T_world_object))
    table = Plane(np.array([0.0, 0.0, 1.0]), 0.0) if isinstance(config, LiftConfig) else None
    if command.video is not None:
        with say.progress(f"Drawing {command.video.name}", total=len(captions)) as done:
            rate, step = shots.frames_per_second, lambda *_: done()
            mesh = rest.target.mesh
            write_video(command.video, hand.links, mesh, *poses, captions, fps=rate, table=table, progress=step)
        say.show(f"Wrote {command.video}")
    if command.strip is not None:
        moments = key_moments(shots.phases)
        with say.progress(f"Drawing {command.strip.name}"):
            film_strip(command.strip, hand.links, rest.target.mesh, *poses, captions, moments=moments, table=table)
        say.show(f"Wrote {command.strip}")
