"""Regular grids of samples: signed distance fields and the fields derived from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped


@dataclass(frozen=True)
class Grid:
    """Values at the nodes `origin + spacing * (i, j, k)` of a regular grid."""

    origin: Float[np.ndarray, "3"]
    """Position of the node (0, 0, 0) [m]."""
    spacing: float
    """Distance between neighbouring nodes [m]."""
    values: Shaped[np.ndarray, "nx ny nz"]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along x, y and z."""
        return self.values.shape  # type: ignore[return-value]

    def shifted(self, offset: Float[np.ndarray, "3"]) -> Grid:
        """The same values, moved by `offset` [m]."""
        return Grid(self.origin + offset, self.spacing, self.values)


def node_positions(
    origin: Float[np.ndarray, "3"], spacing: float, shape: tuple[int, int, int]
) -> Float[np.ndarray, "n 3"]:
    """Positions of all nodes of a grid [m], z fastest."""
    axes = [origin[i] + spacing * np.arange(shape[i]) for i in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def covering(
    lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], spacing: float
) -> tuple[Float[np.ndarray, "3"], tuple[int, int, int]]:
    """Origin and shape of the smallest grid that covers a box [m], centred on it."""
    shape = np.maximum(np.ceil((upper - lower) / spacing).astype(int) + 1, 2)
    origin = (lower + upper) / 2 - spacing * (shape - 1) / 2
    return origin, (int(shape[0]), int(shape[1]), int(shape[2]))


def interpolate(grid: Grid, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Trilinear value at each point; outside, the value on the grid's border plus the distance to it."""
    limit = np.array(grid.shape) - 1
    u = (points - grid.origin) / grid.spacing
    inside = np.clip(u, 0, limit)
    low = np.minimum(inside.astype(int), limit - 1)
    f = inside - low
    result = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, f, 1 - f), axis=-1)
        result += weight * grid.values[tuple((low + corner).T)]
    return result + grid.spacing * np.linalg.norm(u - inside, axis=-1)
