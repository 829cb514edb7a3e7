"""Which points belong to one thing: linked ones, parted where the surface bends inwards sharply.

Things that touch meet in a concave crease (Stein et al. 2014, LCCP). So do a mug's wall and its bottom, or its handle:
a piece that lies within another's hull, or that is small and stands on nothing, is joined to its neighbour again. And
of a bowl the inside is seen apart from the outside: what is hollow is joined to what runs along its rim.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from graspmatch.geometry.cloud import least_axis
from graspmatch.scene.joining import Surface, joined
from graspmatch.types import Plane

Array = np.ndarray

NEIGHBOURS = 14
LINK = 2.2
"""Points nearer than so many spacings are linked: the diagonal of a cell and a little more."""
SMOOTH = 0.22
"""Points whose neighbours are off a plane by less than so many spacings lie on a facet. On a cup it is 0.1, at an edge
or crease of 90 degrees 0.35."""
MOSTLY = 0.6
"""The share of smooth neighbours of a point within a facet."""
CREASE = 0.08
"""Mean turn of the normals along the seam of two facets above which they are of two things. In a crease of 90 degrees
it is 0.3, in a bowl 0.1, where there is no seam; at an edge it is negative."""
SEAM = 20
"""Fewer links than this, both ways counted, are a few stray points between two things."""
STEP = 1.8
"""Over a seam only points nearer than so many spacings are linked, so that none is stepped over."""
FEWEST_OF_PIECE = 12
MOST_ROUNDS = 4


@dataclass(frozen=True)
class Neighbourhood:
    """The nearest points of each point, the first of which is itself."""

    index: Int[Array, "n k"]
    distance: Float[Array, "n k"]
    """[m]"""
    is_linked: Bool[Array, "n k"]


def pieces(
    points: Float[Array, "n 3"], table: Plane, spacing: float, origin: Float[Array, "3"] | None
) -> Int[Array, "n"]:
    """For each of evenly spaced points (`spacing` [m]) the number of its thing, the largest first; -1 for specks.

    Without the camera's position no creases are sought, since which way a normal points then decides between a crease
    and an edge.
    """
    if len(points) < FEWEST_OF_PIECE:
        return np.full(len(points), -1)
    around = _neighbourhood(points, spacing)
    label, bend = _connected(around, np.ones(len(points), dtype=bool)), np.zeros(len(points))
    if origin is not None:
        bend, roughness = surface_around(points, around, origin)
        label = _parted(points, around, label, bend, roughness < SMOOTH * spacing, spacing)
    label = _without_specks(label)
    surface = Surface(points, table.normal, points @ table.normal - table.offset, bend, _links(around))
    for _ in range(MOST_ROUNDS):  # what is joined is the host of more
        fewer = _without_specks(joined(surface, label))
        if fewer.max(initial=-1) == label.max(initial=-1):
            break
        label = fewer
    return label


def linked_parts(points: Float[Array, "n 3"], spacing: float) -> Int[Array, "n"]:
    """The number of the connected part of each of evenly spaced points (`spacing` [m])."""
    return _connected(_neighbourhood(points, spacing), np.ones(len(points), dtype=bool))


def surface_around(
    points: Float[Array, "n 3"], around: Neighbourhood, origin: Float[Array, "3"]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """How much the normals around each point turn towards each other, and how far its neighbours are off a plane [m].

    The turn is in radians about: positive in a crease, negative at an edge, near zero elsewhere.
    """
    is_linked = around.is_linked[:, :, None].astype(np.float32)
    count = around.is_linked.sum(axis=1)
    centred = (points - points.mean(axis=0)).astype(np.float32)  # half as much to move
    step = (centred[around.index] - centred[:, None]) * is_linked
    local = (step - step.sum(axis=1, keepdims=True) / count[:, None, None].astype(np.float32)) * is_linked
    least, normals = least_axis((np.swapaxes(local, 1, 2) @ local).astype(np.float64))
    normals = normals * np.where(np.einsum("ni,ni->n", origin - points, normals) < 0, -1.0, 1.0)[:, None]
    single = normals.astype(np.float32)
    turn = single[around.index] - single[:, None]
    weight = around.is_linked / np.maximum(np.linalg.norm(step, axis=-1), 1e-9)
    inwards = -np.einsum("nkc,nkc->nk", turn, step) * weight
    return inwards.sum(axis=1) / np.maximum(count - 1, 1), np.sqrt(np.maximum(least, 0) / count)


def _neighbourhood(points: Float[Array, "n 3"], spacing: float) -> Neighbourhood:
    from scipy.spatial import KDTree

    count = min(NEIGHBOURS, len(points))
    distances, index = KDTree(points).query(points, count, distance_upper_bound=LINK * spacing, workers=-1)
    linked = np.isfinite(distances)
    return Neighbourhood(np.where(linked, index, np.arange(len(points))[:, None]), distances, linked)


def _connected(around: Neighbourhood, is_node: Bool[Array, "n"]) -> Int[Array, "n"]:
    """The connected part of each point over links between nodes; others are alone."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = _links(around)
    both = is_node[a] & is_node[b]
    n = len(is_node)
    graph = coo_matrix((np.ones(np.count_nonzero(both), dtype=np.int8), (a[both], b[both])), shape=(n, n))
    return connected_components(graph, directed=False)[1]


def _links(around: Neighbourhood) -> tuple[Int[Array, "e"], Int[Array, "e"]]:
    rows, columns = np.nonzero(around.is_linked[:, 1:])
    return rows, around.index[rows, columns + 1]


def _parted(
    points: Float[Array, "n 3"],
    around: Neighbourhood,
    cluster: Int[Array, "n"],
    bend: Float[Array, "n"],
    is_smooth: Bool[Array, "n"],
    spacing: float,
) -> Int[Array, "n"]:
    """Clusters cut at their creases: smooth facets, joined again where they meet in an edge and not in a crease."""
    close = replace(around, is_linked=around.is_linked & (around.distance < STEP * spacing))
    smooth_around = (is_smooth[around.index] & around.is_linked).sum(axis=1) / around.is_linked.sum(axis=1)
    is_smooth = is_smooth & (smooth_around > MOSTLY)  # one point that is taken for smooth would bridge a crease
    facet = _spread(points, cluster, _connected(close, is_smooth), is_smooth)
    a, b = _links(close)
    meet = facet[a] != facet[b]
    a, b = a[meet], b[meet]
    count = int(facet.max()) + 1
    code = facet[a] * count + facet[b]
    turns = np.bincount(code, weights=bend[a] + bend[b], minlength=count**2).reshape(count, count) / 2
    links = np.bincount(code, minlength=count**2).reshape(count, count).astype(float)
    return _merged_at_edges(turns + turns.T, links + links.T)[facet]


def _merged_at_edges(turns: Float[Array, "f f"], links: Float[Array, "f f"]) -> Int[Array, "f"]:
    """The thing of each facet: the two whose common seam is the sharpest edge are joined first, and their seams added.

    `turns` is the sum of the turns along each seam, `links` how long it is. So a few points where a lid touches another
    thing do not outvote the crease along their walls.
    """
    thing = np.arange(len(turns))
    while True:
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.where(links >= SEAM, turns / links, np.inf)
        kept, gone = np.unravel_index(np.argmin(mean), mean.shape) if mean.size else (0, 0)
        if not mean.size or mean[kept, gone] >= CREASE:
            return thing
        for table in (turns, links):
            table[kept] += table[gone]
            table[:, kept] += table[:, gone]
            table[gone] = table[:, gone] = table[kept, kept] = 0
        thing[thing == gone] = kept


def _spread(
    points: Float[Array, "n 3"], cluster: Int[Array, "n"], part: Int[Array, "n"], is_smooth: Bool[Array, "n"]
) -> Int[Array, "n"]:
    """Parts of smooth points of some size, and all other points with the nearest of them in their cluster."""
    from scipy.spatial import KDTree

    is_core = is_smooth & (np.bincount(part)[part] >= FEWEST_OF_PIECE)
    facet = part.max() + 1 + cluster  # where a cluster has no smooth part at all
    if is_core.any():
        # Clusters are moved far apart, so that the nearest is one of the same cluster where that has any.
        apart = np.column_stack([points, 100.0 * cluster])
        distance, nearest = KDTree(apart[is_core]).query(apart[~is_core], workers=-1)
        facet[is_core] = part[is_core]
        facet[~is_core] = np.where(distance < 50.0, part[is_core][nearest], facet[~is_core])
    return np.unique(facet, return_inverse=True)[1]


def _without_specks(label: Int[Array, "n"]) -> Int[Array, "n"]:
    """Labels 0, 1, ... by falling size, -1 for what is too small; what is -1 stays so."""
    _, inverse, counts = np.unique(label, return_inverse=True, return_counts=True)
    gone = (counts < FEWEST_OF_PIECE) | (np.bincount(inverse, weights=label < 0) > 0)
    order = np.lexsort((np.arange(len(counts)), -counts, gone))
    rank = np.empty(len(counts), dtype=np.int64)
    rank[order] = np.arange(len(counts))
    return np.where(gone[inverse], -1, rank[inverse])
