"""What formats for parallel jaws know of a hand: where its fingertips are and how wide it is open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from graspmatch.types import Gripper, Preshape

PAD_DEPTH = 0.02
"""The pads are looked for up to here behind the fingertips [m]."""
FACING = 0.5
"""A part of the inner surface is a pad where the cosine between its normal and the closing axis is at least this."""
SLACK = 1e-4
"""A preshape counts as wide enough up to this [m], since other tools store widths in single precision."""


@dataclass(frozen=True)
class Jaw:
    """What such a format knows of a hand, for one preshape."""

    tip_centre: Float[np.ndarray, "3"]
    """The middle between the fingertips, in the plane of the foremost point of the fingers [m], gripper frame."""
    opening: float
    """Clear distance between the pads along the closing axis [m]; NaN where there are no two pads face to face."""


def jaw(preshape: Preshape, gripper: Gripper) -> Jaw:
    """The jaw of a preshape, from the outlines of its fingers and the samples of its inner surface near their tips."""
    tip = max(float((outline[0] @ gripper.approach).max()) for outline in preshape.finger_outlines)
    points, normals = preshape.samples.points, preshape.samples.normals
    assert normals is not None, "baking gives every sample its normal"
    across = points @ gripper.closing
    facing = np.where(points @ gripper.approach > tip - PAD_DEPTH, normals @ gripper.closing, 0.0)
    upper = float(across[facing <= -FACING].min(initial=np.inf))
    lower = float(across[facing >= FACING].max(initial=-np.inf))
    has_pads = np.isfinite(upper - lower) and upper > lower
    tcp = gripper.tool_centre_point
    middle = (upper + lower) / 2 if has_pads else float(tcp @ gripper.closing)
    to_middle = (middle - tcp @ gripper.closing) * gripper.closing + (tip - tcp @ gripper.approach) * gripper.approach
    return Jaw(tcp + to_middle, upper - lower if has_pads else np.nan)


def openings(gripper: Gripper) -> Float[np.ndarray, "p"]:
    """Jaw opening of each preshape [m]."""
    return np.array([jaw(preshape, gripper).opening for preshape in gripper.preshapes])


def fitting_preshape(width: Float[np.ndarray, "n"], opening: Float[np.ndarray, "p"]) -> Int[np.ndarray, "n"]:
    """For each width the preshape of the smallest opening that is no less, else of the largest.

    No margin is added: the width in a file is a jaw opening, in which its author's margin is already.
    """
    known = np.where(np.isnan(opening), -np.inf, opening)  # hands without a jaw take their first preshape
    fits = known >= width[:, None] - SLACK
    narrowest = np.argmin(np.where(fits, known, np.inf), axis=-1)
    return np.where(fits.any(axis=-1), narrowest, np.argmax(known))
