"""Thinning a cloud to a number of points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.cloud import extent, voxel_downsample

FINEST = 0.006
"""Spacing [m] that clouds of few points are thinned to, or a tenth of the object where that is less."""


def thinned(points: Float[np.ndarray, "n 3"], most: int) -> Float[np.ndarray, "m 3"]:
    """About `most` points or fewer, evenly spread: voxels of a surface get fewer with the square of their size."""
    if len(points) == 0:
        return points
    spacing = min(FINEST, extent(points) / 10)
    thin = voxel_downsample(points, spacing)[0]
    if len(thin) <= most:
        return thin
    return voxel_downsample(points, spacing * np.sqrt(len(thin) / most))[0]
