"""The inner surface S of a posture: what can be seen from between the fingers, no back and no interior.

The paper has two ways, and so has this file: samples of the mesh that are in view ("mesh"), and the points of virtual
depth cameras that look into the grasp ("camera").
"""

from __future__ import annotations

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from graspmatch.config import SampleMethod
from graspmatch.geometry.mesh import TriangleMesh, face_normals_areas, sample_surface
from graspmatch.geometry.sphere import fibonacci_directions
from graspmatch.kernels.launch import launch
from graspmatch.kernels.warp_bake import cast_rays
from graspmatch.types import GraspmatchError, PointCloud

CAMERA_HEIGHTS = (0.35, 0.6, 0.85)
"""Where the cameras stand, as fractions of the way from the palm to the tool centre point."""
PRECISE_VIEWS = (0.0, 0.2)
"""Where they stand in a precision posture, from its tool centre point back, in parts of its reach."""
CAMERA_RAYS = 4000
LATTICE_OFFSET = 0.317
"""In voxels: keeps faces at round numbers off the voxels' borders, where rounding would count them twice."""
LEAST_COSINE = 0.2
"""A surface turned further away from the camera than this is not seen."""


def inner_surface(
    mesh: TriangleMesh,
    approach: Float[np.ndarray, "3"],
    tool_centre_point: Float[np.ndarray, "3"],
    method: SampleMethod,
    voxel_size: float,
    *,
    reach: float = np.inf,
) -> PointCloud:
    """Samples of the inner surface of one posture, one in each voxel, with outward normals; gripper frame [m].

    Only what is within `reach` of the tool centre point counts [m].
    """
    caster = RayCaster(mesh)
    views = _camera_positions(caster, approach, tool_centre_point, reach)
    see = _seen_by_rays if method == "camera" else _seen_samples
    points, normals = see(caster, views, voxel_size)
    near = np.linalg.norm(points - tool_centre_point, axis=-1) <= reach
    points, normals = points[near], normals[near]
    if len(points) < 10:
        raise GraspmatchError("The hand has no inner surface around its tool centre point: check the card's frames.")
    keep = _one_in_each_voxel(points, voxel_size)
    return PointCloud(points[keep], normals[keep])


class RayCaster:
    """A mesh on the device and its face normals."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        self.normals, _ = face_normals_areas(mesh)
        self.device_mesh = wp.Mesh(
            wp.array(mesh.vertices, dtype=wp.vec3, device="cpu"),
            wp.array(mesh.faces.ravel(), dtype=wp.int32, device="cpu"),
        )

    def cast(
        self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Distance to the first hit of each ray and the face hit, -1 where there is none."""
        n = len(origins)
        reach, face = wp.empty(n, dtype=wp.float32, device="cpu"), wp.empty(n, dtype=wp.int32, device="cpu")
        rays = [wp.array(a, dtype=wp.vec3, device="cpu") for a in (origins, directions)]
        launch(cast_rays, n, [self.device_mesh.id, *rays], [reach, face], "cpu")
        return reach.numpy().astype(float), face.numpy()


def _camera_positions(
    caster: RayCaster, approach: Float[np.ndarray, "3"], tool_centre_point: Float[np.ndarray, "3"], reach: float
) -> Float[np.ndarray, "v 3"]:
    """On the axis from the palm, where a ray from the tool centre point meets it, to the tool centre point.

    Where the palm is out of reach, as it is in precision postures, beside the tool centre point.
    """
    back = float(caster.cast(tool_centre_point[None], -approach[None])[0][0])
    if np.isfinite(reach) and not 0 <= back <= reach:
        return tool_centre_point - np.outer(PRECISE_VIEWS, reach * approach)
    if back < 0:
        raise GraspmatchError(
            "There is no palm behind the tool centre point, against the approach: check the card's tool_centre_point "
            "and approach, in the frame of its base_link."
        )
    return tool_centre_point - (1 - np.array(CAMERA_HEIGHTS))[:, None] * back * approach


def _seen_by_rays(caster: RayCaster, views: Float[np.ndarray, "v 3"], voxel_size: float):
    """The point clouds of the cameras, each looking all around."""
    directions = np.tile(fibonacci_directions(CAMERA_RAYS), (len(views), 1))
    origins = np.repeat(views, CAMERA_RAYS, axis=0)
    reach, face = caster.cast(origins, directions)
    normals = caster.normals[face]
    hit = (face >= 0) & (np.sum(normals * directions, axis=-1) < -LEAST_COSINE)
    return (origins + reach[:, None] * directions)[hit], normals[hit]


def _seen_samples(caster: RayCaster, views: Float[np.ndarray, "v 3"], voxel_size: float):
    """Samples of the mesh, about eight a voxel face, that at least one camera sees."""
    points, normals = sample_surface(caster.mesh, 8 / voxel_size**2, np.random.default_rng(0))
    seen = np.zeros(len(points), dtype=bool)
    for view in views:
        away = points - view
        distance = np.linalg.norm(away, axis=-1)
        directions = away / distance[:, None]
        facing = np.sum(normals * directions, axis=-1) < -LEAST_COSINE
        reach, _ = caster.cast(np.broadcast_to(view, points.shape), directions)
        seen |= facing & (np.abs(reach - distance) < 1e-4)
    return points[seen], normals[seen]


def _one_in_each_voxel(points: Float[np.ndarray, "n 3"], voxel_size: float) -> Int[np.ndarray, "m"]:
    """Index of the point nearest to the centroid of each voxel's points: on the surface, as the centroid is not."""
    cells = np.floor(points / voxel_size + LATTICE_OFFSET).astype(int)
    _, voxel, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    voxel = voxel.ravel()
    centroid = np.stack([np.bincount(voxel, points[:, a]) for a in range(3)], axis=-1) / count[:, None]
    order = np.lexsort((np.sum((points - centroid[voxel]) ** 2, axis=-1), voxel))
    return order[np.unique(voxel[order], return_index=True)[1]]
