"""Values of the joints that spread fingers at which the fingers close against each other."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from graspmatch.gripper.propose.closing import Roles
from graspmatch.gripper.propose.posing import Mechanism

Array = np.ndarray

LEVELS = 4
"""Values of each spread joint that are tried."""
MOST_COMBINATIONS = 300
BALANCED = 0.45
"""Fingers whose ways of closing add up to less than this, in lengths of one, hold something between them."""
BETTER = 0.15
"""A spread is worth a preshape if it balances so much better than the others."""
APART = 0.3
"""Of the range of a joint: spreads nearer than this are the same."""


def find_spreads(
    mechanism: Mechanism,
    roles: Roles,
    opened: Float[Array, "d"],
    closed: Float[Array, "d"],
    approach: Float[Array, "3"],
) -> list[Float[Array, "d"]]:
    """Up to two open postures: the description's own spread if it opposes fingers, and the one that does so best."""
    joints = np.flatnonzero((roles.closes == 0) & ~roles.is_wrist & roles.moves.any(axis=0))
    if not len(joints) or LEVELS ** len(joints) > MOST_COMBINATIONS:
        return [opened]
    levels = [np.linspace(mechanism.lower[j], mechanism.upper[j], LEVELS) for j in joints]
    tried = []
    for values in itertools.product(*levels):
        posture = opened.copy()
        posture[joints] = values
        tried.append((imbalance(mechanism, roles, posture, closed, approach), posture))
    own = imbalance(mechanism, roles, opened, closed, approach)
    # Of equally good ones the nearest to the description's own, and where fingers spread alike.
    span = (mechanism.upper - mechanism.lower)[joints]

    def worth(entry: tuple[float, Float[Array, "d"]]) -> tuple[float, float]:
        share = np.abs(entry[1][joints] - opened[joints]) / span
        return round(entry[0], 1), float(np.ptp(share) + 0.1 * share.mean())

    best_value, best = min(tried, key=worth)
    is_other = np.max(np.abs(best[joints] - opened[joints]) / span) > APART
    if own > BALANCED:
        return [best if best_value < own else opened]
    return [opened, best] if is_other and best_value < own - BETTER else [opened]


def imbalance(
    mechanism: Mechanism,
    roles: Roles,
    posture: Float[Array, "d"],
    closed: Float[Array, "d"],
    approach: Float[Array, "3"],
) -> float:
    """Length of the sum of the unit vectors along which the tips close across the approach, over their number."""
    end = np.where(roles.closes != 0, closed, posture)
    middle, step = (posture + end) / 2, 0.02 * (end - posture)
    before, after = (mechanism.tip_positions(mechanism.pose(middle + s * step)) for s in (-1, 1))
    ways = after - before
    ways -= np.outer(ways @ approach, approach)
    ways = ways[np.linalg.norm(ways, axis=-1) > 1e-6]
    units = ways / np.linalg.norm(ways, axis=-1, keepdims=True)
    return float(np.linalg.norm(units.mean(axis=0)))
