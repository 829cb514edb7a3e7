"""The far side of an object that was seen from one side, guessed without learning from what household objects are like.

Four guesses, wherever the sensor did not see free space. Extrusion: what is seen goes down to the table. Half turn: at
each height an object is the same when turned by half a turn about its middle, as boxes and bottles are. Circle: where
its front is round, that middle is the circle's. Ridge: what falls behind its top as it rises before it goes on so down
to the table, as a bottle that lies. They fill voxels in a frame whose x runs across the view, y away from the sensor
and z up.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from graspmatch.geometry.cloud import bounds
from graspmatch.scene.sight import SightLines
from graspmatch.scene.slices import LEVELS, Slice, back_of, ridge_of, slice_of
from graspmatch.types import Plane, PointCloud

Array = np.ndarray

Guess = Literal["extrusion", "half turn", "circle", "ridge"]
GUESSES: tuple[Guess, ...] = ("extrusion", "half turn", "circle", "ridge")
FINEST, COARSEST, CELLS = 0.0025, 0.006, 20
"""Edge of a voxel [m], and how many go along the side of a cube as large as what was seen."""
AWAY = 0.005
"""Guesses nearer than this to a point that was seen are none [m]."""
DOUBT = 0.01
"""How far the object may reach beyond its guessed far side [m]."""
EDGE = 0.005
"""Places nearer than this to what was seen to be free [m] are not in doubt: edges are seen a little aside."""
EVERY = 4
"""One in so many of the places in doubt is kept: they lie so close that a hand meets many."""
MARGIN = 3
"""Around the voxels, so that smoothing sees their outside [voxels]."""
SMOOTHING = 1.2
"""Normals are the slope of the voxels smoothed so far [voxels]."""
FEWEST = 8
"""Points of the least that is a shape."""


@dataclass(frozen=True)
class Completion:
    """What is guessed of an object, in the world."""

    guessed: PointCloud
    """Its unseen surface with outward normals; nothing of its underside."""
    centre_of_mass: Float[Array, "3"]
    """Of a solid of one density with the guessed back [m]."""
    doubtful: Float[Array, "k 3"]
    """Places beside it that nobody saw: it may reach farther than was guessed [m]."""


@dataclass(frozen=True)
class Voxels:
    """A grid over the object and the space behind it."""

    R_world_grid: Float[Array, "3 3"]
    low: Float[Array, "3"]
    """Corner [m], grid frame."""
    spacing: float
    shape: tuple[int, int, int]

    @property
    def axes(self) -> tuple[Float[Array, "x"], Float[Array, "y"], Float[Array, "z"]]:
        """Middles of the voxels along each axis [m], grid frame."""
        x, y, z = (low + (np.arange(n) + 0.5) * self.spacing for low, n in zip(self.low, self.shape, strict=True))
        return x, y, z

    def index(self, points_grid: Float[Array, "n 3"]) -> Int[Array, "n 3"]:
        """The voxel of each point."""
        return np.floor((points_grid - self.low) / self.spacing).astype(int)

    def all_centres(self) -> Float[Array, "x y z 3"]:
        """Of all voxels, in the world."""
        x, y, z = (middles[:, None] * way for middles, way in zip(self.axes, self.R_world_grid.T, strict=True))
        return x[:, None, None] + (y[:, None] + z)

    def centres(self, index: Int[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Of voxels, in the world."""
        return (self.low + (index + 0.5) * self.spacing) @ self.R_world_grid.T


def far_side(
    seen: PointCloud,
    table: Plane,
    lines: SightLines,
    others: Float[Array, "m 3"] | None = None,
    *,
    guesses: Collection[Guess] = GUESSES,
) -> Completion | None:
    """The far side of an object, guessed; None where too little is seen of it.

    `others` are points of other things: what is nearer to them than to the object is not guessed to be of it.
    """
    if len(seen.points) < FEWEST:
        return None
    voxels = _voxels(seen.points, table, lines.origin, deep=1.0)
    points = seen.points @ voxels.R_world_grid
    surface, free = _surface_and_free(seen.points, lines, voxels)
    assert seen.normals is not None  # every scene estimates them
    normals = seen.normals @ voxels.R_world_grid
    solid = surface
    if "extrusion" in guesses:
        solid = solid | (_extruded(surface) & ~free)
    if "half turn" in guesses:
        solid = solid | (_backed(points, normals, voxels, with_circles="circle" in guesses) & ~free)
    if "ridge" in guesses:
        solid = solid | (_mirrored(points, normals, voxels) & ~free)
    solid = _in_one_piece(_nearest_to(seen.points, others, solid, voxels), free)
    hollow = solid & ~(_below_openings(surface, free) & ~surface)
    return Completion(
        guessed=_unseen_surface(_in_one_piece(hollow, free), seen.points, voxels),
        centre_of_mass=voxels.centres(np.argwhere(solid)).mean(axis=0),
        doubtful=_doubtful(solid, free, voxels),
    )


def hidden_part(
    points: Float[Array, "n 3"], table: Plane, lines: SightLines, target: Float[Array, "m 3"]
) -> Float[Array, "k 3"]:
    """What other things may have where nobody saw: below their points, down to the table, but for what is nearer to
    the target. The surface of it, without what is beside the points given."""
    if len(points) < FEWEST:
        return np.zeros((0, 3))
    voxels = _voxels(points, table, lines.origin, deep=0.0)
    surface, free = _surface_and_free(points, lines, voxels)
    solid = _nearest_to(points, target, surface | (_extruded(surface) & ~free), voxels)
    return voxels.centres(_unseen_voxels(solid, points, voxels))


def _surface_and_free(
    points: Float[Array, "n 3"], lines: SightLines, voxels: Voxels
) -> tuple[Bool[Array, "x y z"], Bool[Array, "x y z"]]:
    """The voxels that points lie in, and those that were seen to be free."""
    free = (lines.beyond(voxels.all_centres().reshape(-1, 3)) > voxels.spacing).reshape(voxels.shape)
    if voxels.shape[2] > 1:  # so near to the table that was seen beyond, the lowest cannot tell
        free[:, :, 0] |= free[:, :, 1]
    surface = np.zeros(voxels.shape, dtype=bool)
    surface[tuple(voxels.index(points @ voxels.R_world_grid).T)] = True
    return surface, free


def _voxels(points: Float[Array, "n 3"], table: Plane, origin: Float[Array, "3"], *, deep: float) -> Voxels:
    """Around points, and so much of their width more behind them."""
    up = table.normal
    away = points.mean(axis=0) - origin
    away = away - (away @ up) * up
    if np.linalg.norm(away) < 1e-3:  # seen straight from above: any direction will do
        away = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    away /= np.linalg.norm(away)
    R = np.stack([np.cross(away, up), away, up], axis=-1)
    low, high = bounds(points @ R)
    spacing = float(np.clip(np.cbrt(np.prod(np.maximum(high - low, FINEST))) / CELLS, FINEST, COARSEST))
    low, high = low - 3 * spacing, high + 3 * spacing
    high[1] += deep * (high[0] - low[0])
    low[2] = table.offset
    shape = np.ceil((np.maximum(high, low + spacing) - low) / spacing).astype(int)
    return Voxels(R, low, spacing, (int(shape[0]), int(shape[1]), int(shape[2])))


def _extruded(surface: Bool[Array, "x y z"]) -> Bool[Array, "x y z"]:
    """All below what was seen."""
    from scipy.ndimage import grey_closing

    height = surface.shape[2]
    top = np.where(surface.any(axis=2), height - 1 - np.argmax(surface[:, :, ::-1], axis=2), -1)
    return np.arange(height) <= grey_closing(top, 3)[:, :, None]


def _backed(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], voxels: Voxels, *, with_circles: bool
) -> Bool[Array, "x y z"]:
    """Between the front that was seen at each height and the back that it suggests."""
    filled = np.zeros(voxels.shape, dtype=bool)
    _, depth, heights = voxels.axes
    slices: list[Slice] = []
    for level, height in enumerate(heights):
        slices += slice_of(points, normals, level, height, voxels.low[0], voxels.spacing)
    if not with_circles:
        slices = [replace(each, circle=None) for each in slices]
    for each in slices:
        front, back = each.front[:, None] - voxels.spacing / 2, back_of(each, slices)[:, None]
        filled[each.first : each.first + len(front), :, each.level] |= (depth >= front) & (depth <= back)
    return filled


def _mirrored(points: Float[Array, "n 3"], normals: Float[Array, "n 3"], voxels: Voxels) -> Bool[Array, "x y z"]:
    """Between the front of each upright slice that has a ridge, and that front mirrored at it."""
    filled = np.zeros(voxels.shape, dtype=bool)
    across, depth, height = voxels.axes
    found = [ridge_of(points, normals, column, place, voxels.spacing) for column, place in enumerate(across)]
    ridges = [ridge for ridge in found if ridge is not None]
    for ridge in ridges:
        middle = float(np.median([other.depth for other in ridges if abs(other.column - ridge.column) <= LEVELS]))
        front = ridge.front_at(height)
        back = np.where(height < ridge.top, 2 * middle - front, -np.inf)
        filled[ridge.column] = (depth[:, None] >= front) & (depth[:, None] <= back)
    return filled


def _nearest_to(
    points: Float[Array, "n 3"], others: Float[Array, "m 3"] | None, solid: Bool[Array, "x y z"], voxels: Voxels
) -> Bool[Array, "x y z"]:
    """The voxels that are nearer to these points than to those of other things."""
    from graspmatch.kernels.fields import nearest_field  # takes a second to import, which clouds alone do not need

    if others is None or len(others) == 0:
        return solid
    both = np.concatenate([points, others]) @ voxels.R_world_grid
    index = np.argwhere(solid)
    low, high = index.min(axis=0), index.max(axis=0) + 2  # a field has two nodes along each axis at least
    shape = (int(high[0] - low[0]), int(high[1] - low[1]), int(high[2] - low[2]))
    field = nearest_field(both, voxels.low + (low + 0.5) * voxels.spacing, shape, voxels.spacing, "cpu")
    nearest = field.index.numpy().reshape(shape)[tuple((index - low).T)]
    result = np.zeros_like(solid)
    result[tuple(index[nearest < len(points)].T)] = True
    return result


def _in_one_piece(solid: Bool[Array, "x y z"], free: Bool[Array, "x y z"]) -> Bool[Array, "x y z"]:
    """The largest piece, gaps of a voxel closed."""
    from scipy.ndimage import binary_closing, label

    closed = np.asarray(binary_closing(np.pad(solid, 2)))[2:-2, 2:-2, 2:-2]
    solid = solid | (closed & ~free)
    piece = np.zeros(solid.shape, dtype=np.int32)
    label(solid, output=piece)
    if piece.max() < 2:
        return solid
    return piece == 1 + np.argmax(np.bincount(piece.ravel())[1:])


def _doubtful(solid: Bool[Array, "x y z"], free: Bool[Array, "x y z"], voxels: Voxels) -> Float[Array, "k 3"]:
    """Hidden places next to a solid, but for those beside what was seen to be free."""
    from scipy.ndimage import binary_dilation

    near = np.asarray(binary_dilation(solid, iterations=max(round(DOUBT / voxels.spacing), 1)), dtype=bool)
    aside = np.asarray(binary_dilation(free, iterations=max(round(EDGE / voxels.spacing), 1)), dtype=bool)
    return voxels.centres(np.argwhere(near & ~solid & ~aside)[::EVERY])


def _below_openings(surface: Bool[Array, "x y z"], free: Bool[Array, "x y z"]) -> Bool[Array, "x y z"]:
    """Free space between a front and a back that were seen at the same height, as in a cup, and all below it down to
    the next thing that was seen: a lid, the bottom."""
    from scipy.ndimage import binary_dilation

    before = np.logical_or.accumulate(surface, axis=1)
    behind = np.logical_or.accumulate(surface[:, ::-1], axis=1)[:, ::-1]
    beside = np.asarray(binary_dilation(surface, structure=np.ones((1, 3, 3))), dtype=bool)
    opening = (before & behind & free & ~beside)[:, :, ::-1]  # from above
    floor = np.asarray(binary_dilation(surface, structure=np.ones((3, 3, 1))))[:, :, ::-1]
    step = np.arange(surface.shape[2])
    last_opening, last_floor = (np.maximum.accumulate(np.where(is_, step, -1), axis=2) for is_ in (opening, floor))
    return (last_opening > last_floor)[:, :, ::-1]


def _unseen_surface(solid: Bool[Array, "x y z"], seen: Float[Array, "n 3"], voxels: Voxels) -> PointCloud:
    """The outermost voxels that are not beside what was seen, and the slope of the solid there."""
    from scipy.ndimage import gaussian_filter

    index = _unseen_voxels(solid, seen, voxels)
    smooth = np.asarray(gaussian_filter(_on_table(solid).astype(np.float32), SMOOTHING))
    slope = np.moveaxis(np.array(np.gradient(smooth)), 0, -1)[tuple(index.T + MARGIN)]
    length = np.linalg.norm(slope, axis=-1)
    keep = length > 1e-3
    normals = -(slope[keep] / length[keep, None]) @ voxels.R_world_grid.T
    return PointCloud(voxels.centres(index[keep]), normals)


def _unseen_voxels(solid: Bool[Array, "x y z"], seen: Float[Array, "n 3"], voxels: Voxels) -> Int[Array, "k 3"]:
    """The outermost voxels that are not beside what was seen."""
    from scipy.ndimage import binary_erosion
    from scipy.spatial import KDTree

    padded = _on_table(solid)
    outermost = padded & ~np.asarray(binary_erosion(padded), dtype=bool)
    outermost[:, :, :MARGIN] = False
    index = np.argwhere(outermost) - MARGIN
    distance, _ = KDTree(seen).query(voxels.centres(index), distance_upper_bound=AWAY)  # infinite beyond that
    return index[distance > AWAY]


def _on_table(solid: Bool[Array, "x y z"]) -> Bool[Array, "x+6 y+6 z+6"]:
    """With a margin; what stands on the table has no underside."""
    padded = np.pad(solid, MARGIN)
    padded[:, :, :MARGIN] = padded[:, :, MARGIN : MARGIN + 1]
    return padded
