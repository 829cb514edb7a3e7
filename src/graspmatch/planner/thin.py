"""Thinning a cloud to a number of points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.cloud import voxel_downsample

FINEST = 0.006
"""Spacing [m] that clouds of small objects are thinned to."""


def thinned(points: Float[np.ndarray, "n 3"], most: int) -> Float[np.ndarray, "m 3"]:
    """About `most` points at the most, evenly spread: voxels of a surface grow in number with the spacing squared."""
    thin = voxel_downsample(points, FINEST)[0]
    if len(thin) <= most:
        return thin
    return voxel_downsample(points, FINEST * np.sqrt(len(thin) / most))[0]
