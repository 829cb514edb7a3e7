"""Directions spread over the sphere."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

GOLDEN_RATIO = (1 + 5**0.5) / 2


def fibonacci_directions(n: int) -> Float[np.ndarray, "n 3"]:
    """n unit vectors, even in height and a golden angle apart: the Fibonacci lattice of the sphere."""
    i = np.arange(n) + 0.5
    z = 1 - 2 * i / n
    azimuth = 2 * np.pi * i / GOLDEN_RATIO
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=-1)
