"""What each driven joint is for: which way it closes a finger, or that it spreads fingers, or turns the wrist."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from graspmatch.gripper.propose.posing import Mechanism
from graspmatch.gripper.propose.touching import MEETING, Touching

Array = np.ndarray

STILL = 1e-3
"""A tip that moves less over a joint's whole range is not moved by it [m]."""
POSTURES = 8
"""At so many postures of the other joints is tried which way a joint closes."""
STEPS = 3
"""Into which the way of a joint is cut to measure it."""
CURLS = 0.7
"""Cosine with the axis of a finger's last joint, from which a hinge curls the finger; below, it spreads it."""
NEARLY_OPEN = 0.35
"""Where the description's zero is so near to the open end, as a share of the range, the zero is the open hand."""
CLOSING_STEPS = 25
"""Into which the way from open to closed is cut to see where fingers meet."""


@dataclass(frozen=True)
class Roles:
    """What the d driven joints do for the f fingers."""

    closes: Float[Array, "d"]
    """1 where a joint closes upwards, -1 downwards, 0 where it does not close."""
    is_wrist: Bool[Array, "d"]
    moves: Bool[Array, "f d"]
    """Which tips each joint moves."""
    shrink: Float[Array, "d"]
    """How much the space between the tips and the palm shrinks for each metre that the tips move, closing."""

    @property
    def closers(self) -> Bool[Array, "f d"]:
        """The joints that close each finger."""
        return self.moves & (self.closes != 0)


def find_roles(mechanism: Mechanism) -> Roles:
    """Every joint is moved over its range, at several postures of the others, and the space in the hand measured."""
    rng = np.random.default_rng(0)
    lower, upper = mechanism.lower, mechanism.upper
    postures = lower + (upper - lower) * rng.uniform(0.2, 0.8, (POSTURES, len(lower)))
    d, f = len(lower), len(mechanism.branches)
    moves, gain = np.zeros((f, d), dtype=bool), np.zeros(d)
    way = np.zeros(d)
    for j in range(d):
        tried = [_sweep(mechanism, posture, j) for posture in postures]
        travel = np.mean([t for t, _ in tried], axis=0)
        moves[:, j] = travel > STILL
        way[j] = travel[moves[:, j]].mean() if moves[:, j].any() else 0.0
        gain[j] = np.mean([change for _, change in tried])
    wrist = np.isin(mechanism.joint_names, [mechanism.description.model.joint(j).name for j in mechanism.tree.wrist])
    closes = np.where(wrist | (way == 0), 0.0, _senses(mechanism, gain))
    return Roles(closes, wrist, moves & ~wrist, np.abs(gain) / np.maximum(way, 1e-9))


def _sweep(mechanism: Mechanism, posture: Float[Array, "d"], joint: int) -> tuple[Float[Array, "f"], float]:
    """How far each tip moves over the joint's range [m], and how much nearer tips come to each other and the palm."""
    tips = []
    for value in np.linspace(mechanism.lower[joint], mechanism.upper[joint], STEPS + 1):
        changed = posture.copy()
        changed[joint] = value
        tips.append(mechanism.tip_positions(mechanism.pose(changed)))
    way = np.array(tips)
    travel = np.linalg.norm(np.diff(way, axis=0), axis=-1).sum(axis=0)
    moved = travel > STILL
    if not moved.any():
        return travel, 0.0
    to_palm = np.linalg.norm(way - mechanism.palm_centre, axis=-1)[:, moved].mean(axis=1)
    apart = np.linalg.norm(way[:, :, None] - way[:, None], axis=-1)
    is_pair = np.triu(moved[:, None] | moved[None], 1)
    between = apart[:, is_pair].mean(axis=1) if is_pair.any() else np.zeros(len(way))
    space = to_palm + between
    return travel, float(space[0] - space[-1])


def _senses(mechanism: Mechanism, gain: Float[Array, "d"]) -> Float[Array, "d"]:
    """Which way each joint closes; the hinges that curl one finger agree on the way round."""
    model = mechanism.description.model
    driven = [model.joint(name).id for name in mechanism.joint_names]
    _, axes = mechanism.joint_axes(mechanism.home)
    senses = np.zeros(len(driven))
    for branch in mechanism.branches:
        inside = [i for i, j in enumerate(driven) if j in branch.joints]
        hinges = [i for i in inside if model.jnt_type[driven[i]] == mujoco.mjtJoint.mjJNT_HINGE]
        slides = [i for i in inside if i not in hinges]
        senses[slides] = np.sign(gain[slides])
        if not hinges:
            continue
        last = axes[_last_hinge(mechanism, branch.joints)]
        along = np.array([float(axes[driven[i]] @ last) for i in hinges])
        curling = np.abs(along) >= CURLS
        vote = np.sign(np.sum(np.sign(along[curling]) * gain[hinges][curling]))
        senses[hinges] = np.where(curling, np.sign(along) * vote, 0.0)
    return senses


def _last_hinge(mechanism: Mechanism, joints: tuple[int, ...]) -> int:
    """The hinge of a finger that is nearest to its tip."""
    model = mechanism.description.model
    f = next(i for i, branch in enumerate(mechanism.branches) if branch.joints == joints)
    body = mechanism.description.link_bodies[mechanism.tips[f][0]]
    while body > 0:
        first = model.body_jntadr[body]
        own = [j for j in range(first, first + model.body_jntnum[body]) if j in joints]
        if own and model.jnt_type[own[-1]] == mujoco.mjtJoint.mjJNT_HINGE:
            return own[-1]
        body = int(model.body_parentid[body])
    return next(j for j in reversed(joints) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE)


def open_posture(mechanism: Mechanism, roles: Roles) -> Float[Array, "d"]:
    """Every finger open: at the end of its joints' ranges, or at the description's zero where that is near it.

    Joints that do not close are where the description has them.
    """
    lower, upper, home = mechanism.lower, mechanism.upper, mechanism.home
    end = np.where(roles.closes > 0, lower, upper)
    share = np.abs(home - end) / np.maximum(upper - lower, 1e-9)
    alone = roles.closers.sum(axis=1) == 1
    single = np.array([np.all(alone[roles.moves[:, j]]) for j in range(len(lower))])
    at_end = single | (share > NEARLY_OPEN)
    at_end &= ~((~single) & (share <= 0.5))
    return np.where((roles.closes != 0) & at_end, end, home)


def closed_end(mechanism: Mechanism, roles: Roles) -> Float[Array, "d"]:
    """Every closing joint at the end of its range."""
    end = np.where(roles.closes > 0, mechanism.upper, mechanism.lower)
    return np.where(roles.closes != 0, end, mechanism.home)


def close_until_met(
    mechanism: Mechanism,
    roles: Roles,
    touching: Touching,
    start: Float[Array, "d"],
    end: Float[Array, "d"],
    fingers: list[int] | None = None,
) -> tuple[Float[Array, "d"], Float[Array, "f"]]:
    """Close fingers together from `start` towards `end` until each meets another, the palm, or its end.

    Returns the joint values then and the share of the way that each finger has gone.
    """
    count = len(mechanism.branches)
    active = np.isin(np.arange(count), range(count) if fingers is None else fingers)
    links = [mechanism.links_of(branch.bodies) for branch in mechanism.branches]
    outer = [mechanism.outer_links(branch) for branch in mechanism.branches]
    drives = [set(np.flatnonzero(row)) for row in roles.closers]
    share = np.zeros(count)
    moving = active & np.array([bool(drive) for drive in drives])
    while moving.any() and share[moving].min() < 1:
        share[moving] = np.minimum(share[moving] + 1 / CLOSING_STEPS, 1.0)
        T = mechanism.pose(at_share(roles, start, end, share))
        ends = [mechanism.holding_points(f, T) for f in range(count)]  # further in, fingers may pass through each other
        for f in np.flatnonzero(moving):
            for g in (g for g in range(count) if g != f):
                apart = min(touching.clearance_of(ends[f], links[g], T), touching.clearance_of(ends[g], links[f], T))
                if apart < MEETING:
                    moving[[f, g]] = False
            if touching.clearance(outer[f], mechanism.palm_links, T) < MEETING:
                moving[f] = False
        for f in range(count):  # one drive stops all its fingers
            if not moving[f] and active[f]:
                moving &= np.array([not drives[f] & drives[g] for g in range(count)])
        moving &= share < 1
    return at_share(roles, start, end, share), share


def together(mechanism: Mechanism, roles: Roles, share: Float[Array, "f"]) -> Float[Array, "f"]:
    """The same where fingers with ranges alike close equally far: as far as the first that meets another."""
    span = mechanism.upper - mechanism.lower
    own = [np.sort(span[row]) for row in roles.closers]
    alike = [[g for g in range(len(own)) if _same(own[f], own[g])] for f in range(len(own))]
    return np.array([min(share[g] for g in group) for group in alike])


def _same(a: Float[Array, "n"], b: Float[Array, "m"]) -> bool:
    return len(a) == len(b) and bool(np.allclose(a, b, rtol=0.05))


def at_share(
    roles: Roles, start: Float[Array, "d"], end: Float[Array, "d"], share: Float[Array, "f"]
) -> Float[Array, "d"]:
    """Driven joint values when each finger has gone a share of its way from `start` to `end`."""
    closers = roles.closers
    of_joint = np.where(closers.any(axis=0), np.max(np.where(closers, share[:, None], 0.0), axis=0), 0.0)
    return start + of_joint * (end - start)
