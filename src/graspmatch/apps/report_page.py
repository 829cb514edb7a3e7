"""`graspmatch report`: one HTML page about a file of grasps that needs nothing but itself."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from graspmatch.apps.grasp_file import hand_and_grasps
from graspmatch.apps.hand import Hand
from graspmatch.apps.options import Report
from graspmatch.apps.speech import Speech
from graspmatch.config import PlannerConfig
from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import check_place, read_text, write_atomically
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet

PICTURED = 4
SIZE = (1120, 560)
"""Of the picture of the best grasps [pixels]."""
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#22303c;max-width:70rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.5rem}h2{font-size:1.1rem;margin:2rem 0 .5rem}img{max-width:100%;border-radius:6px}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}th,td{padding:.25rem .8rem;text-align:right}
th{border-bottom:2px solid #3b6ea5;font-weight:600}td{border-bottom:1px solid #e4e8ec}
td{white-space:nowrap}section{overflow-x:auto}.left{text-align:left}.bar{background:#3b6ea5;height:.8rem;border-radius:2px;min-width:1px}.wide{width:20rem}
.held{color:#1a7f4b}.failed{color:#b3402a}footer,.quiet{color:#6b7884;font-size:.85rem}pre{white-space:pre-wrap}
"""


@dataclass(frozen=True)
class Verdicts:
    """What `graspmatch simulate --json` said about the same grasps."""

    protocol: str
    engine: str
    friction: float
    mass: float
    held: list[bool]
    reason: list[str]


def report(command: Report, table: float | Literal["auto"] | None, say: Speech) -> int:
    """Write the page; the result is the exit status."""
    if command.output.suffix.lower() not in (".html", ".htm"):
        raise GraspmatchError(f"Cannot write {command.output}: a report has the suffix .html.")
    check_place(command.output)
    hand, grasps = hand_and_grasps(command.grasps, command.gripper, command.description, PlannerConfig(), say)
    verdicts = None if command.verdicts is None else read_verdicts(command.verdicts, len(grasps))
    picture = None
    if command.object is not None:
        with say.progress(f"Drawing the best grasps of {command.object.name}"):
            scene = Scene.read(command.object, table=table, unit=command.unit)
            picture = picture_of(scene, hand, grasps)
    page = page_of_report(grasps, hand, picture, verdicts)
    write_atomically(command.output, lambda temporary: temporary.write_text(page, encoding="utf-8"))
    say.show(f"Wrote {command.output}")
    if say.as_json:
        print(json.dumps({"output": str(command.output), "grasps": len(grasps), "bytes": len(page.encode())}))
    return 0


def read_verdicts(path: Path, count: int) -> Verdicts:
    """The report of `simulate --json`; it may be about the first grasps only."""
    try:
        record = json.loads(read_text(path))
        held, reason = [bool(h) for h in record["held"]], [str(r) for r in record["reason"]]
        settings, mass = record["settings"], float(record["mass"])
        verdicts = Verdicts(
            str(record["protocol"]), str(record["engine"]), float(settings["friction"]), mass, held, reason
        )
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise GraspmatchError(f"{path} is not what `graspmatch simulate --json` prints ({error!r}).") from error
    if len(held) != len(reason) or len(held) > count:
        raise GraspmatchError(f"{path} has verdicts on {len(held)} grasps, the file of grasps has {count}.")
    return verdicts


def picture_of(scene: Scene, hand: Hand, grasps: GraspSet) -> bytes:
    """PNG of the best grasps."""
    from tempfile import TemporaryDirectory

    from graspmatch.apps.picture import picture_of_grasps

    with TemporaryDirectory() as folder:
        path = Path(folder) / "grasps.png"
        picture_of_grasps(scene, hand.gripper, grasps, path, link_poses=hand.link_poses, count=PICTURED, size=SIZE)
        small = BytesIO()
        Image.open(path).convert("RGB").save(small, format="WEBP", quality=88)
    return small.getvalue()


def page_of_report(grasps: GraspSet, hand: Hand, picture: bytes | None, verdicts: Verdicts | None) -> str:
    """The whole page; whatever comes from a file is escaped."""
    about = grasps.provenance
    source = about.source or "an unknown object"
    title = f"{len(grasps)} grasp{'s' * (len(grasps) != 1)} of {source} for {hand.gripper.name}"
    parts = [f"<h1>{escape(title)}</h1>"]
    if picture is not None:
        data = base64.b64encode(picture).decode("ascii")
        parts.append(f'<img alt="The hand at the best grasps" src="data:image/webp;base64,{data}">')
    if verdicts is not None:
        parts.append(_verdict_line(verdicts))
    parts += [_section("Grasps", _grasp_table(grasps, hand, verdicts)) if len(grasps) else ""]
    parts.append(_section("What became of the candidates", _tally(grasps)))
    if about.seconds:
        parts.append(_section("Time", _bars({k: 1000 * v for k, v in about.seconds.items()}, "ms", 1)))
    parts.append(_section("Where it comes from", _provenance(grasps)))
    body = "\n".join(part for part in parts if part)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>\n{body}\n'
        f"<footer>graspmatch {escape(about.version)}</footer></body></html>\n"
    )


def _verdict_line(verdicts: Verdicts) -> str:
    held = sum(verdicts.held)
    return (
        f"<p><b>{held} of {len(verdicts.held)}</b> held in simulation: protocol {escape(verdicts.protocol)}, friction "
        f"{verdicts.friction:g}, mass {1000 * verdicts.mass:.0f} g, {escape(verdicts.engine)}.</p>"
    )


def _grasp_table(grasps: GraspSet, hand: Hand, verdicts: Verdicts | None) -> str:
    """One row a grasp, lengths in millimetres."""
    names = ["#", "preshape", "score", "quality", "loss mm", "clearance mm", "fingers", "position mm", "approach"]
    names += [f"closes to: {name}" for name in grasps.joint_names] + (["simulation"] if verdicts else [])
    rows = []
    approach = grasps.T_world_gripper[:, :3, :3] @ hand.gripper.approach
    for i in range(len(grasps)):
        cells = [
            str(i + 1),
            escape(grasps.preshape_names[grasps.preshape[i]]),
            _number(grasps.score[i], 3),
            _number(grasps.quality[i], 2),
            _number(1000 * math.sqrt(max(grasps.loss[i], 0.0)) if np.isfinite(grasps.loss[i]) else np.nan, 1),
            _number(1000 * grasps.clearance[i], 1),
            f"{grasps.fingers_touching[i]}/{len(hand.gripper.fingers)}",
            " ".join(_number(x, 0) for x in 1000 * grasps.T_world_gripper[i, :3, 3]),
            " ".join(_number(x, 2) for x in approach[i]),
            *(_number(value, 4) for value in grasps.grasp_joints[i]),
        ]
        rows.append(cells + ([_verdict(verdicts, i)] if verdicts else []))
    return _table(names, rows)


def _verdict(verdicts: Verdicts, i: int) -> str:
    if i >= len(verdicts.held):
        return "not tried"
    if verdicts.held[i]:
        return '<span class="held">held</span>'
    return f'<span class="failed">{escape(verdicts.reason[i])}</span>'


def _tally(grasps: GraspSet) -> str:
    total = grasps.tally.get("candidates", 0)
    if not total:
        return '<p class="quiet">The file does not say.</p>'
    counts = {reason: float(n) for reason, n in grasps.tally.items() if reason != "candidates" and n}
    advice = f"<p>{escape(grasps.advice)}</p>" if grasps.advice else ""
    return f"<p>{total} candidates; {len(grasps)} came out.</p>{_bars(counts, '', 0)}{advice}"


def _bars(values: dict[str, float], unit: str, decimals: int) -> str:
    """A row with a bar for each value."""
    most = max(values.values(), default=0.0) or 1.0
    rows = "".join(
        f'<tr><td class="left">{escape(name)}</td><td>{value:.{decimals}f} {unit}</td>'
        f'<td class="left wide"><div class="bar" style="width:{100 * value / most:.1f}%"></div></td></tr>'
        for name, value in values.items()
    )
    return f"<table>{rows}</table>"


def _provenance(grasps: GraspSet) -> str:
    about = grasps.provenance
    rows = {"device": about.device, "seed": str(about.seed), "hand": f"{about.gripper} {about.gripper_hash[:12]}"}
    lines = "".join(f'<tr><td class="left">{k}</td><td class="left">{escape(v)}</td></tr>' for k, v in rows.items())
    settings = f"<details><summary>configuration</summary><pre>{escape(_indented(about.config))}</pre></details>"
    return f"<table>{lines}</table>{settings if about.config else ''}"


def _indented(text: str) -> str:
    """JSON with line breaks; anything else as it is."""
    try:
        value: Any = json.loads(text)
    except ValueError:
        return text
    return json.dumps(value, indent=2)


def _table(names: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in names)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _section(title: str, html: str) -> str:
    return f"<section><h2>{title}</h2>{html}</section>"


def _number(value: float, decimals: int) -> str:
    return f"{value + 0.0:.{decimals}f}" if np.isfinite(value) else "?"
