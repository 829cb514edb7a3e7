"""Pictures of meshes without OpenGL: cameras, smooth normals, and the passes of the ray tracer in `kernels`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, Int, UInt8

from graspmatch.geometry.mesh import TriangleMesh, concatenate, face_normals_areas
from graspmatch.geometry.se3 import apply, from_parts, inverse, rotation_facing
from graspmatch.kernels import warp_rays, warp_render
from graspmatch.kernels.launch import launch, resolve_device
from graspmatch.types import GraspmatchError, Plane

Array = np.ndarray

CREASE = math.radians(43.0)
"""Faces that meet at a smaller angle are shaded as one: an icosahedron looks round, the chamfer of a box flat."""


@dataclass(frozen=True)
class Body:
    """A mesh of one colour, in the world frame."""

    mesh: TriangleMesh
    rgba: tuple[float, float, float, float]
    """sRGB, 0 to 1. Alpha below one: a ghost, of which one sees the nearest surface, and which casts no shadow."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks along its +z, x to the right and y down."""

    T_world_camera: Float[Array, "4 4"]
    fov: float
    """Vertical field of view [rad]."""


def camera_around(
    shown: Sequence[Body] | Float[Array, "2 3"],
    azimuth_deg: float,
    elevation_deg: float = 25.0,
    fov_deg: float = 26.0,
    *,
    aspect: float = 1.5,
    margin: float = 0.1,
    up: Float[Array, "3"] | None = None,
) -> Camera:
    """The nearest camera in a direction that frames all bodies, or the box between two corners, tightly.

    `azimuth_deg` is where the camera stands, counter-clockwise about `up` (z by default) from x; `aspect` is width over
    height, `margin` the share of the picture left free on each side.
    """
    up = np.array([0.0, 0.0, 1.0]) if up is None else up
    R_world_upright = rotation_facing(up, np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0]))
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    forward = -np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    R_world_camera = R_world_upright @ np.stack([right, np.cross(forward, right), forward], axis=-1)
    x, y, z = (_outer_points(shown) @ R_world_camera).T
    tangent = math.tan(math.radians(fov_deg) / 2) * (1 - 2 * margin)
    # Each side of the picture bounds the camera's place in its own plane; the nearest place touches both bounds.
    sides = []
    for offset, slope in ((x, tangent * aspect), (y, tangent)):
        low, high = np.max(-offset - slope * z), np.max(offset - slope * z)
        sides.append(((high - low) / 2, (high + low) / (2 * slope)))
    origin = R_world_camera @ np.array([sides[0][0], sides[1][0], -max(sides[0][1], sides[1][1])])
    return Camera(from_parts(R_world_camera, origin), math.radians(fov_deg))


def project(camera: Camera, points: Float[Array, "n 3"], size: tuple[int, int]) -> Float[Array, "n 2"]:
    """Pixel coordinates (x, y) of world points in a picture of `size` (width, height)."""
    x, y, z = apply(inverse(camera.T_world_camera), points).T
    focal = size[1] / 2 / math.tan(camera.fov / 2)
    return np.stack([size[0] / 2 + focal * x / z, size[1] / 2 + focal * y / z], axis=-1)


def render(
    bodies: Sequence[Body],
    *,
    camera: Camera,
    size: tuple[int, int] = (1200, 800),
    table: Plane | None = None,
    device: str = "cpu",
) -> UInt8[Array, "h w 3"]:
    """Picture (sRGB) of bodies under a soft light, on a table that fades into the background; `size` is (w, h)."""
    device = resolve_device(device)
    stage = _upload(bodies, device)
    view = view_of(camera, size)
    setting = setting_of(stage.lower, stage.upper, camera, table)
    samples = 4 * size[0] * size[1]
    seen = _find_surfaces(stage, view, setting, device)
    light = wp.zeros((2 * size[1], 2 * size[0]), dtype=wp.vec2, device=device)
    launch(warp_render.gather_light, samples, [stage.mesh.id, view, setting, *seen], [light], device)
    colour = wp.empty(light.shape, dtype=wp.vec3, device=device)
    paints = [stage.body_rgb, stage.ghost_ids, stage.ghost_rgba]
    launch(warp_render.shade, samples // 4, [view, setting, *paints, *seen, light], [colour], device)
    image = wp.empty((size[1], size[0], 3), dtype=wp.uint8, device=device)
    launch(warp_render.develop, samples // 4, [view, colour], [image], device)
    return image.numpy()


def visible_shares(
    bodies: Sequence[Body], cameras: Sequence[Camera], *, size: tuple[int, int] = (60, 40), device: str = "cpu"
) -> Float[Array, "c b"]:
    """Share of the picture in which each camera sees each body; a ghost hides nothing and counts as unseen."""
    device = resolve_device(device)
    stage = _upload(bodies, device, smooth=False)
    shares = np.zeros((len(cameras), len(bodies)))
    for i, camera in enumerate(cameras):
        seen = _find_surfaces(stage, view_of(camera, size), setting_of(stage.lower, stage.upper, camera, None), device)
        index = seen[0].numpy().ravel()
        shares[i] = np.bincount(index[index >= 0], minlength=len(bodies)) / index.size
    return shares


def corner_normals(mesh: TriangleMesh, crease: float = CREASE) -> Float[Array, "f 3 3"]:
    """Unit normal at each corner of each face: mean over faces that share the vertex and meet it at less than `crease`
    [rad], weighted by their angles there. Vertices at the same place count as one."""
    normals = face_normals_areas(mesh)[0]
    if crease == 0 or len(mesh.faces) == 0:
        return np.repeat(normals[:, None], 3, axis=1)
    weights = _corner_angles(mesh).ravel()
    vertex = _welded(mesh.vertices)[mesh.faces].ravel()
    order = np.argsort(vertex, kind="stable")
    # All ordered pairs of corners at the same vertex, in runs of one first corner each.
    _, start, count = np.unique(vertex[order], return_index=True, return_counts=True)
    partners = np.repeat(count, count)
    run = np.cumsum(partners) - partners
    first = np.repeat(order, partners)
    second = order[np.repeat(np.repeat(start, count) - run, partners) + np.arange(len(first))]
    normal_second = normals[second // 3]
    smooth = np.sum(normals[first // 3] * normal_second, axis=-1) > math.cos(crease)
    total = np.add.reduceat(normal_second * (weights[second] * smooth)[:, None], run, axis=0)
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    result = np.empty_like(total)
    result[order] = np.where(length > 1e-9, total / np.maximum(length, 1e-9), normals[order // 3])
    return result.reshape(-1, 3, 3)


def _corner_angles(mesh: TriangleMesh) -> Float[Array, "f 3"]:
    corners = mesh.vertices[mesh.faces]
    edges = np.roll(corners, -1, axis=1) - corners
    edges = edges / np.maximum(np.linalg.norm(edges, axis=-1, keepdims=True), 1e-300)
    return np.arccos(np.clip(-np.sum(edges * np.roll(edges, 1, axis=1), axis=-1), -1.0, 1.0))


def _welded(vertices: Float[Array, "v 3"]) -> Int[Array, "v"]:
    """A number for each vertex, the same for vertices at the same place (to a millionth of the mesh)."""
    lower = vertices.min(axis=0)
    cells = np.round((vertices - lower) / max(float(np.ptp(vertices, axis=0).max()), 1e-12) * 1e6).astype(np.int64)
    key = (cells[:, 0] * 2_000_003 + cells[:, 1]) * 2_000_003 + cells[:, 2]
    return np.unique(key, return_inverse=True)[1]


@dataclass(frozen=True)
class _Stage:
    """Bodies on the device: the opaque ones in one mesh, each ghost in its own; and the box [m] around all of them."""

    lower: Float[Array, "3"]
    upper: Float[Array, "3"]
    mesh: Any
    face_body: Any
    corner_normals: Any
    body_rgb: Any
    ghosts: list[Any]
    ghost_ids: Any
    ghost_rgba: Any


def _upload(bodies: Sequence[Body], device: str, *, smooth: bool = True) -> _Stage:
    solid = [i for i, body in enumerate(bodies) if body.rgba[3] >= 1 and len(body.mesh.faces)]
    ghostly = [body for body in bodies if body.rgba[3] < 1 and len(body.mesh.faces)]
    meshes = [bodies[i].mesh for i in solid]
    merged = concatenate(meshes)
    if not meshes:  # a mesh for rays needs a triangle: one that no ray can hit
        merged = TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    crease = CREASE if smooth else 0.0
    normals = np.concatenate([np.zeros((0, 3, 3)), *(corner_normals(mesh, crease) for mesh in meshes)])
    owner = np.repeat(solid, [len(mesh.faces) for mesh in meshes])
    rgb = np.array([linear(body.rgba[:3]) for body in bodies]).reshape(-1, 3)
    ghosts = [_warp_mesh(body.mesh, device) for body in ghostly]
    ghost_rgba = np.array([(*linear(body.rgba[:3]), body.rgba[3]) for body in ghostly]).reshape(-1, 4)
    points = _outer_points(bodies) if bodies else np.zeros((1, 3))
    return _Stage(
        lower=points.min(axis=0),
        upper=points.max(axis=0),
        mesh=_warp_mesh(merged, device),
        face_body=wp.array(owner, dtype=int, device=device),
        corner_normals=wp.array(normals, dtype=wp.vec3, device=device),
        body_rgb=wp.array(rgb, dtype=wp.vec3, device=device),
        ghosts=ghosts,
        ghost_ids=wp.array([ghost.id for ghost in ghosts], dtype=wp.uint64, device=device),
        ghost_rgba=wp.array(ghost_rgba, dtype=wp.vec4, device=device),
    )


def _warp_mesh(mesh: TriangleMesh, device: str) -> wp.Mesh:
    points = wp.array(mesh.vertices, dtype=wp.vec3, device=device)
    return wp.Mesh(points=points, indices=wp.array(mesh.faces.ravel(), dtype=int, device=device))


def _find_surfaces(stage: _Stage, view: Any, setting: Any, device: str) -> tuple[Any, Any, Any]:
    """Body, position and normal that each of the four samples of each pixel sees."""
    shape = (2 * view.height, 2 * view.width)
    body = wp.empty(shape, dtype=int, device=device)
    position = wp.empty(shape, dtype=wp.vec3, device=device)
    normal = wp.empty(shape, dtype=wp.vec3, device=device)
    inputs = [stage.mesh.id, stage.face_body, stage.corner_normals, view, setting]
    launch(warp_render.find_surfaces, shape[0] * shape[1], inputs, [body, position, normal], device)
    return body, position, normal


def view_of(camera: Camera, size: tuple[int, int]) -> Any:
    """The camera as the kernels take it; `size` is (w, h)."""
    if min(size) < 1:
        raise GraspmatchError(f"A picture cannot be {size[0]} x {size[1]} pixels; give a width and a height above 0.")
    width, height = size
    right, down, forward = camera.T_world_camera[:3, :3].T
    pixel = 2 * math.tan(camera.fov / 2) / height
    view = warp_rays.View()
    view.origin = wp.vec3(*camera.T_world_camera[:3, 3])
    view.right = wp.vec3(*(pixel * right))
    view.down = wp.vec3(*(pixel * down))
    view.corner = wp.vec3(*(forward - pixel * (width / 2 * right + height / 2 * down)))
    view.width, view.height = width, height
    # Near the golden ratio, so that any run of rows is spread over the picture; odd, as rows of samples come in pairs.
    stride = int(2 * height * 0.618) | 1
    while math.gcd(stride, 2 * height) > 1:
        stride += 2
    view.row_stride = stride
    return view


def setting_of(lower: Float[Array, "3"], upper: Float[Array, "3"], camera: Camera, table: Plane | None) -> Any:
    """Light from the upper left behind the camera; lengths follow the size of the box of what is shown."""
    centre = (lower + upper) / 2
    radius = max(float(np.linalg.norm(upper - lower)) / 2, 1e-6)
    right, down, forward = camera.T_world_camera[:3, :3].T
    up = -down if table is None else table.normal
    back = -(forward - forward @ up * up)
    sun = -0.55 * right + 0.45 * back / max(float(np.linalg.norm(back)), 1e-9) + 0.95 * up
    setting = warp_rays.Setting()
    setting.sun = wp.vec3(*(sun / np.linalg.norm(sun)))
    setting.sun_radius = 0.12
    setting.sun_colour = wp.vec3(0.62, 0.59, 0.55)
    setting.sky_colour = wp.vec3(0.52, 0.54, 0.58)
    setting.reach = 0.9 * radius
    setting.lift = 3e-4 * radius
    setting.top_colour = wp.vec3(*linear((0.82, 0.845, 0.87)))
    setting.bottom_colour = wp.vec3(*linear((0.965, 0.97, 0.975)))
    setting.up = wp.vec3(*up)
    if table is not None:
        setting.has_floor = 1
        setting.floor_offset = table.offset
        setting.floor_centre = wp.vec3(*(centre - (centre @ up - table.offset) * up))
        setting.floor_radius = 1.9 * radius
        setting.floor_colour = wp.vec3(*linear((0.975, 0.965, 0.95)))
    return setting


def linear(rgb: Sequence[float]) -> tuple[float, ...]:
    """Linear values of sRGB ones."""
    return tuple(c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb)


def _outer_points(shown: Sequence[Body] | Float[Array, "2 3"]) -> Float[Array, "n 3"]:
    """All vertices, or the corners of a box."""
    if isinstance(shown, np.ndarray):
        return np.stack(np.meshgrid(*shown.T, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.concatenate([np.zeros((0, 3)), *(body.mesh.vertices for body in shown)])
