"""Colours of scores and of reasons, sRGB from 0 to 255."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

Array = np.ndarray
Rgb = tuple[int, int, int]

OBJECT: Rgb = (219, 120, 84)
OBSTACLE: Rgb = (150, 156, 162)
TABLE: Rgb = (226, 221, 212)
HAND: Rgb = (120, 128, 138)
CONTACT: Rgb = (30, 30, 30)
CONE: Rgb = (250, 205, 60)
PARTICLE: Rgb = (40, 99, 168)

SCALE = np.array([(240, 222, 60), (122, 209, 81), (34, 168, 132), (42, 120, 142), (58, 82, 139)], dtype=float)
"""From the lowest score to the highest: each darker than the one before, readable without telling red from green."""

REASONS: tuple[Rgb, ...] = (
    (0, 120, 80),
    (214, 39, 40),
    (235, 140, 205),
    (255, 140, 14),
    (148, 103, 189),
    (135, 135, 135),
    (200, 200, 40),
    (110, 200, 240),
    (25, 60, 150),
    (50, 50, 50),
)


def colours_of_scores(score: Float[Array, "n"]) -> UInt8[Array, "n 3"]:
    """From bright for the lowest of them to dark for the highest; dark where all are equal."""
    low, high = (float(score.min()), float(score.max())) if len(score) else (0.0, 0.0)
    share = (score - low) / (high - low) if high > low else np.ones(len(score))
    place = np.nan_to_num(share, nan=0.0) * (len(SCALE) - 1)
    return np.stack([np.interp(place, np.arange(len(SCALE)), SCALE[:, c]) for c in range(3)], axis=-1).astype(np.uint8)


def colour_of_reason(number: int) -> Rgb:
    """Of the reason that comes so manieth in the tally."""
    return REASONS[number % len(REASONS)]


def css(rgb: Rgb) -> str:
    """The colour as a style sheet says it."""
    return f"rgb({rgb[0]}, {rgb[1]}, {rgb[2]})"
