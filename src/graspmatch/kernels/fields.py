"""Uploading grids and clouds to the device, in the form that the kernels read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from jaxtyping import Float, Int, UInt8

from graspmatch.geometry import grid as grids
from graspmatch.geometry.cloud import bounds
from graspmatch.geometry.sphere import GOLDEN_RATIO
from graspmatch.kernels import warp_fields
from graspmatch.kernels.launch import launch
from graspmatch.kernels.warp_blocks import BLOCK, FAR


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


def pack_levels(fields: Sequence[grids.Grid], step: float, device: str) -> wp.array:
    """The bytes of `warp_blocks` for a stack of these fields, four to a word: what the lowest corner of a cell says."""
    return pack_bytes([cell_levels(np.asarray(field.values), step) for field in fields], device)


def pack_bytes(grids: Sequence[UInt8[np.ndarray, "nx ny nz"]], device: str) -> wp.array:
    """A byte for each cell of a stack of grids, four to a word."""
    values = np.concatenate([grid.ravel() for grid in grids])
    return wp.array(np.pad(values, (0, -len(values) % 4)).view("<i4"), dtype=wp.int32, device=device)


def cell_levels(values: Float[np.ndarray, "nx ny nz"], step: float) -> UInt8[np.ndarray, "nx ny nz"]:
    """Level 0 where a corner of the cell is below zero, level n where all are (n - 1) steps or more, at most 255."""
    lowest = values
    for axis in range(3):
        upper = np.concatenate([np.delete(lowest, 0, axis), np.take(lowest, [-1], axis)], axis)
        lowest = np.minimum(lowest, upper)
    return np.clip(np.floor(lowest / step) + 1, 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class BlockCloud:
    """Points on the device in blocks of neighbours."""

    points: wp.array
    """Of each block first all x, then all y, then all z [m]; the last block of each cloud is filled up with points far
    away."""
    balls: wp.array
    """Around blocks, of each 32 of them first all x of their centres, then all y, all z and all radii [m]."""
    ends: tuple[int, ...]
    """For each of the clouds that lie one after the other, the block after its last one."""

    @property
    def blocks(self) -> int:
        """Of all clouds."""
        return self.ends[-1]


NEIGHBOURHOOD = 0.016
"""Edge of the voxels whose points become neighbours in a block [m]."""


def upload_blocks(clouds: Sequence[Float[np.ndarray, "_ 3"]], device: str, *, scattered: bool = False) -> BlockCloud:
    """Clouds one after the other, each in an order in which neighbours follow each other (see `in_block_order`).

    scattered: the blocks in an order in which the first few already have points everywhere, for kernels that look for a
        minimum: they know a low one early, and can leave out most others.
    """
    parts = [in_blocks(cloud) for cloud in clouds]
    parts = [scatter(part) for part in parts] if scattered else parts
    blocks = np.concatenate(parts)
    points = wp.array(blocks.ravel(), dtype=wp.float32, device=device)
    balls = wp.array(balls_around(blocks).ravel(), dtype=wp.float32, device=device)
    return BlockCloud(points, balls, tuple(int(end) for end in np.cumsum([len(part) for part in parts])))


def in_blocks(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3 b"]:
    """Points in the order given, coordinate by coordinate in each block, the last block filled up."""
    blocks = np.full((-(-len(points) // BLOCK), BLOCK, 3), FAR, dtype=np.float32)
    blocks.reshape(-1, 3)[: len(points)] = points
    return np.ascontiguousarray(np.swapaxes(blocks, 1, 2))


def balls_around(blocks: Float[np.ndarray, "m 3 b"]) -> Float[np.ndarray, "k 4 b"]:
    """Centre and radius of a ball around each block, coordinate by coordinate for each 32 of them."""
    is_filled = blocks[:, :1] < FAR
    lower = np.where(is_filled, blocks, np.inf).min(axis=-1)
    upper = np.where(is_filled, blocks, -np.inf).max(axis=-1)
    centre = (lower + upper) / 2
    square = np.sum((blocks - centre[:, :, None]) ** 2, axis=1)
    radius = np.sqrt(np.where(is_filled[:, 0], square, 0.0).max(axis=-1)) + 1e-6  # as much as rounding may take
    balls = np.zeros((-(-len(blocks) // BLOCK), BLOCK, 4), dtype=np.float32)
    balls.reshape(-1, 4)[: len(blocks)] = np.hstack([centre, radius[:, None]])
    return np.ascontiguousarray(np.swapaxes(balls, 1, 2))


def scatter(blocks: Float[np.ndarray, "m 3 b"]) -> Float[np.ndarray, "m 3 b"]:
    """The blocks in an order of which any first few are spread over all of them."""
    return blocks[np.argsort(np.arange(len(blocks)) * GOLDEN_RATIO % 1.0)]


def in_block_order(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Points in the order of the voxels that they lie in, every second layer and row of voxels backwards: neighbours
    follow each other."""
    if len(points) == 0:
        return points
    lower, upper = bounds(points)
    longest = float((upper - lower).max())
    edge = max(NEIGHBOURHOOD, longest / 31)  # 32 voxels along each axis at most: the code has 15 bits
    i, j, k = ((points - lower).T / edge).astype(np.uint16)
    j = np.where(i % 2, 31 - j, j)
    k = np.where(j % 2, 31 - k, k)
    return points[np.argsort((i * 32 + j) * 32 + k, kind="stable")]


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
    field.coordinates = wp.array(points.T.ravel(), dtype=wp.float32, device=device)
    u = np.vstack([(points - origin) / spacing, np.full((1, 3), FAR / spacing)])
    cloud = [field.dims, len(u), wp.array(u.T.ravel(), dtype=wp.float32, device=device)]
    before = wp.array(_seed_nodes(points, origin, shape, spacing), dtype=wp.int32, device=device)
    after, square = wp.empty_like(before), wp.empty_like(before)
    rows = shape[0] * shape[1]
    launch(warp_fields.sweep_along, rows, [*cloud, before], [after, square], device)
    for axis in sorted((0, 1), key=lambda axis: shape[axis]):  # rows begin empty, and empty rows look far
        launch(warp_fields.sweep_across, rows, [axis, *cloud, after], [before, square], device)
        before, after = after, before
    field.index = before
    launch(warp_fields.refine_nearest, rows, [*cloud, after], [field.index, square], device)
    return field


def covering_nearest_field(
    points: Float[np.ndarray, "n 3"], spacing: float, margin: float, device: str
) -> warp_fields.NearestField:
    """The nearest-neighbour field of a cloud on a grid that reaches `margin` [m] beyond it.

    Nodes are the centres of the cells of `voxel_downsample`, so a cloud thinned at this spacing has one point a node.
    """
    lower, upper = bounds(points)
    lower, upper = lower - margin, upper + margin
    origin = (np.floor(lower / spacing) + 0.5) * spacing
    counts = np.maximum(np.ceil((upper - origin) / spacing).astype(int) + 1, 2)
    return nearest_field(points, origin, (int(counts[0]), int(counts[1]), int(counts[2])), spacing, device)


def _seed_nodes(
    points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, "3"], shape: tuple[int, int, int], spacing: float
) -> Int[np.ndarray, "m"]:
    """For each node the point rounded to it, the nearest where several are, one past the last where none is."""
    u = (points - origin) / spacing
    node = np.clip(np.rint(u).astype(int), 0, np.array(shape) - 1)
    order = np.argsort(-np.sum((u - node) ** 2, axis=-1), kind="stable")
    seed = np.full(int(np.prod(shape)), len(points), dtype=np.int32)
    seed[np.ravel_multi_index(tuple(node[order].T), shape)] = order
    return seed
