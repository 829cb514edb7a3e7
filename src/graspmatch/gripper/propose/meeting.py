"""Postures of many-jointed fingers in which their tips face and meet each other: pinch, tripod, and all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from graspmatch.geometry.se3 import apply
from graspmatch.gripper.propose.closing import Roles
from graspmatch.gripper.propose.posing import Mechanism

Array = np.ndarray

NEAR = 0.01
"""A gap between tips that meet counts in squares of this [m]."""
FACING, COMFORT = 4.0, 0.5
"""Weights of tips that face each other and of joints near the middle of their ranges."""
FACED = 0.75
"""Cosine between the way that a tip closes and the way to the other, from which on it faces that well enough."""
TRIED, POLISHED, MOST_STEPS = 400, 2, 40
"""So many random postures are tried, the best of them improved in so many steps at most."""
REST = 0.35
"""Share of a closing joint's range at which it is most comfortable."""
MET, OPPOSED = 0.006, 0.4
"""Tips that come so near meet [m], if they face each other with this cosine at least."""


@dataclass(frozen=True)
class Pads:
    """The front of each fingertip in the frame of its link."""

    links: tuple[int, ...]
    centres: Float[Array, "f 3"]
    """Of the tips [m]."""
    fronts: Float[Array, "f 3"]
    """Unit vectors: where the tip goes as its finger closes."""
    depths: Float[Array, "f"]
    """From the centre to the front [m]."""

    def posed(self, T_base_link: Float[Array, "l 4 4"]) -> tuple[Float[Array, "f 3"], Float[Array, "f 3"]]:
        """Centres and fronts in the frame of the base."""
        T = T_base_link[list(self.links)]
        return apply(T, self.centres[:, None])[:, 0], np.einsum("fij,fj->fi", T[:, :3, :3], self.fronts)


@dataclass(frozen=True)
class Meeting:
    """A posture in which the tips of some fingers meet."""

    fingers: tuple[int, ...]
    """The one that opposes the others first."""
    joints: Float[Array, "d"]
    gap: float
    """Between the tip of the first and the middle of the others' [m]."""
    facing: float
    """Cosine between the ways that tips close and the ways to each other, least."""

    @property
    def is_met(self) -> bool:
        """Whether the fingers can oppose each other so."""
        return self.gap < MET and self.facing > OPPOSED

    @property
    def badness(self) -> float:
        """How far from a good one."""
        return min((self.gap / NEAR) ** 2 + FACING * max(FACED - self.facing, 0.0) ** 2, 3.0)


def find_pads(mechanism: Mechanism, roles: Roles, opened: Float[Array, "d"], closed: Float[Array, "d"]) -> Pads:
    """The side of each tip that goes ahead when the last joint of its finger closes."""
    centres, fronts, depths = [], [], []
    middle = (opened + closed) / 2
    for f, (link, tip) in enumerate(mechanism.tips):
        last = np.flatnonzero(roles.closers[f])[-1:]
        step = np.zeros(len(opened))
        step[last] = 1e-3 * np.sign(closed - opened)[last]
        here, there = mechanism.pose(middle)[link], mechanism.pose(middle + step)[link]
        centre = tip.mean(axis=0)
        motion = here[:3, :3].T @ (apply(there, centre[None]) - apply(here, centre[None]))[0]
        front = motion / max(float(np.linalg.norm(motion)), 1e-12)
        centres.append(centre)
        fronts.append(front)
        depths.append(float(((tip - centre) @ front).max()))
    return Pads(tuple(link for link, _ in mechanism.tips), np.array(centres), np.array(fronts), np.array(depths))


def meet(
    mechanism: Mechanism,
    roles: Roles,
    pads: Pads,
    opened: Float[Array, "d"],
    fingers: Sequence[int],
    *,
    spread: bool = True,
    polished: int = POLISHED,
) -> Meeting:
    """The most comfortable posture in which the first of some fingers meets the middle of the others, the rest open.

    Without `spread` only the first moves sideways. Of the postures tried, the best `polished` are improved.
    """
    first, others = fingers[0], list(fingers[1:])
    closing = roles.closers[others].any(axis=0)
    free = np.flatnonzero(roles.moves[first] | (roles.moves[others].any(axis=0) if spread else closing))
    low, span = mechanism.lower[free], (mechanism.upper - mechanism.lower)[free]
    closes = roles.closes[free]
    home = (mechanism.home[free] - low) / span
    rest = np.where(closes > 0, REST, np.where(closes < 0, 1 - REST, home))

    def posture(unit: Float[Array, "m"]) -> Float[Array, "d"]:
        joints = opened.copy()
        joints[free] = low + unit * span
        return joints

    def measures(joints: Float[Array, "d"]) -> tuple[float, Float[Array, "2"]]:
        centres, fronts = pads.posed(mechanism.pose(joints))
        way = centres[others].mean(axis=0) - centres[first]
        apart = float(np.linalg.norm(way))
        front = fronts[others].mean(axis=0)
        facing = np.array([way @ fronts[first], -way @ front]) / max(apart, 1e-9)
        return apart - float(pads.depths[others].mean()) - float(pads.depths[first]), facing

    def cost(unit: Float[Array, "m"]) -> float:
        gap, facing = measures(posture(unit))
        away = np.mean(np.maximum(FACED - facing, 0.0) ** 2)
        return float((gap / NEAR) ** 2 + FACING * away + COMFORT * np.mean((unit - rest) ** 2))

    drawn = np.random.default_rng(0).uniform(0, 1, (TRIED, len(free)))
    begins = sorted(drawn, key=cost)
    options = {"bounds": [(0.0, 1.0)] * len(free), "options": {"maxiter": MOST_STEPS}}
    found = [minimize(cost, begin, method="L-BFGS-B", **options).x for begin in begins[:polished]]
    joints = posture(min(found or begins[:1], key=cost))
    gap, facing = measures(joints)
    return Meeting(tuple(fingers), joints, abs(gap), float(facing.min()))


def find_thumb(mechanism: Mechanism, roles: Roles, pads: Pads, opened: Float[Array, "d"]) -> tuple[int, list[Meeting]]:
    """The finger that can oppose the most others, and its meetings with each of them, the best first."""
    fingers = range(len(mechanism.branches))
    rough = {
        (a, b): meet(mechanism, roles, pads, opened, (a, b), polished=0) for a in fingers for b in fingers if a < b
    }
    thumb = min(fingers, key=lambda f: sum(meeting.badness for pair, meeting in rough.items() if f in pair))
    meetings = [meet(mechanism, roles, pads, opened, (thumb, f)) for f in fingers if f != thumb]
    return thumb, sorted(meetings, key=lambda meeting: meeting.badness)
