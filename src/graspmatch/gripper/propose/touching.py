"""How near the links of a posed hand are to each other."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.config import BakingConfig
from graspmatch.geometry.grid import interpolate
from graspmatch.geometry.se3 import apply, inverse
from graspmatch.gripper.bake import link_field
from graspmatch.gripper.propose.posing import Mechanism

Array = np.ndarray

FIELDS = BakingConfig(link_spacing=0.003, margin=0.006)
"""Coarse, for they only say whether links meet."""
MEETING = 0.0005
"""Links that are nearer than this touch [m]: what the fields resolve."""


class Touching:
    """The links' signed distance fields, and which links touch whatever the posture because they are built so."""

    def __init__(self, mechanism: Mechanism, built: Float[Array, "d"]) -> None:
        """`built` is a posture in which nothing touches that need not."""
        self.mechanism = mechanism
        self.fields = [link_field(link.collision, FIELDS) for link in mechanism.hand.links]
        self.radius = [np.linalg.norm(shape.points, axis=-1).max() for shape in mechanism.shapes]
        count = len(self.fields)
        T = mechanism.pose(built)
        self.joined = {(a, b) for a in range(count) for b in range(a) if self._distance(a, b, T[a], T[b]) < 2 * MEETING}

    def clearance(self, first: list[int], second: list[int], T_base_link: Float[Array, "l 4 4"]) -> float:
        """Smallest distance between two sets of links [m], negative where they overlap; joined links do not count."""
        pairs = [(max(a, b), min(a, b)) for a in first for b in second if a != b]
        free = [pair for pair in pairs if pair not in self.joined]
        return min((self._distance(a, b, T_base_link[a], T_base_link[b]) for a, b in free), default=np.inf)

    def clearance_of(self, points: Float[Array, "n 3"], links: list[int], T_base_link: Float[Array, "l 4 4"]) -> float:
        """Smallest distance of points of the base's frame to some links [m]."""
        fields = ((self.fields[i], inverse(T_base_link[i])) for i in links)
        return min((float(interpolate(field, apply(T, points)).min()) for field, T in fields), default=np.inf)

    def _distance(self, a: int, b: int, T_base_a: Float[Array, "4 4"], T_base_b: Float[Array, "4 4"]) -> float:
        apart = float(np.linalg.norm(T_base_a[:3, 3] - T_base_b[:3, 3])) - self.radius[a] - self.radius[b]
        if apart > 0.01:
            return apart
        T_b_a = inverse(T_base_b) @ T_base_a
        one = interpolate(self.fields[b], apply(T_b_a, self.mechanism.shapes[a].points)).min()
        other = interpolate(self.fields[a], apply(inverse(T_b_a), self.mechanism.shapes[b].points)).min()
        return float(min(one, other))
