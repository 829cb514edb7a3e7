"""Uploading grids and clouds to the device, in the form that the kernels read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from graspmatch.geometry import grid as grids
from graspmatch.kernels import warp_fields
from graspmatch.kernels.launch import launch


def stack_fields(fields: Sequence[grids.Grid], device: str) -> warp_fields.FieldStack:
    """Grids of one spacing as one stack."""
    stack = warp_fields.FieldStack()
    sizes = [field.values.size for field in fields]
    stack.values = wp.array(
        np.concatenate([np.asarray(f.values, dtype=np.float32).ravel() for f in fields]), device=device
    )
    stack.start = wp.array(np.cumsum([0, *sizes[:-1]]), dtype=wp.int32, device=device)
    stack.origin = wp.array(np.array([f.origin for f in fields]), dtype=wp.vec3, device=device)
    stack.dims = wp.array(np.array([f.shape for f in fields]), dtype=wp.vec3i, device=device)
    stack.spacing = fields[0].spacing
    return stack


def nearest_field(
    points: Float[np.ndarray, "n 3"],
    origin: Float[np.ndarray, "3"],
    shape: tuple[int, int, int],
    spacing: float,
    device: str,
) -> warp_fields.NearestField:
    """The nearest-neighbour field of a cloud on a given grid: seeds at the points' nodes, three sweeps, one repair."""
    field = warp_fields.NearestField()
    field.origin, field.dims, field.spacing = wp.vec3(*origin), wp.vec3i(*shape), spacing
    field.points = wp.array(points, dtype=wp.vec3, device=device)
    seed = wp.array(_seed_nodes(points, origin, shape, spacing), dtype=wp.int32, device=device)
    index = wp.empty_like(seed)
    for axis in range(3):
        lines = int(np.prod(shape)) // shape[axis]
        sweep = [axis, field.origin, field.dims, spacing, field.points, seed]
        launch(warp_fields.sweep_nearest, lines, sweep, [index], device)
        seed, index = index, seed
    grid = [field.origin, field.dims, spacing, field.points]
    launch(warp_fields.refine_nearest, int(np.prod(shape)), [*grid, seed], [index], device)
    field.index = index
    return field


def covering_nearest_field(
    points: Float[np.ndarray, "n 3"], spacing: float, margin: float, device: str
) -> warp_fields.NearestField:
    """The nearest-neighbour field of a cloud on a grid that reaches `margin` [m] beyond it.

    Nodes are the centres of the cells of `voxel_downsample`, so a cloud thinned at this spacing has one point a node.
    """
    lower, upper = points.min(axis=0) - margin, points.max(axis=0) + margin
    origin = (np.floor(lower / spacing) + 0.5) * spacing
    counts = np.maximum(np.ceil((upper - origin) / spacing).astype(int) + 1, 2)
    return nearest_field(points, origin, (int(counts[0]), int(counts[1]), int(counts[2])), spacing, device)


def _seed_nodes(
    points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], shape: tuple[int, int, int], spacing: float
) -> Int[np.ndarray, "m"]:
    """For each node the point rounded to it, the nearest where several are, -1 where none is."""
    u = (points - origin) / spacing
    node = np.clip(np.rint(u).astype(int), 0, np.array(shape) - 1)
    order = np.argsort(-np.sum((u - node) ** 2, axis=-1), kind="stable")
    seed = np.full(int(np.prod(shape)), -1, dtype=np.int32)
    seed[np.ravel_multi_index(tuple(node[order].T), shape)] = order
    return seed
