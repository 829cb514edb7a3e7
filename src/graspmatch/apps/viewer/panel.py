"""The controls beside the picture, and what they say."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
import viser

from graspmatch.apps.viewer.motion import CLOSED
from graspmatch.apps.viewer.palette import PARTICLE, SCALE, colour_of_reason, css
from graspmatch.apps.viewer.shown import Catalogue, Shown

ALL_REASONS = "all reasons"
MOST_GRASPS = 1000


@dataclass(frozen=True)
class Panel:
    """All controls."""

    summary: viser.GuiHtmlHandle
    grasp: viser.GuiSliderHandle[int]
    details: viser.GuiHtmlHandle
    moment: viser.GuiSliderHandle[float]
    play: viser.GuiButtonHandle
    also: viser.GuiSliderHandle[int]
    contacts: viser.GuiCheckboxHandle
    friction: viser.GuiSliderHandle[float]
    mesh: viser.GuiCheckboxHandle
    cloud: viser.GuiCheckboxHandle
    particles: viser.GuiCheckboxHandle
    iteration: viser.GuiSliderHandle[int]
    play_search: viser.GuiButtonHandle
    rejected: viser.GuiCheckboxHandle
    reason: viser.GuiDropdownHandle[str]
    legend: viser.GuiHtmlHandle
    hand: viser.GuiDropdownHandle[str]
    scene: viser.GuiDropdownHandle[str]
    seed: viser.GuiNumberHandle[int]
    count: viser.GuiNumberHandle[int]
    plan: viser.GuiButtonHandle
    status: viser.GuiHtmlHandle


def add_panel(server: viser.ViserServer, catalogue: Catalogue, hand: str, scene: str) -> Panel:
    """The controls in three tabs, the pickers set to a hand and a scene of the catalogue."""
    gui = server.gui
    summary = gui.add_html("")
    tabs = gui.add_tab_group()
    with tabs.add_tab("Grasps"):
        grasp = gui.add_slider("Grasp", 1, 2, 1, 1, hint="1 is the surest")
        details = gui.add_html("")
        moment = gui.add_slider("Moment", 0.0, 1.0, 0.01, CLOSED, hint="pregrasp, approach, closing, lift")
        play = gui.add_button("Play the grasp", icon=viser.Icon.PLAYER_PLAY)
        also = gui.add_slider("Hands", 0, 1, 1, 0, hint="so many of the best grasps at once")
        contacts = gui.add_checkbox("Contacts", True)
        friction = gui.add_slider(
            "Friction", 0.05, 1.5, 0.05, 0.6, hint="half the width of the cones over their length"
        )
        mesh = gui.add_checkbox("Mesh", True)
        cloud = gui.add_checkbox("Cloud", False)
    with tabs.add_tab("Search"):
        particles = gui.add_checkbox("Particles", False, hint="hands at every iteration of the matching")
        iteration = gui.add_slider("Iteration", 0, 1, 1, 0)
        play_search = gui.add_button("Play the search", icon=viser.Icon.PLAYER_PLAY)
        rejected = gui.add_checkbox("Rejected", False, hint="candidates that were dropped, coloured by the reason")
        reason = gui.add_dropdown("Reason", [ALL_REASONS])
        legend = gui.add_html("")
    with tabs.add_tab("Plan"):
        hands, scenes = tuple(catalogue.hands), tuple(catalogue.scenes)
        hand_picker = gui.add_dropdown("Gripper", hands, initial_value=hand)
        scene_picker = gui.add_dropdown("Object", scenes, initial_value=scene)
        seed = gui.add_number("Seed", catalogue.config.seed, min=0, step=1)
        count = gui.add_number("Count", catalogue.config.ranking.count, min=1, max=MOST_GRASPS, step=1)
        plan = gui.add_button("Plan", color="blue")
        status = gui.add_html("")
    return Panel(
        summary, grasp, details, moment, play, also, contacts, friction, mesh, cloud, particles, iteration,
        play_search, rejected, reason, legend, hand_picker, scene_picker, seed, count, plan, status,
    )  # fmt: skip


def summary_html(shown: Shown) -> str:
    """What there is, and what the colours of the hands say."""
    n, name = len(shown.grasps), escape(shown.hand.gripper.name)
    source = escape(shown.grasps.provenance.source or "an unknown object")
    head = _text(f"<b>{n} grasp{'s' * (n != 1)}</b> of {source} for {name}")
    if not n:
        return head + _text(escape(shown.grasps.explain()).replace("\n", "<br>"))
    low, high = float(np.min(shown.grasps.score)), float(np.max(shown.grasps.score))
    stops = ", ".join(css((int(r), int(g), int(b))) for r, g, b in SCALE)
    bar = f'<span style="flex:1;height:0.7em;border-radius:3px;background:linear-gradient(to right,{stops})"></span>'
    return head + (
        f'<div style="display:flex;align-items:center;gap:0.5em;margin:0.2em 1em 0.8em;font-size:0.85em">score '
        f"{low:.2f}{bar}{high:.2f}</div>"
    )


def details_html(shown: Shown, index: int, phase: str) -> str:
    """One grasp in figures."""
    grasps = shown.grasps
    names = [escape(name) for name in grasps.joint_names]
    joints = ", ".join(f"{n} {value:.3g}" for n, value in zip(names, grasps.grasp_joints[index], strict=True))
    preshape = grasps.preshape[index]
    named = escape(grasps.preshape_names[preshape]) if 0 <= preshape < len(grasps.preshape_names) else "unknown"
    rows = {
        "phase": phase,
        "score": _number(grasps.score[index], 1, 3),
        "quality": _number(grasps.quality[index], 1, 2),
        "clearance": f"{_number(grasps.clearance[index], 1000, 1)} mm",
        "fingers touching": f"{grasps.fingers_touching[index]} of {len(shown.hand.gripper.fingers)}",
        "preshape": named,
        "closes to": joints,
    }
    return _table(rows)


def legend_html(shown: Shown) -> str:
    """What the colours of forks say, and how many there are of each."""
    tally = shown.grasps.tally
    if not shown.recording.dropped:
        return _text("How these grasps were found was not recorded: press <b>Plan</b> to see particles and rejected "
                     "candidates.")  # fmt: skip
    rows = [(PARTICLE, tally.get("candidates", 0), "particles")]
    rows += [(colour_of_reason(i), tally.get(r, 0), r) for i, r in enumerate(shown.recording.dropped) if tally.get(r)]
    return "".join(
        f'<div style="display:flex;gap:0.5em;align-items:center;margin:0.1em 1em;font-size:0.85em">'
        f'<span style="flex:none;width:0.8em;height:0.8em;border-radius:2px;background:{css(colour)}"></span>'
        f'<span style="flex:none;width:2.2em;text-align:right">{count}</span><span>{escape(reason)}</span></div>'
        for colour, count, reason in rows
    )


def status_html(text: str, *, is_bad: bool = False) -> str:
    """What planning came to."""
    colour = "#c92a2a" if is_bad else "inherit"
    return f'<div style="margin:0.3em 1em;font-size:0.85em;color:{colour};white-space:pre-wrap">{escape(text)}</div>'


def _table(rows: dict[str, str]) -> str:
    cells = "".join(
        f'<tr><td style="padding-right:0.8em;opacity:0.65;vertical-align:top">{name}</td><td>{value}</td></tr>'
        for name, value in rows.items()
    )
    return f'<table style="margin:0.2em 1em;font-size:0.85em">{cells}</table>'


def _text(html: str) -> str:
    return f'<div style="margin:0.3em 1em;font-size:0.9em">{html}</div>'


def _number(value: float, scale: float, decimals: int) -> str:
    return "unknown" if not np.isfinite(value) else f"{scale * value:.{decimals}f}"
