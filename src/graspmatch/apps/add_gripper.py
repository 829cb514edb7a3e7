"""`graspmatch grippers add`: from a description to a card, a picture of the hand, and what was decided and why."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
from rich import box
from rich.table import Table

from graspmatch.apps.options import AddGripper
from graspmatch.apps.speech import Speech
from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import check_place, write_atomically
from graspmatch.gripper.kinematics import load_hand, pose_links
from graspmatch.gripper.load import load_gripper
from graspmatch.gripper.propose.card_text import card_text
from graspmatch.gripper.propose.check import check_hand
from graspmatch.gripper.propose.proposal import Proposal, propose


def add_gripper(command: AddGripper, say: Speech) -> int:
    """Write card and picture of a hand, and say what is in them; the result is the exit status."""
    with say.progress("Looking at the hand"):
        proposal = propose(command.file, root=command.root, name=command.name)
    card, picture = _places(command.output, proposal.name)
    description = os.path.relpath(proposal.mechanism.description.path, card.parent.absolute())
    text = card_text(proposal, Path(description).as_posix())
    write_atomically(card, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    hand = load_hand(card)
    for table in (_frames(proposal), _joints(proposal), _fingers(proposal)):
        say.show(table)
    findings = [*proposal.notes, *check_hand(hand, proposal.touching)]
    with say.progress("Computing its preshapes, drawing them"):
        from graspmatch.apps.hand_sheet import write_hand_sheet

        gripper = load_gripper(card)
        write_hand_sheet(gripper, picture, link_poses=lambda joints: pose_links(hand, joints))
    say.show(f"Preshapes: {', '.join(preshape.name for preshape in gripper.preshapes)}")
    for finding in findings:
        say.show(f"Look at this: {finding}")
    say.show(f"Wrote {card} and {picture}. Look at both, change what is wrong, then:")
    say.show(f"    graspmatch plan mug.stl --gripper {card}")
    if say.as_json:
        print(json.dumps(_record(proposal, card, picture, findings), allow_nan=False))
    return 0


def _places(folder: Path, name: str) -> tuple[Path, Path]:
    """Card and picture, in a folder that is made if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GraspmatchError(f"Cannot make the folder {folder}: {error.strerror}.") from error
    card, picture = folder / f"{name}.toml", folder / f"{name}.png"
    for path in (card, picture):
        check_place(path)
    if card.exists():
        raise GraspmatchError(f"{card} exists: remove it, or give another --name or folder (-o).")
    return card, picture


def _table(*columns: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in columns:
        table.add_column(name)
    return table


def _frames(proposal: Proposal) -> Table:
    frames = proposal.frames
    table = _table("in the frame of the base link", "value", "why")
    table.add_row("base link", proposal.mechanism.description.base_link, "the first link of the hand")
    for key in ("approach", "closing", "tool_centre_point"):
        table.add_row(key.replace("_", " "), _vector(getattr(frames, key)), frames.reasons[key])
    table.add_row("opening", f"{1000 * frames.opening:.0f} mm", frames.reasons["opening"])
    table.add_row("finger force", f"{proposal.finger_force:g} N", proposal.force_reason)
    return table


def _joints(proposal: Proposal) -> Table:
    table, hand, roles = _table("joint", "does", "open", "closed", "why"), proposal.mechanism, proposal.roles
    model = hand.description.model
    for j, name in enumerate(hand.joint_names):
        does = "closes" if roles.closes[j] else "wrist, held" if roles.is_wrist[j] else "spreads"
        closed = f"{proposal.closed[j]:.3f}" if roles.closes[j] else ""
        why = proposal.drives.reasons.get(model.joint(name).id, "")
        if roles.closes[j]:
            why += f"; the space in the hand shrinks by {roles.shrink[j]:.1f} m for each metre its tips move"
        table.add_row(name, does, f"{proposal.opened[j]:.3f}", closed, why)
    for follower, (leader, multiplier, _) in proposal.drives.couplings.items():
        does = f"follows {model.joint(leader).name} times {multiplier:.2f}"
        table.add_row(model.joint(follower).name, does, "", "", proposal.drives.reasons[follower])
    return table


def _fingers(proposal: Proposal) -> Table:
    table, hand = _table("part", "links", "closed by"), proposal.mechanism
    links = [link.name for link in hand.hand.links]
    table.add_row("palm", ", ".join(links[i] for i in proposal.palm_links), "")
    for f, name in enumerate(proposal.finger_names):
        closers = [hand.joint_names[j] for j in np.flatnonzero(proposal.roles.closers[f])]
        table.add_row(name, ", ".join(links[i] for i in proposal.finger_links(f)), ", ".join(closers))
    return table


def _record(proposal: Proposal, card: Path, picture: Path, findings: list[str]) -> dict[str, object]:
    frames = proposal.frames
    return {
        "name": proposal.name,
        "card": str(card),
        "picture": str(picture),
        "base_link": proposal.mechanism.description.base_link,
        "approach": frames.approach.tolist(),
        "closing": frames.closing.tolist(),
        "tool_centre_point": frames.tool_centre_point.tolist(),
        "opening": frames.opening,
        "joint_names": list(proposal.mechanism.joint_names),
        "findings": findings,
    }


def _vector(values: np.ndarray) -> str:
    return "[" + ", ".join(f"{round(float(v), 4) + 0.0:g}" for v in values) + "]"
