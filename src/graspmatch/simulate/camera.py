"""A depth camera in the simulated world: what it would see if it never erred (`sensor` says how it errs)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from jaxtyping import Float, Float32, Int32

from graspmatch.geometry.mesh import TriangleMesh, concatenate
from graspmatch.geometry.se3 import from_parts
from graspmatch.kernels import warp_depth
from graspmatch.kernels.launch import launch
from graspmatch.scene.camera import Camera, pixel_rays

Array = np.ndarray

NOTHING = -1
"""In `Sight.body`, of pixels that see nothing."""


@dataclass(frozen=True)
class Sight:
    """One look at the world."""

    depth: Float32[Array, "h w"]
    """Along the camera's z axis [m]; 0 where it sees nothing."""
    body: Int32[Array, "h w"]
    """Index of the mesh that each pixel sees, or `NOTHING`."""
    facing: Float32[Array, "h w"]
    """Cosine between the ray and the normal of what it meets."""


def look(camera: Camera, meshes: Sequence[TriangleMesh], size: tuple[int, int]) -> Sight:
    """What a camera sees of meshes in the world frame, in an image of `size` (width, height)."""
    width, height = size
    soup = concatenate(list(meshes))
    face_body = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    points = wp.array(soup.vertices, dtype=wp.vec3, device="cpu")
    surface = wp.Mesh(points, wp.array(soup.faces.ravel(), dtype=wp.int32, device="cpu"))
    x, y = (wp.array(axis.ravel(), dtype=wp.float32, device="cpu") for axis in pixel_rays(camera, width, height))
    pose = camera.pose
    inputs = [
        surface.id,
        wp.array(face_body, dtype=wp.int32, device="cpu"),
        wp.mat33(*pose[:3, :3].ravel()),
        wp.vec3(*pose[:3, 3]),
        x,
        y,
    ]
    outputs = [wp.empty(width * height, dtype=kind, device="cpu") for kind in (wp.float32, wp.int32, wp.float32)]
    launch(warp_depth.see, width * height, inputs, outputs, "cpu")
    depth, body, facing = (each.numpy().reshape(height, width) for each in outputs)
    return Sight(depth, body, facing)


def camera_towards(
    centre: Float[Array, "3"], azimuth: float, elevation: float, distance: float, intrinsics: Float[Array, "3 3"]
) -> Camera:
    """A camera that looks at a place from an azimuth, counter-clockwise from x, and an elevation [rad], level."""
    side = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = -np.cos(elevation) * side - np.array([0.0, 0.0, np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    R = np.stack([right, np.cross(forward, right), forward], axis=-1)
    return Camera(intrinsics, from_parts(R, centre - distance * forward))


def table_mesh(half: float) -> TriangleMesh:
    """The table z = 0, a square of so much to each side [m]."""
    corners = half * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], dtype=float)
    return TriangleMesh(corners, np.array([(0, 1, 2), (0, 2, 3)]))
