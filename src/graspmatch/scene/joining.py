"""Pieces of a cloud that are parts of one thing, joined: a mug's bottom, its handle, the two sides of its wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from graspmatch.geometry.cloud import extent

Array = np.ndarray

WITHIN = 0.85
"""Share of a piece that lies in the hull of another from which on it belongs to it."""
HULL_MARGIN = 0.008
"""[m]"""
STANDS = 0.02
"""A piece that comes this near to the table [m] stands on it."""
SCRAP, SMALL_PART, SMALL_SHARD = 0.08, 0.35, 0.25
"""Below this share of its neighbour, a piece is part of it: linked to it; so, and standing on nothing; near, and so."""
NEAR = 0.025
"""Shards that miss the link to their thing, by a hole in the data, are nearer to it than this [m]."""
HOLLOW = 0.02
"""Mean turn of the normals above which a piece is the inside of something, whose outside is seen before it."""
ALONG = 0.7
"""The share of the inside's width along which that outside runs."""


@dataclass(frozen=True)
class Surface:
    """Evenly spaced points, and what is known around each."""

    points: Float[Array, "n 3"]
    up: Float[Array, "3"]
    """Normal of the table."""
    heights: Float[Array, "n"]
    """Above the table [m]."""
    bend: Float[Array, "n"]
    """How much the normals around each point turn towards each other: positive in what is hollow."""
    links: tuple[Int[Array, "e"], Int[Array, "e"]]
    """Pairs of neighbours, both ways."""

    def is_hollow(self, part: Bool[Array, "n"]) -> bool:
        """Whether a part is the inside of something."""
        return float(self.bend[part].mean()) > HOLLOW


def joined(surface: Surface, label: Int[Array, "n"]) -> Int[Array, "n"]:
    """Labels, by falling size, with the pieces that are parts of a neighbour joined to it; small ones first."""
    a, b = surface.links
    label = label.copy()
    for piece in range(label.max(initial=-1), 0, -1):
        mine = label == piece
        linked = label[b[mine[a]]]
        neighbours, contacts = np.unique(linked[(linked >= 0) & (linked != piece)], return_counts=True)
        host = _linked_host(surface, label, mine, neighbours[np.argsort(-contacts)])
        host = _near_host(surface, label, mine) if host is None else host
        if host is not None:
            label[mine] = host
    return label


def _linked_host(
    surface: Surface, label: Int[Array, "n"], mine: Bool[Array, "n"], neighbours: Int[Array, "k"]
) -> int | None:
    """The linked neighbour that a piece is part of, or None; the one of most contact is asked first."""
    size = np.count_nonzero(mine)
    largest_share = SCRAP if _stands(surface, mine) else SMALL_PART
    for other in neighbours:
        theirs = label == other
        if size < largest_share * np.count_nonzero(theirs):
            return int(other)
        if surface.is_hollow(mine) and surface.is_hollow(theirs):  # wall and bottom of the same inside
            return int(other)
        if (
            np.count_nonzero(theirs) >= size
            and _share_within_hull(surface.points[mine], surface.points[theirs]) > WITHIN
        ):
            return int(other)
    return None


def _near_host(surface: Surface, label: Int[Array, "n"], mine: Bool[Array, "n"]) -> int | None:
    """The thing beside which a piece lies that is part of it: a shard of it, or the other side of its wall."""
    stands = _stands(surface, mine)
    for host in _labels_near(surface.points, label, mine):
        theirs = label == host
        if not stands and np.count_nonzero(mine) < SMALL_SHARD * np.count_nonzero(theirs):
            return host
        inside, outside = (mine, theirs) if surface.is_hollow(mine) else (theirs, mine)
        if surface.is_hollow(inside) and not surface.is_hollow(outside) and _lines(surface, inside, outside):
            return host
    return None


def _stands(surface: Surface, part: Bool[Array, "n"]) -> bool:
    return bool(np.percentile(surface.heights[part], 3) < STANDS)


def _labels_near(points: Float[Array, "n 3"], label: Int[Array, "n"], mine: Bool[Array, "n"]) -> list[int]:
    """Labels of what comes near a piece, the nearest first."""
    from scipy.spatial import KDTree

    others = (label >= 0) & ~mine
    if not others.any():
        return []
    distance, index = KDTree(points[others]).query(points[mine], distance_upper_bound=NEAR)
    is_near = np.isfinite(distance)
    hosts, which = np.unique(label[others][np.ravel(index)[is_near]], return_inverse=True)
    gaps = np.full(len(hosts), np.inf)
    np.minimum.at(gaps, which, distance[is_near])
    return [int(host) for host in hosts[np.argsort(gaps)]]


def _lines(surface: Surface, inside: Bool[Array, "n"], outside: Bool[Array, "n"]) -> bool:
    """Whether the outside runs along the inside of a hollow thing for most of its width over the table."""
    from scipy.spatial import KDTree

    distance, _ = KDTree(surface.points[outside]).query(surface.points[inside], distance_upper_bound=NEAR)
    over_table = surface.points[inside] - surface.heights[inside, None] * surface.up
    beside = over_table[np.isfinite(distance)]
    return len(beside) > 0 and bool(extent(beside) > ALONG * extent(over_table))


def _share_within_hull(inner: Float[Array, "n 3"], outer: Float[Array, "m 3"]) -> float:
    from scipy.spatial import ConvexHull, QhullError

    try:
        planes = ConvexHull(outer).equations
    except QhullError:  # flat: it holds nothing
        return 0.0
    return float(np.mean((inner @ planes[:, :3].T + planes[:, 3] < HULL_MARGIN).all(axis=1)))
