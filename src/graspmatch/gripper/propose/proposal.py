"""From a URDF or MJCF file to a proposed card: what the hand is, where it grasps, how it closes, and why so."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspmatch.gripper.description import compile_description
from graspmatch.gripper.find_description import find_description
from graspmatch.gripper.propose.closing import (
    Roles,
    at_share,
    close_until_met,
    closed_end,
    find_roles,
    open_posture,
    together,
)
from graspmatch.gripper.propose.drives import Drives, find_drives
from graspmatch.gripper.propose.faults import refuse_wrong_units, stiff_and_loose
from graspmatch.gripper.propose.force import guess_force
from graspmatch.gripper.propose.frames import Frames, find_approach, find_frames, find_sides, side_gap
from graspmatch.gripper.propose.linkages import join_linkages
from graspmatch.gripper.propose.meeting import Meeting, Pads, find_pads, find_thumb, meet
from graspmatch.gripper.propose.posing import Mechanism, mechanism
from graspmatch.gripper.propose.postures import (
    Postures,
    hand_postures,
    jaw_postures,
    many_jointed_postures,
    open_to,
    power_gaps,
    widest_gap,
)
from graspmatch.gripper.propose.spreading import find_spreads
from graspmatch.gripper.propose.touching import Touching
from graspmatch.gripper.propose.tree import find_tree

Array = np.ndarray

WAY = np.linspace(0, 1, 21)
"""Shares of the way from open to closed at which the hand is looked at."""
VIEWS = (10, 7, 4, 0)
"""Of these, from which the palm is looked for in turn: fingers may hide it."""
VOXELS = 14
"""The opening is so many voxels wide."""
FINEST, COARSEST = 0.004, 0.025
"""Voxels of the inner surface [m]."""
POWER_GAP = 0.08
"""Between the tips of many-jointed fingers when the hand looks at the object [m]."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """All that a card says, and the reasons."""

    name: str
    mechanism: Mechanism
    drives: Drives
    roles: Roles
    opened: Float[Array, "d"]
    closed: Float[Array, "d"]
    frames: Frames
    finger_force: float
    force_reason: str
    postures: Postures
    sides: tuple[list[int], list[int]]
    voxel_size: float
    touching: Touching

    @property
    def notes(self) -> list[str]:
        """What in the description a person should look at, one sentence each."""
        return stiff_and_loose(self.mechanism.description.model, self.mechanism.tree, self.drives)

    @property
    def finger_names(self) -> list[str]:
        """By number."""
        return [f"finger_{f + 1}" for f in range(len(self.mechanism.branches))]

    def finger_links(self, finger: int) -> list[int]:
        """Links of a finger that move when it closes."""
        roles, own = self.roles, self.mechanism.links_of(self.mechanism.branches[finger].bodies)
        end = np.where(roles.closers[finger], self.closed, self.opened)
        before, after = self.mechanism.pose(self.opened), self.mechanism.pose(end)
        moved = [i for i in own if np.abs(before[i] - after[i]).max() > 1e-6]
        return moved or own

    @property
    def palm_links(self) -> list[int]:
        """All others."""
        fingers = {i for f in range(len(self.mechanism.branches)) for i in self.finger_links(f)}
        return [i for i in range(len(self.mechanism.hand.links)) if i not in fingers]


def propose(path: Path | str, *, root: str | None = None, name: str | None = None) -> Proposal:
    """A card for the hand of a description, from its geometry and kinematics alone.

    `root` is the link at which the hand begins, where the file has more than one hand, or an arm. Raises
    `GraspmatchError` where there is no hand, or its parts make none.
    """
    path = find_description(path)
    model, files = compile_description(path)
    tree = find_tree(model, path, root)
    refuse_wrong_units(model, path, tree)
    drives = find_drives(model, files, tree)
    hand = join_linkages(mechanism(model, files, tree, drives))
    return propose_for(hand, drives, name or _plain_name(path))


def propose_for(hand: Mechanism, drives: Drives, name: str) -> Proposal:
    """The card of a hand whose drives are known."""
    roles = find_roles(hand)
    opened, end = open_posture(hand, roles), closed_end(hand, roles)
    touching = Touching(hand, opened)
    if bool(np.any(roles.closers.sum(axis=1) > 1)) and len(hand.branches) > 1:
        return _many_jointed(hand, drives, roles, touching, opened, end, name)
    return _simple(hand, drives, roles, touching, opened, end, name)


def _simple(
    hand: Mechanism,
    drives: Drives,
    roles: Roles,
    touching: Touching,
    opened: Float[Array, "d"],
    end: Float[Array, "d"],
    name: str,
) -> Proposal:
    """Fingers that each close by one joint."""
    met, _ = close_until_met(hand, roles, touching, opened, end)
    all_sides = (list(range(len(hand.branches))), [])
    rough = find_sides(hand, opened, met, np.zeros(3)) if len(hand.branches) > 1 else all_sides
    views = [opened + WAY[i] * (met - opened) for i in VIEWS]
    approach, why = find_approach(hand, views, rough)
    spreads = find_spreads(hand, roles, opened, met, approach)
    opened = spreads[0]
    end = np.where(roles.closes != 0, end, opened)
    _, share = close_until_met(hand, roles, touching, opened, end)
    closed = at_share(roles, opened, end, together(hand, roles, share))
    way = [opened + s * (closed - opened) for s in WAY]
    sides = find_sides(hand, opened, closed, approach)
    frames = find_frames(hand, way, sides, approach, why)
    gaps = [side_gap(hand, posture, sides, frames.closing) for posture in way]
    one_drive = int((roles.closes != 0).sum()) == 1
    postures = jaw_postures() if one_drive else hand_postures(hand, roles, spreads, closed, approach, gaps)
    return _finished(name, hand, drives, roles, opened, closed, frames, postures, sides, touching)


def _many_jointed(
    hand: Mechanism,
    drives: Drives,
    roles: Roles,
    touching: Touching,
    opened: Float[Array, "d"],
    end: Float[Array, "d"],
    name: str,
) -> Proposal:
    """Fingers of several joints, which oppose each other in postures that have to be found."""
    pads = find_pads(hand, roles, opened, end)
    thumb, pairs = find_thumb(hand, roles, pads, opened)
    meetings = _meetings(hand, roles, pads, opened, thumb, pairs)
    widest = list(meetings.values())[-1]
    sides = ([thumb], list(widest.fingers[1:]))
    looking = open_to(hand, roles, pads, opened, widest, POWER_GAP)
    way = [looking + s * (widest.joints - looking) for s in WAY]
    approach, why = find_approach(hand, [way[0], way[10]], sides)
    frames = find_frames(hand, way, sides, approach, why)
    wrapped = {
        label: close_until_met(hand, roles, touching, m.joints, _curled(roles, m, end), list(m.fingers))[0]
        for label, m in meetings.items()
        if label == "power"
    }
    opening = max(power_gaps(widest_gap(hand, roles, pads, opened, widest)), default=frames.opening)
    frames = replace(frames, opening=opening)
    postures = many_jointed_postures(hand, roles, pads, opened, meetings, wrapped, frames.tool_centre_point)
    still = np.where(roles.closes != 0, opened, widest.joints)
    closed = np.where(roles.closes != 0, next(iter(wrapped.values()), end), still)
    return _finished(name, hand, drives, roles, still, closed, frames, postures, sides, touching)


def _meetings(
    hand: Mechanism, roles: Roles, pads: Pads, opened: Float[Array, "d"], thumb: int, pairs: list[Meeting]
) -> dict[str, Meeting]:
    """Pinch, tripod and all fingers, as far as the tips can meet."""
    partners = [m.fingers[1] for m in pairs if m.is_met] or [pairs[0].fingers[1]]
    found = {"pinch": pairs[0]}
    if len(partners) >= 2:
        found["tripod"] = meet(hand, roles, pads, opened, (thumb, *partners[:2]))
    everyone = tuple(m.fingers[1] for m in pairs)
    found["power"] = meet(hand, roles, pads, opened, (thumb, *everyone), spread=False)
    return found


def _curled(roles: Roles, meeting: Meeting, end: Float[Array, "d"]) -> Float[Array, "d"]:
    """All closing joints at their ends, the others as in the meeting."""
    return np.where(roles.closes != 0, end, meeting.joints)


def _finished(
    name: str,
    hand: Mechanism,
    drives: Drives,
    roles: Roles,
    opened: Float[Array, "d"],
    closed: Float[Array, "d"],
    frames: Frames,
    postures: Postures,
    sides: tuple[list[int], list[int]],
    touching: Touching,
) -> Proposal:
    force, why = guess_force(hand, roles, opened, closed)
    voxel = round(float(np.clip(frames.opening / VOXELS, FINEST, COARSEST)), 3)
    return Proposal(name, hand, drives, roles, opened, closed, frames, force, why, postures, sides, voxel, touching)


def _plain_name(path: Path) -> str:
    """The file's name, or its folder's where that says more."""
    stem = path.stem
    if stem.lower() in ("hand", "gripper", "model", "robot", "right_hand", "left_hand", "urdf", "scene"):
        stem = f"{path.parent.name}_{stem}"
    return re.sub(r"[^A-Za-z0-9_]+", "_", stem).strip("_").lower() or "hand"
