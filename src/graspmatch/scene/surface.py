"""From raw points or triangles to the surface that the planner matches: usable, free of specks, evenly dense."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from graspmatch.geometry import cloud
from graspmatch.geometry.mesh import TriangleMesh, face_normals_areas, sample_surface
from graspmatch.types import GraspmatchError, PointCloud

Array = np.ndarray

SPACING = 0.0025
"""Distance between the points of a surface [m], on objects of 5 cm and more."""
SAMPLES_PER_CELL = 5
"""Surface samples per square of that spacing: enough to leave next to no holes."""
MOST_POINTS = 60_000
"""Above this many, the spacing grows."""
FEWEST_POINTS = 10
FARTHEST = 1000.0
"""Points this far from the middle of a cloud [m] are no measurements."""


def usable_points(
    points: object, normals: object, scale: float, name: str
) -> tuple[Float[Array, "m 3"], Float[Array, "m 3"] | None, tuple[str, ...]]:
    """The distinct points that are measurements [m], in an order that their values decide; and notes on the others.

    `scale` is the unit of the points in metres. A normal that is missing (zero or not finite) comes back as zero.
    """
    rows = scale * as_rows(points, name)
    directions = None if normals is None else as_rows(normals, f"the normals of {name}")
    if directions is not None and len(directions) != len(rows):
        raise GraspmatchError(f"{name} has {len(rows)} points but {len(directions)} normals; one each is needed.")
    with np.errstate(invalid="ignore"):  # of infinity minus infinity
        finite = np.flatnonzero(np.isfinite(rows @ np.ones(3)))  # the sum, since reducing many short rows is slow
    if len(finite) == 0:
        what = f"{len(rows)} points, all of them NaN or infinite" if len(rows) else "no points"
        raise GraspmatchError(f"{name} has {what}; at least {FEWEST_POINTS} usable ones are needed.")
    together = rows if directions is None else np.concatenate([rows, _unit_or_zero(directions)], axis=1)
    together = together[finite] if len(finite) < len(rows) else together
    distinct = np.take(together, cloud.distinct_rows(together), axis=0)
    middle = np.median(distinct[:10_000, :3], axis=0)
    near = np.all([np.abs(distinct[:, i] - middle[i]) < FARTHEST for i in range(3)], axis=0)
    usable = distinct if near.all() else distinct[near]
    if len(usable) < FEWEST_POINTS:
        found = f"only {len(usable)} usable of {len(rows)} points"
        raise GraspmatchError(f"{name} has {found}; at least {FEWEST_POINTS} are needed.")
    dropped = {
        "not finite": len(rows) - len(finite),
        "repeated": len(finite) - len(distinct),
        "over a kilometre away": len(distinct) - len(usable),
    }
    notes = tuple(f"{count} of {len(rows)} points were {why} and dropped." for why, count in dropped.items() if count)
    return usable[:, :3], None if directions is None else usable[:, 3:], notes


def as_rows(values: object, name: str) -> Float[Array, "n 3"]:
    """An array of three columns as float64, of zero rows if it is empty."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise GraspmatchError(f"{name} must be an array of numbers of shape (n, 3).") from error
    if array.size == 0:
        return np.zeros((0, 3))
    if array.ndim != 2 or array.shape[1] != 3:
        hint = "; reshape(-1, 3) makes one of an organised cloud" if array.shape[-1:] == (3,) and array.ndim > 2 else ""
        raise GraspmatchError(f"{name} has shape {array.shape}; (n, 3) is needed{hint}.")
    return array


def typical_extent(points: Float[Array, "n 3"]) -> Float[Array, "3"]:
    """Sides of the box [m] that holds the middle 98 % of the points, on a sample of them: specks do not count.

    The points must be in no particular order, as `usable_points` leaves them.
    """
    low, high = np.percentile(points[:10_000], [1, 99], axis=0)
    return high - low


def cloud_surface(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"] | None, sensor_origin: Float[Array, "3"] | None
) -> tuple[PointCloud, Float[Array, "k 3"], float, tuple[str, ...]]:
    """The surface, the points that are no specks, its spacing [m], and a note on the specks."""
    centroids, directions, inverse, spacing = _thin(points, normals, _fine_spacing(points))
    distances, index = cloud.nearest(centroids, 12)
    speck = cloud.isolated(distances, index)
    notes: tuple[str, ...] = ()
    if speck.any():
        notes = (f"{np.count_nonzero(speck[inverse])} of {len(points)} points were isolated specks and dropped.",)
        centroids, directions = centroids[~speck], None if directions is None else directions[~speck]
        _, index = cloud.nearest(centroids, 12)
    kept = points[~speck[inverse]] if speck.any() else points
    if directions is None or not directions.any():
        directions = cloud.estimate_normals(centroids, index, sensor_origin=sensor_origin)
    else:
        directions = _filled(centroids, directions)
    return PointCloud(centroids, directions), kept, spacing, notes


def thin_obstacles(points: Float[Array, "n 3"], spacing: float) -> Float[Array, "m 3"]:
    """Finite points at the given spacing [m]; specks stay, since an obstacle may be thin."""
    points = points[np.isfinite(points).all(axis=1)]
    return cloud.voxel_downsample(points[cloud.distinct_rows(points)], spacing)[0]


def clean_mesh(mesh: TriangleMesh, name: str) -> tuple[TriangleMesh, Float[Array, "f"], tuple[str, ...]]:
    """Equal vertices merged, faces that are not finite dropped, the outside out; areas [m2]; notes on what was done."""
    import trimesh

    vertices, faces = as_rows(mesh.vertices, f"the vertices of {name}"), np.asarray(mesh.faces)
    if faces.size == 0:
        raise GraspmatchError(f"{name} has no faces.")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.min() < 0 or faces.max() >= len(vertices):
        raise GraspmatchError(f"{name}: faces must be (f, 3) indices of its {len(vertices)} vertices.")
    good = np.isfinite(vertices[faces]).all(axis=(1, 2))
    merged = trimesh.Trimesh(vertices, faces[good], process=True)
    mesh = TriangleMesh(np.array(merged.vertices, dtype=np.float64), np.array(merged.faces, dtype=np.int64))
    normals, areas = face_normals_areas(mesh)
    if not areas.sum() > 0:
        raise GraspmatchError(f"{name} has no face with an area.")
    notes = () if good.all() else (f"{np.count_nonzero(~good)} faces with corners that were not finite were dropped.",)
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    if areas @ np.einsum("ni,ni->n", normals, centres - areas @ centres / areas.sum()) < 0:
        mesh = TriangleMesh(mesh.vertices, mesh.faces[:, ::-1].copy())
        notes += ("The faces were inside out and were turned over.",)
    return mesh, areas, notes


def mesh_surface(mesh: TriangleMesh, areas: Float[Array, "f"]) -> tuple[PointCloud, float]:
    """The surface of a mesh as a cloud, and its spacing [m]; the two sides of a sheet stay apart."""
    spacing = _fine_spacing(mesh.vertices[np.unique(mesh.faces)])
    spacing = max(spacing, float(np.sqrt(1.5 * areas.sum() / MOST_POINTS)))
    points, normals = sample_surface(mesh, SAMPLES_PER_CELL / spacing**2, np.random.default_rng(0))
    centroids, directions, _, spacing = _thin(points, normals, spacing)
    assert directions is not None
    return PointCloud(centroids, directions), spacing


def mesh_centre(mesh: TriangleMesh, areas: Float[Array, "f"]) -> Float[Array, "3"]:
    """Centroid [m] of the volume where the mesh is watertight and has one, of the surface otherwise."""
    import trimesh

    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if solid.is_watertight and solid.volume > 0:
        centre = np.array(solid.center_mass)
        if (centre > mesh.vertices.min(axis=0)).all() and (centre < mesh.vertices.max(axis=0)).all():
            return centre
    return areas @ mesh.vertices[mesh.faces].mean(axis=1) / areas.sum()


def _fine_spacing(points: Float[Array, "n 3"]) -> float:
    """A twentieth of the object [m], at most 2.5 mm."""
    return min(SPACING, cloud.extent(points) / 20)


def _thin(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"] | None, spacing: float
) -> tuple[Float[Array, "m 3"], Float[Array, "m 3"] | None, Int[Array, "n"], float]:
    """Centroids, mean unit normals, each point's centroid, and the spacing that keeps them below the limit."""
    labels = None if normals is None else cloud.normal_sector(normals)
    centroids, inverse = cloud.voxel_downsample(points, spacing, labels=labels)
    while len(centroids) > MOST_POINTS:
        spacing *= 1.05 * np.sqrt(len(centroids) / MOST_POINTS)
        centroids, inverse = cloud.voxel_downsample(points, spacing, labels=labels)
    if normals is None:
        return centroids, None, inverse, float(spacing)
    return centroids, _unit_or_zero(cloud.voxel_means(normals, inverse, len(centroids))), inverse, float(spacing)


def _unit_or_zero(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Unit vectors; zero where there is no direction."""
    length = np.sqrt(np.square(vectors) @ np.ones((3, 1)))
    has_direction = np.isfinite(length) & (length > 1e-6)
    return np.where(has_direction, vectors / np.where(has_direction, length, 1.0), 0.0)


def _filled(points: Float[Array, "n 3"], normals: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Normals, where one is zero that of the nearest point which has one."""
    from scipy.spatial import KDTree

    known = normals.any(axis=1)
    if known.all():
        return normals
    _, index = KDTree(points[known]).query(points)
    return normals[known][index]
