"""Point clouds as plain arrays: thinning, specks, normals, hulls; results do not depend on the order of the input."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from graspmatch.geometry.sphere import fibonacci_directions

Array = np.ndarray

GRID_SHIFT = 0.382
"""How far before the lowest point the voxel grid begins, in voxels: clouds sampled on a grid of their own would lie
exactly on the borders of a grid that begins at the point, and rounding would decide on which side."""

UNSURE = 1e-6
"""The two least eigenvalues are one where the axis, relative to the spread of all three, is told by less than this."""

WIDTH_DIRECTIONS = 1000
"""In which corners are looked for to tell a width by: a ball of 180 mm comes out half a millimetre too narrow."""


def distinct_rows(rows: Float[Array, "n c"]) -> Int[Array, "m"]:
    """Indices of one copy of each row, in an order that depends on the values of the rows only."""
    code = np.zeros(len(rows), dtype=np.uint64)
    for column in np.ascontiguousarray(rows.T, dtype=np.float64):
        code ^= (column + 0.0).view(np.uint64)  # + 0.0, since -0.0 and 0.0 differ in their bits
        code *= np.uint64(0x9E3779B97F4A7C15)
        code ^= code >> np.uint64(29)
    order = np.argsort(code)
    code = code[order]
    same = np.flatnonzero(code[1:] == code[:-1])
    same = same[(rows[order[same]] == rows[order[same + 1]]).all(axis=1)]
    return np.delete(order, same + 1) if len(same) else order


def voxel_downsample(
    points: Float[Array, "n 3"],
    spacing: float,
    *,
    origin: Float[Array, "3"] | None = None,
    labels: Int[Array, "n"] | None = None,
) -> tuple[Float[Array, "m 3"], Int[Array, "n"]]:
    """The centroid of the points in each voxel of edge `spacing` [m], and for each point the row of its voxel.

    `origin` is a corner of voxels [m]; without it the grid begins at the lowest corner of the cloud, so it moves with
    the cloud. Points of different non-negative `labels` never share a voxel. The result is ordered by voxel.
    """
    if len(points) == 0:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    count, inverse = _voxels(points, spacing, origin, labels)
    return voxel_means(points, inverse, count), inverse


def bounds(points: Float[Array, "n 3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Least and largest coordinates of a cloud of one point at least; NumPy takes twenty times as long on rows of
    three as on columns."""
    columns = np.ascontiguousarray(points.T)
    return columns.min(axis=1), columns.max(axis=1)


def extent(points: Float[Array, "n 3"]) -> float:
    """Longest side of the upright box around a cloud of one point at least."""
    low, high = bounds(points)
    return float((high - low).max())


def first_of_voxels(
    points: Float[Array, "n 3"], spacing: float, *, labels: Int[Array, "n"] | None = None
) -> Int[Array, "m"]:
    """Index of the first point of each voxel of `voxel_downsample`."""
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    count, inverse = _voxels(points, spacing, None, labels)
    first = np.empty(count, dtype=np.int64)
    first[inverse[::-1]] = np.arange(len(points))[::-1]  # of those of one voxel the last that is written stays
    return first


def _voxels(
    points: Float[Array, "n 3"], spacing: float, origin: Float[Array, "3"] | None, labels: Int[Array, "n"] | None
) -> tuple[int, Int[Array, "n"]]:
    """How many voxels there are, and for each point the row of its voxel."""
    key = np.zeros(len(points), dtype=np.int64)
    for axis, column in enumerate(np.ascontiguousarray(points.T, dtype=np.float64)):
        start = column.min() - GRID_SHIFT * spacing if origin is None else origin[axis]
        index = np.floor((column - start) / spacing).astype(np.int64)
        index -= index.min()
        key *= index.max() + 1
        key += index
    if labels is not None:
        key = key * (labels.max() + 1) + labels
    return _ranks(key)


def _ranks(keys: Int[Array, "n"]) -> tuple[int, Int[Array, "n"]]:
    """How many distinct keys (0 or more) there are, and the place of each key among them; by a table where it is not
    much longer than the keys, which takes a tenth of the time that sorting does."""
    if keys.max() >= 32 * len(keys):
        distinct, inverse = np.unique(keys, return_inverse=True)
        return len(distinct), inverse
    is_there = np.zeros(keys.max() + 1, dtype=bool)
    is_there[keys] = True
    place = np.cumsum(is_there) - 1
    return int(place[-1]) + 1, place[keys]


def voxel_means(values: Shaped[Array, "n c"], inverse: Int[Array, "n"], count: int) -> Float[Array, "m c"]:
    """Mean of the values in each of `count` voxels, by the inverse that `voxel_downsample` returns."""
    sums = [np.bincount(inverse, weights=column, minlength=count) for column in values.T]
    return np.stack(sums, axis=-1) / np.bincount(inverse, minlength=count)[:, None]


def farthest_along(directions: Float[Array, "k 3"], points: Float[Array, "n 3"]) -> Int[Array, "m"]:
    """The points that go farthest along some directions, each once. A few directions at a time stay in a cache."""
    columns = np.ascontiguousarray(points.T, dtype=np.float32)
    few = np.array_split(directions.astype(np.float32), -(-len(directions) // 8))
    return np.unique(np.concatenate([np.argmax(some @ columns, axis=1) for some in few]))


def normal_sector(normals: Float[Array, "n 3"]) -> Int[Array, "n"]:
    """Which of six directions (0 to 5) each normal is closest to: as labels, they keep the sides of a sheet apart.

    The six are the faces of a cube that stands askew, so that the right angles and the bevels of made things do not
    lie on the border between two sectors.
    """
    askew = np.array([[2.0, 3.0, 6.0], [3.0, -6.0, 2.0], [6.0, 2.0, -3.0]]) / 7
    along = normals @ askew
    axis = np.argmax(np.abs(along), axis=1)
    return 2 * axis + (along[np.arange(len(along)), axis] < 0)


def nearest(points: Float[Array, "n 3"], k: int) -> tuple[Float[Array, "n k"], Int[Array, "n k"]]:
    """Distances [m] and indices of the k nearest points of each point, itself first; all of them if there are fewer."""
    from scipy.spatial import KDTree

    distances, index = KDTree(points).query(points, min(k, len(points)), workers=-1)
    shape = (len(points), -1)
    return np.reshape(distances, shape), np.reshape(index, shape)


def isolated(distances: Float[Array, "n k"], index: Int[Array, "n k"]) -> Bool[Array, "n"]:
    """Which points are specks, judged by their `nearest`: far from everything, by two measures.

    A speck's distance to its sixth neighbour is above five times the cloud's median and above two and a half times the
    median of those six. The second test spares parts that are sparse or thin throughout, such as a wire; lone points
    near a dense part remain specks.
    """
    if index.shape[1] < 7:
        return np.zeros(len(index), dtype=bool)
    reach = distances[:, 6]
    far = reach > 5 * np.median(reach)
    far[far] = reach[far] > 2.5 * np.median(reach[index[far, 1:7]], axis=1)
    return far


def estimate_normals(
    points: Float[Array, "n 3"], index: Int[Array, "n k"], *, sensor_origin: Float[Array, "3"] | None = None
) -> Float[Array, "n 3"]:
    """Unit normals from the principal axes of each point's neighbours, towards the sensor where it is known.

    Without a sensor, the signs are spread over the surface and each connected part is turned away from the centre of
    the cloud. That is right for the surface of a closed object seen from all round. It is a guess for the view of one
    side only (the inside of a bowl comes out as if it were the outside), and it fails where the two sides of a sheet
    are closer to each other than neighbouring points are.
    """
    local = points[index]
    local = local - local.mean(axis=1, keepdims=True)
    _, normals = least_axis(np.swapaxes(local, 1, 2) @ local)
    if sensor_origin is None:
        return normals * outward_signs(points, normals, index[:, :8])[:, None]
    return np.where(_dot(sensor_origin - points, normals)[:, None] < 0, -normals, normals)


def least_axis(symmetric: Float[Array, "n 3 3"]) -> tuple[Float[Array, "n"], Float[Array, "n 3"]]:
    """The least eigenvalue of symmetric matrices, and a unit vector along its axis: in closed form, which takes a fifth
    of the time of `numpy.linalg.eigh` (Smith 1961, Eigenvalues of a symmetric 3 x 3 matrix).

    The axis is perpendicular to the rows of A - lambda I: their longest cross product. Where two eigenvalues are the
    least there is no such axis, and `eigh` chooses one.
    """
    trace = np.trace(symmetric, axis1=1, axis2=2)
    deviator = symmetric - (trace / 3)[:, None, None] * np.eye(3)
    scale = np.sqrt(np.einsum("nij,nij->n", deviator, deviator) / 6)
    third = _determinant(deviator) / np.maximum(2 * scale**3, 1e-300)
    value = trace / 3 + 2 * scale * np.cos(np.arccos(np.clip(third, -1.0, 1.0)) / 3 + 2 * np.pi / 3)
    rows = symmetric - value[:, None, None] * np.eye(3)
    normals = np.cross(rows, np.roll(rows, -1, axis=1))
    square = np.einsum("nij,nij->ni", normals, normals)
    longest = np.argmax(square, axis=1)
    every = np.arange(len(symmetric))
    length = np.sqrt(square[every, longest])
    axis = normals[every, longest] / np.maximum(length, 1e-300)[:, None]
    unsure = length <= UNSURE * scale**2
    if unsure.any():
        value[unsure], axis[unsure] = (part[..., 0] for part in np.linalg.eigh(symmetric[unsure]))
    return value, axis


def _determinant(m: Float[Array, "n 3 3"]) -> Float[Array, "n"]:
    return np.einsum("ni,ni->n", m[:, 0], np.cross(m[:, 1], m[:, 2]))


def outward_signs(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], index: Int[Array, "n k"]
) -> Float[Array, "n"]:
    """For each normal +1 or -1, such that together they point out (Hoppe et al. 1992, with a vote for each part).

    The sign spreads along a spanning tree over the neighbours `index` that prefers parallel normals and steps along
    the surface, so it goes round the rim of a plate rather than through it. For a closed surface the sum of
    normal . (point - centre) is three times its volume, so its sign says whether a part has to be turned over.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

    n = len(points)
    a, b = np.repeat(np.arange(n), index.shape[1] - 1), index[:, 1:].ravel()
    step = points[b] - points[a]
    bend = 1 - np.abs(_dot(normals[a], normals[b]))
    climb = np.abs(_dot(step, normals[a])) + np.abs(_dot(step, normals[b]))
    cost = 1e-3 + bend + climb / np.sqrt(_dot(step, step))  # never zero, which a sparse graph reads as no edge
    tree = minimum_spanning_tree(coo_matrix((cost, (a, b)), shape=(n, n)).tocsr())
    _, part = connected_components(tree, directed=False)
    signs = _spread_signs(tree, part, normals)

    low, high = bounds(points)
    upward = np.array([0.0, 0.0, 1e-3 * (high - low).max()])  # a flat sheet, which has no outside, faces up
    away = points - (low + high) / 2 + upward
    votes = np.bincount(part, weights=signs * _dot(normals, away))
    return np.where(votes[part] < 0, -signs, signs)


def _spread_signs(tree, part: Int[Array, "n"], normals: Float[Array, "n 3"]) -> Float[Array, "n"]:
    """Signs that make every edge of the forest join normals less than a right angle apart; one in each part stays."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order

    n = len(part)
    edges = tree.tocoo()
    roots = np.unique(part, return_index=True)[1]  # one edge from an extra node to each makes the forest a tree
    row, col = np.append(edges.row, np.full(len(roots), n)), np.append(edges.col, roots)
    joined = coo_matrix((np.ones(len(row)), (row, col)), shape=(n + 1, n + 1)).tocsr()
    _, parent = breadth_first_order(joined, n, directed=False)
    parent[n] = n
    padded = np.append(normals, np.zeros((1, 3)), axis=0)
    signs = np.where(_dot(padded, padded[parent]) < 0, -1.0, 1.0)
    while (parent != n).any():  # the product of the signs on the way to the root, in doubling steps
        signs = signs * signs[parent]
        parent = parent[parent]
    return signs[:n]


def _dot(a: Float[Array, "n 3"], b: Float[Array, "n 3"]) -> Float[Array, "n"]:
    return np.einsum("ni,ni->n", a, b)


def narrowest_width(points: Float[np.ndarray, "n 3"]) -> float:
    """Distance of the two parallel planes nearest to one another with all points between them [m], one of them on a
    face of the convex hull; zero for points in a plane. Of round things with countless corners those that go farthest
    along some directions stand for all."""
    from scipy.spatial import ConvexHull, QhullError

    corners = points[farthest_along(fibonacci_directions(WIDTH_DIRECTIONS), points)]
    try:
        faces = ConvexHull(corners).equations[:, :3]
    except QhullError:
        return 0.0
    return float(np.ptp(corners @ faces.T, axis=0).min())


def hull_corners(points: Float[Array, "n 3"]) -> Float[Array, "m 3"]:
    """The corners of the convex hull, which a plane meets first; of what is flat or tiny all distinct points."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return np.unique(points, axis=0)
