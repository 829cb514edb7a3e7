"""What stands there without the hand: the object as cloud and mesh, obstacles, and the table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from jaxtyping import Float

from graspmatch.apps.render import corner_normals
from graspmatch.apps.viewer.palette import OBJECT, OBSTACLE, TABLE
from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.geometry.se3 import quaternion_from_matrix, rotation_facing
from graspmatch.scene.scene import Scene
from graspmatch.types import Plane

Array = np.ndarray

SPACING = 0.0025
"""Distance between the points of a scene, by which they are drawn so large that they nearly touch [m]."""
GLASSY = 0.45
"""Opacity of the mesh: contacts behind it are seen."""
MARGIN = 0.12
"""How far the table reaches beyond what stands on it [m]."""


@dataclass(frozen=True)
class Stage:
    """The nodes; those of the object hang on one that can be lifted."""

    object: viser.FrameHandle
    cloud: viser.PointCloudHandle
    mesh: viser.MeshHandle | None


def set_stage(server: viser.ViserServer, scene: Scene) -> Stage:
    """Draw a scene; the cloud is shown where there is no mesh."""
    api = server.scene
    frame = api.add_frame("/object", show_axes=False)
    mesh = None
    if scene.mesh is not None:
        creased = creased_mesh(scene.mesh)
        mesh = api.add_mesh_simple(
            "/object/mesh", creased.vertices, creased.faces, color=OBJECT, opacity=GLASSY, side="double"
        )
    points = scene.target.points
    cloud = _add_cloud(api, "/object/cloud", points, OBJECT)
    cloud.visible = mesh is None
    if len(scene.obstacles.points):
        _add_cloud(api, "/obstacles", scene.obstacles.points, OBSTACLE)
    if scene.table is not None:
        around = np.concatenate([points, scene.obstacles.points])
        corners, wxyz, position = table_patch(scene.table, around)
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        api.add_mesh_simple("/table", corners, faces, color=TABLE, side="double", wxyz=wxyz, position=position)
    return Stage(frame, cloud, mesh)


def table_patch(
    table: Plane, points: Float[Array, "n 3"]
) -> tuple[Float[Array, "4 3"], Float[Array, "4"], Float[Array, "3"]]:
    """Corners [m] of the part of a table under points, and the pose (wxyz, position) of the frame that they are in."""
    hint = np.array([1.0, 0.0, 0.0]) if abs(table.normal[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    R_world_table = rotation_facing(table.normal, hint)
    across = points @ R_world_table
    low, high = across.min(axis=0) - MARGIN, across.max(axis=0) + MARGIN
    size = (high - low) / 2
    corners = np.array([[-size[0], -size[1], 0], [size[0], -size[1], 0], [size[0], size[1], 0], [-size[0], size[1], 0]])
    middle = (low + high) / 2
    position = R_world_table @ np.array([middle[0], middle[1], table.offset])
    return corners, quaternion_from_matrix(R_world_table), position


def creased_mesh(mesh: TriangleMesh) -> TriangleMesh:
    """The same surface with its vertices split along sharp edges: browsers shade across vertices that faces share."""
    normals = np.round(corner_normals(mesh), 2).reshape(-1, 3)
    corners = np.concatenate([mesh.vertices[mesh.faces].reshape(-1, 3), normals], axis=-1)
    unique, inverse = np.unique(corners, axis=0, return_inverse=True)
    return TriangleMesh(unique[:, :3], inverse.reshape(-1, 3))


def _add_cloud(api: viser.SceneApi, name: str, points: Float[Array, "n 3"], colour: tuple[int, int, int]):
    return api.add_point_cloud(
        name, points, colour, point_size=0.8 * SPACING, point_shape="circle", precision="float32"
    )
