"""Many pictures of the same bodies as they move before one camera: all that does not change is made once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, Int, UInt8

from graspmatch.apps.render import Body, Camera, corner_normals, linear, project, setting_of, view_of
from graspmatch.geometry.mesh import TriangleMesh, concatenate
from graspmatch.geometry.se3 import apply, inverse
from graspmatch.kernels import warp_film
from graspmatch.kernels.launch import launch, resolve_device
from graspmatch.types import Plane

Array = np.ndarray

TILE = 8
"""Edge of the squares of pixels in which rays run or do not, as in the kernels."""
FLOOR_NODES = 128
"""Of each edge of the lattice that holds the light on the floor."""


@dataclass(frozen=True)
class Film:
    """Bodies on the device, all in one mesh, and the buffers that each frame fills anew."""

    device: str
    camera: Camera
    size: tuple[int, int]
    corners: Float[Array, "b 8 3"]
    """Of the box around each body, in the body's frame [m]."""
    view: Any
    setting: Any
    lattice: Any
    mesh: Any
    vertex_body: Any
    vertices: Any
    face_body: Any
    normals: Any
    normals_world: Any
    body_rgb: Any
    display: Any
    """Display value of each of evenly spaced linear values: quicker than the power for every pixel."""
    samples: tuple[Any, Any, Any, Any]
    """Body, position, normal and light of the four samples of each pixel."""
    floor_light: tuple[Any, Any]
    """Before and after smoothing."""
    image: Any


def prepare_film(
    bodies: Sequence[Body],
    box: Float[Array, "2 3"],
    camera: Camera,
    *,
    size: tuple[int, int] = (640, 480),
    table: Plane | None = None,
    device: str = "cpu",
) -> Film:
    """Everything that all frames share. Bodies are solid, have faces and are given in their own frames; `box` [m] holds
    all that is to be seen."""
    device = resolve_device(device)
    meshes = [body.mesh for body in bodies]
    vertex_body = np.repeat(np.arange(len(bodies)), [len(mesh.vertices) for mesh in meshes])
    face_body = np.repeat(np.arange(len(bodies)), [len(mesh.faces) for mesh in meshes])
    normals = wp.array(np.concatenate([corner_normals(mesh) for mesh in meshes]), dtype=wp.vec3, device=device)
    setting = setting_of(box[0], box[1], camera, table)
    rows, columns = 2 * size[1], 2 * size[0]
    return Film(
        device=device,
        camera=camera,
        size=size,
        corners=np.stack([_box_corners(mesh.vertices) for mesh in meshes]),
        view=view_of(camera, size),
        setting=setting,
        lattice=_lattice(setting, float(np.linalg.norm(box[1] - box[0])), camera),
        mesh=_mesh_by_body(meshes, device),
        vertex_body=wp.array(vertex_body, dtype=int, device=device),
        vertices=wp.array(concatenate(meshes).vertices, dtype=wp.vec3, device=device),
        face_body=wp.array(face_body, dtype=int, device=device),
        normals=normals,
        normals_world=wp.empty_like(normals),
        body_rgb=wp.array([linear(body.rgba[:3]) for body in bodies], dtype=wp.vec3, device=device),
        display=wp.array(_display_values(), dtype=wp.uint8, device=device),
        samples=tuple(wp.zeros((rows, columns), dtype=t, device=device) for t in (int, wp.vec3, wp.vec3, wp.vec2)),
        floor_light=tuple(wp.zeros((FLOOR_NODES, FLOOR_NODES), dtype=wp.vec2, device=device) for _ in range(2)),
        image=wp.empty((size[1], size[0], 3), dtype=wp.uint8, device=device),
    )


def draw_frame(film: Film, T_world_body: Float[Array, "b 4 4"]) -> UInt8[Array, "h w 3"]:
    """Picture (sRGB) of the bodies where they are now."""
    _move(film, T_world_body)
    tiles = _tiles_of_bodies(film, T_world_body)
    rays = [film.mesh.id, film.face_body, film.normals_world, film.view, film.setting]
    film.samples[0].fill_(-1)
    device, setting, lattice = film.device, film.setting, film.lattice
    tile_list = wp.array(_spread(np.argwhere(tiles)[:, ::-1]), dtype=wp.vec2i, device=device)
    launch(warp_film.see_bodies, len(tile_list) * TILE * TILE, [tile_list, *rays], film.samples, device)
    if setting.has_floor:
        rough, smooth = film.floor_light
        launch(warp_film.light_floor, rough.size, [film.mesh.id, setting, lattice], [rough], device)
        launch(warp_film.soften_floor, rough.size, [lattice, rough], [smooth], device)
    seen = wp.array(tiles.astype(np.uint8), dtype=wp.uint8, device=device)
    inputs = [film.view, setting, film.body_rgb, film.display, seen, lattice, film.floor_light[1], *film.samples]
    launch(warp_film.paint, film.size[0] * film.size[1], inputs, [film.image], device)
    return film.image.numpy().copy()


def _move(film: Film, T_world_body: Float[Array, "b 4 4"]) -> None:
    T = wp.array(T_world_body, dtype=wp.mat44, device=film.device)
    inputs = [film.vertex_body, film.vertices, T]
    launch(warp_film.move_vertices, len(film.vertices), inputs, [film.mesh.points], film.device)
    inputs = [film.face_body, film.normals, T]
    launch(warp_film.turn_normals, len(film.normals), inputs, [film.normals_world], film.device)
    film.mesh.refit()


def _mesh_by_body(meshes: Sequence[TriangleMesh], device: str) -> Any:
    """One mesh, built with the bodies in a row: no node of its tree but the topmost then holds parts of two bodies, and
    the tree stays good however they move."""
    lower, upper = (np.array([f(mesh.vertices, axis=0) for mesh in meshes]) for f in (np.min, np.max))
    along = 1.1 * np.cumsum(upper[:, 0] - lower[:, 0])
    places = np.stack([along - upper[:, 0], -lower[:, 1], -lower[:, 2]], axis=-1)
    row = concatenate([TriangleMesh(m.vertices + place, m.faces) for m, place in zip(meshes, places, strict=True)])
    points = wp.array(row.vertices, dtype=wp.vec3, device=device)
    return wp.Mesh(points, wp.array(row.faces.ravel(), dtype=int, device=device))


def _tiles_of_bodies(film: Film, T_world_body: Float[Array, "b 4 4"]) -> Int[Array, "rows columns"]:
    """Tiles of the picture that a body's box may cover."""
    width, height = film.size
    tiles = np.zeros((-(-height // TILE), -(-width // TILE)), dtype=int)
    T_camera_body = inverse(film.camera.T_world_camera) @ T_world_body
    for T, corners in zip(T_camera_body, film.corners, strict=True):
        if apply(T, corners)[:, 2].min() < 1e-3:  # beside or behind the camera
            return np.ones_like(tiles)
        pixels = project(film.camera, apply(film.camera.T_world_camera @ T, corners), film.size)
        left, top = np.maximum(pixels.min(axis=0) // TILE, 0).astype(int)
        right, bottom = np.maximum(pixels.max(axis=0) // TILE + 1, 0).astype(int)
        tiles[top:bottom, left:right] = 1
    return tiles


def _spread(tiles: Int[Array, "n 2"]) -> Int[Array, "n 2"]:
    """In an order in which equal shares cost about the same."""
    return tiles[np.argsort(np.arange(len(tiles)) * 0.618034 % 1.0)]


def _box_corners(points: Float[Array, "n 3"]) -> Float[Array, "8 3"]:
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    return np.stack(np.meshgrid(*bounds.T, indexing="ij"), axis=-1).reshape(-1, 3)


def _display_values() -> Int[Array, "4096"]:
    linear_values = np.linspace(0.0, 1.0, 4096)
    curve = np.where(linear_values < 0.0031308, 12.92 * linear_values, 1.055 * linear_values ** (1 / 2.4) - 0.055)
    return np.round(255 * curve).astype(int)


def _lattice(setting: Any, width: float, camera: Camera) -> Any:
    """Nodes below all that is seen and as far again around it."""
    up = np.array(setting.up)
    across = np.cross(up, camera.T_world_camera[:3, 2])
    across /= max(float(np.linalg.norm(across)), 1e-9)
    along = np.cross(up, across)
    lattice = warp_film.FloorLattice()
    lattice.count = FLOOR_NODES
    lattice.spacing = 2 * width / FLOOR_NODES
    lattice.across, lattice.along = wp.vec3(*across), wp.vec3(*along)
    lattice.corner = wp.vec3(*(np.array(setting.floor_centre) - width * (across + along)))
    return lattice
