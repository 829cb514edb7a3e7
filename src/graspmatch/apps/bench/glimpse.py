"""What the planner gets in place of a mesh: one depth image of the table, with all errors of a sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from graspmatch.config import ViewConfig
from graspmatch.geometry.mesh import TriangleMesh, face_normals_areas
from graspmatch.scene.camera import Camera
from graspmatch.scene.depth_view import depth_view
from graspmatch.scene.scene import Scene
from graspmatch.scene.segment import segment

if TYPE_CHECKING:
    from graspmatch.simulate.camera import Sight
    from graspmatch.simulate.sensor import Shot

Array = np.ndarray

INTRINSICS = np.array([[615.0, 0.0, 320.0], [0.0, 615.0, 240.0], [0.0, 0.0, 1.0]])
SIZE = (640, 480)
AIM = np.array([0.0, 0.0, 0.05])
"""What the camera looks at: the middle of the table, where objects are put, not the object [m]."""
TABLE_HALF = 0.6
"""Half a side of the table that is seen [m]."""


@dataclass(frozen=True)
class Glimpse:
    """One depth image, and what only the benchmark knows of it."""

    shot: Shot
    camera: Camera
    """Where it truly stands."""
    sight: Sight
    """Without errors; the bodies are the objects in their order, then the table."""
    view: ViewConfig
    azimuth: float
    """Of the camera in the frame of the first object's mesh [rad]."""
    seen: float
    """Share of the first object's surface that was seen."""


def glimpse_of(
    meshes: Sequence[TriangleMesh], T_world_object: Float[Array, "4 4"], view: ViewConfig, rng: np.random.Generator
) -> Glimpse:
    """A look at objects on the table z = 0; the pose is that of the first."""
    from graspmatch.simulate.camera import camera_towards, look, table_mesh
    from graspmatch.simulate.sensor import shoot

    camera = camera_towards(AIM, view.azimuth, view.elevation, view.distance, INTRINSICS)
    sight = look(camera, [*meshes, table_mesh(TABLE_HALF)], SIZE)
    to_camera = T_world_object[:3, :3].T @ (camera.pose[:3, 3] - T_world_object[:3, 3])
    azimuth = float(np.arctan2(to_camera[1], to_camera[0]))
    share = float(np.sum(_areas_seen(sight)[sight.body == 0]) / np.sum(face_normals_areas(meshes[0])[1]))
    return Glimpse(shoot(sight, camera, view.sensor, rng), camera, sight, view, azimuth, share)


def scene_of(glimpse: Glimpse) -> Scene:
    """What the planner makes of the image: the object of which most is seen, of those on which nothing stands, and what
    is around it."""
    table = 0.0 if glimpse.view.knows_table else "auto"
    return Scene.from_depth(glimpse.shot.depth, glimpse.shot.camera, table=table, complete=glimpse.view.completes)


def scenes_of(glimpse: Glimpse) -> list[Scene]:
    """The same for every object that is told apart."""
    table = 0.0 if glimpse.view.knows_table else "auto"
    view, plane = depth_view(glimpse.shot.depth, glimpse.shot.camera, table)
    found = segment(view, table=plane)
    completes = glimpse.view.completes
    return [Scene.from_view(view, object=int(number), table=table, complete=completes) for number in found.numbers]


def hidden_share(glimpse: Glimpse, meshes: Sequence[TriangleMesh], index: int) -> float:
    """Share of an object's silhouette that other objects hide."""
    from graspmatch.simulate.camera import look

    alone = look(glimpse.camera, [meshes[index]], SIZE)
    share = np.count_nonzero(glimpse.sight.body == index) / max(np.count_nonzero(alone.body == 0), 1)
    return float(1 - share)


def _areas_seen(sight: Sight) -> Float[Array, "h w"]:
    """Of the surface in each pixel [m2]."""
    columns, rows = np.meshgrid(*(np.arange(length) for length in sight.depth.shape[::-1]))
    K = INTRINSICS
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    solid_angle = (1 + x**2 + y**2) ** -1.5 / (K[0, 0] * K[1, 1])
    squared_range = sight.depth.astype(float) ** 2 * (1 + x**2 + y**2)
    return solid_angle * squared_range / np.maximum(sight.facing, 0.05)
