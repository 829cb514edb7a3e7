"""A proposal as the text of a card, with the reason for each value beside it."""

from __future__ import annotations

import json

import numpy as np
from jaxtyping import Float

from graspmatch.gripper.propose.postures import Pose
from graspmatch.gripper.propose.proposal import Proposal

Array = np.ndarray

WIDTH = 116
"""Of a line of names, with its indent."""


def card_text(proposal: Proposal, description: str) -> str:
    """The card in TOML; `description` is the file's path from where the card will be."""
    frames, hand = proposal.frames, proposal.mechanism
    links = [link.name for link in hand.hand.links]
    lines = [
        "# Proposed from the description alone; everything here may be changed.",
        f"name = {_text(proposal.name)}",
        f"description = {_text(description)}",
        f"base_link = {_text(hand.description.base_link)}",
        f"# {frames.reasons['approach']}",
        f"approach = {_vector(frames.approach)}",
        f"# {frames.reasons['closing']}",
        f"closing = {_vector(frames.closing)}",
        f"# m; {frames.reasons['tool_centre_point']}",
        f"tool_centre_point = {_vector(frames.tool_centre_point)}",
        f"# N; {proposal.force_reason}",
        f"finger_force = {_number(proposal.finger_force)}",
        f"# m; {frames.reasons['opening']}",
        f"opening = {frames.opening:.3f}",
        *_names("palm", [links[i] for i in proposal.palm_links]),
        "",
        *_joints(proposal),
        *_couplings(proposal),
    ]
    for f, name in enumerate(proposal.finger_names):
        lines += ["[[fingers]]", f"name = {_text(name)}"]
        lines += _names("links", [links[i] for i in proposal.finger_links(f)])
        lines += _names("joints", [hand.joint_names[j] for j in np.flatnonzero(proposal.roles.closers[f])])
        lines.append("")
    lines += _preshapes(proposal)
    lines += ["[samples]", 'method = "mesh"', f"voxel_size = {_number(proposal.voxel_size)}"]
    return "\n".join(lines) + "\n"


def _joints(proposal: Proposal) -> list[str]:
    lines, hand, roles = [], proposal.mechanism, proposal.roles
    model = hand.description.model
    for j, name in enumerate(hand.joint_names):
        reason = proposal.drives.reasons.get(model.joint(name).id, "")
        if roles.is_wrist[j]:
            role = "wrist: stays where it is"
        elif roles.closes[j]:
            role = "closes upwards" if roles.closes[j] > 0 else "closes downwards"
        else:
            role = "spreads fingers"
        lines += [
            f"[joints.{_key(name)}]  # {role}; {reason}",
            f"open = {_joint_value(proposal, j, proposal.opened[j])}",
        ]
        if roles.closes[j]:
            lines.append(f"closed = {_joint_value(proposal, j, proposal.closed[j])}")
        lines.append("")
    return lines


def _couplings(proposal: Proposal) -> list[str]:
    lines, model = [], proposal.mechanism.description.model
    for follower, (leader, multiplier, offset) in proposal.drives.couplings.items():
        lines += [
            f"[couplings.{_key(model.joint(follower).name)}]  # {proposal.drives.reasons[follower]}",
            f"joint = {_text(model.joint(leader).name)}",
            f"multiplier = {_number(multiplier)}",
            f"offset = {_number(offset)}",
            "",
        ]
    return lines


def _preshapes(proposal: Proposal) -> list[str]:
    postures = proposal.postures
    lines = ["[preshapes]", f"steps = {postures.steps}"]
    if postures.steps:
        lines.append(f"closing = [{_number(postures.closing[0])}, {_number(postures.closing[1])}]")
    if postures.spread:
        spread = ", ".join(f"{_key(n)} = [{', '.join(map(_number, v))}]" for n, v in postures.spread.items())
        lines.append(f"spread = {{ {spread} }}")
    lines.append("")
    for pose in postures.poses:
        lines += ["[[preshapes.poses]]", f"name = {_text(pose.name)}"]
        lines += _values("joints", proposal, pose.joints, np.abs(pose.joints - proposal.opened) > 1e-4)
        lines += _closing_of(pose, proposal)
        lines.append("")
    return lines


def _closing_of(pose: Pose, proposal: Proposal) -> list[str]:
    lines = []
    if pose.closed is not None:
        moves = (proposal.roles.closes != 0) & (np.abs(pose.closed - pose.joints) > 1e-4)
        lines += _values("closed", proposal, pose.closed, moves)
    if pose.tool_centre_point is not None:
        lines.append(f"tool_centre_point = {_vector(pose.tool_centre_point)}")
    if pose.reach is not None:
        lines.append(f"reach = {_number(pose.reach)}")
    return lines


def _values(key: str, proposal: Proposal, values: Float[Array, "d"], which: Array) -> list[str]:
    """Joint values as dotted keys, one a line."""
    names = proposal.mechanism.joint_names
    return [f"{key}.{_key(names[j])} = {_joint_value(proposal, j, values[j])}" for j in map(int, np.flatnonzero(which))]


def _joint_value(proposal: Proposal, joint: int, value: float) -> str:
    """Rounded, if that stays within the limits."""
    hand = proposal.mechanism.hand
    is_within = hand.lower[joint] <= round(float(value), 4) <= hand.upper[joint]
    return _number(value) if is_within else f"{float(value):.9g}"


def _names(key: str, names: list[str]) -> list[str]:
    one = f"{key} = [{', '.join(map(_text, names))}]"
    if len(one) <= WIDTH:
        return [one]
    return [f"{key} = [", *(f"    {_text(name)}," for name in names), "]"]


def _vector(values: Float[Array, "3"]) -> str:
    return f"[{', '.join(map(_number, values))}]"


def _number(value: float) -> str:
    return f"{round(float(value), 4) + 0.0:g}"


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


def _key(name: str) -> str:
    """A bare key where TOML allows it, else a quoted one."""
    is_bare = name.isascii() and name.replace("_", "").replace("-", "").isalnum()
    return name if is_bare else _text(name)
