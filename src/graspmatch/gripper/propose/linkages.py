"""Linkages whose loops a description does not close, but imitates by joints that follow: their parts are one finger."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from graspmatch.gripper.propose.posing import Mechanism
from graspmatch.gripper.propose.tree import Branch

Array = np.ndarray

PINNED = 0.006
"""Parts of a linkage stay so near to each other wherever the hand moves [m]."""
ALONGSIDE = 0.3
"""Cosine between the ways that they move."""
SHARES = (0.0, 0.5, 1.0)
"""Of the joints' ranges, at which the hand is looked at."""


def join_linkages(mechanism: Mechanism) -> Mechanism:
    """The same with branches that one drive moves, the same way and always touching, taken as one."""
    branches = list(mechanism.branches)
    span = mechanism.upper - mechanism.lower
    poses = [mechanism.pose(mechanism.lower + share * span) for share in SHARES]
    moved_by = [_drives_of(mechanism, branch) for branch in branches]
    joined = list(range(len(branches)))
    for a, b in itertools.combinations(range(len(branches)), 2):
        if moved_by[a] == moved_by[b] != frozenset() and _stay_together(mechanism, branches[a], branches[b], poses):
            keep, drop = sorted((joined[a], joined[b]))
            joined = [keep if group == drop else group for group in joined]
    merged = []
    for first in sorted(set(joined)):
        parts = [branch for branch, group in zip(branches, joined, strict=True) if group == first]
        bodies, joints = ([i for part in parts for i in getattr(part, name)] for name in ("bodies", "joints"))
        merged.append(Branch(tuple(bodies), tuple(joints)))
    return replace(mechanism, branches=tuple(merged))


def _drives_of(mechanism: Mechanism, branch: Branch) -> frozenset[int]:
    """The driven joints that move a branch."""
    links, found = mechanism.links_of(branch.bodies), []
    middle = (mechanism.lower + mechanism.upper) / 2
    before = mechanism.pose(middle)[links]
    for j, room in enumerate(mechanism.upper - mechanism.lower):
        changed = middle.copy()
        changed[j] += 0.1 * room
        if np.abs(mechanism.pose(changed)[links] - before).max() > 1e-6:
            found.append(j)
    return frozenset(found)


def _stay_together(mechanism: Mechanism, one: Branch, other: Branch, poses: list[Float[Array, "l 4 4"]]) -> bool:
    links = [mechanism.links_of(branch.bodies) for branch in (one, other)]
    clouds = [[mechanism.points(own, T) for own in links] for T in poses]
    grain = max(np.sqrt(mechanism.shapes[i].areas[0]) for own in links for i in own)
    ways = [clouds[-1][k].mean(axis=0) - clouds[0][k].mean(axis=0) for k in (0, 1)]
    lengths = [max(float(np.linalg.norm(way)), 1e-9) for way in ways]
    if float(ways[0] @ ways[1]) < ALONGSIDE * lengths[0] * lengths[1]:
        return False
    return all(float(KDTree(a).query(b)[0].min()) < PINNED + grain for a, b in clouds)
