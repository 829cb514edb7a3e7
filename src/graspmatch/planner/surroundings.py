"""C of the paper: everything the hand may not touch, as points, and the table as the plane that it is."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.geometry import se3
from graspmatch.geometry.cloud import voxel_downsample
from graspmatch.scene.scene import Scene
from graspmatch.types import Plane

TABLE_MARGIN = 0.08
"""How far the patch of table reaches beyond the target [m]: about the width of a hand."""
TABLE_SPACING = 0.012
"""Spacing of its points [m]; the exact plane is checked after matching."""


def collision_cloud(scene: Scene, spacing: float) -> Float[np.ndarray, "n 3"]:
    """Target, obstacles and a patch of table, thinned to `spacing` [m], world frame."""
    solid = voxel_downsample(solid_points(scene), spacing)[0]
    if scene.table is None:
        return solid
    return np.concatenate([solid, table_patch(scene.table, scene.target.points)])


def solid_points(scene: Scene) -> Float[np.ndarray, "n 3"]:
    """All points of target and obstacles, world frame."""
    return np.concatenate([scene.target.points, scene.obstacles.points])


def table_patch(table: Plane, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Points of the plane under and around the given ones."""
    hint = np.eye(3)[np.argmin(np.abs(table.normal))]
    R_world_table = se3.rotation_facing(table.normal, hint)
    flat = points @ R_world_table[:, :2]
    axes = [
        np.arange(flat[:, a].min() - TABLE_MARGIN, flat[:, a].max() + TABLE_MARGIN, TABLE_SPACING) for a in range(2)
    ]
    u, v = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
    return u[:, None] * R_world_table[:, 0] + v[:, None] * R_world_table[:, 1] + table.offset * table.normal
