"""The household set: closed, at rest on the table, of real size, and the same volume as convex parts."""

from __future__ import annotations

import math
from functools import cache

import mujoco
import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial import ConvexHull

from graspmatch.geometry.mesh import TriangleMesh, concatenate, sample_surface
from graspmatch.kernels.launch import launch
from graspmatch.kernels.warp_bake import mesh_distance
from graspmatch.scene.household import BULGE, OBJECTS
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import Solid

CLOSE = BULGE
"""How far parts and surface may differ [m]."""
SIZES = {  # of the real thing, along x, y and z [mm]
    "mug": (97, 70, 90),
    "bottle": (65, 65, 206),
    "bowl": (150, 150, 60),
    "box": (62, 95, 135),
    "can": (66, 66, 122),
    "spray_bottle": (96, 76, 251),
    "hammer": (288, 103, 26),
    "plate": (240, 240, 22),
    "banana": (72, 166, 34),
    "ball": (60, 60, 60),
    "card": (86, 54, 3),
    "letter": (65, 100, 25),
}
each_object = pytest.mark.parametrize("name", OBJECTS)


@cache
def solid(name: str) -> Solid:
    """The object, made once."""
    return OBJECTS[name]()


def as_trimesh(mesh: TriangleMesh) -> trimesh.Trimesh:
    """As it is, nothing merged or repaired."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def signed_distance(mesh: TriangleMesh, points: np.ndarray) -> np.ndarray:
    """Distance to the nearest triangle, negative inside [m]."""
    on_device = wp.Mesh(
        wp.array(mesh.vertices, dtype=wp.vec3, device="cpu"),
        wp.array(mesh.faces.ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=True,
    )
    distance = wp.empty(len(points), dtype=wp.float32, device="cpu")
    x = wp.array(points, dtype=wp.vec3, device="cpu")
    launch(mesh_distance, len(points), [on_device.id, x], [distance], "cpu")
    return distance.numpy()


def outer_points(mesh: TriangleMesh) -> np.ndarray:
    """Points of the surface, without what lies inside another part or where two parts meet."""
    points, normals = sample_surface(mesh, 1e5, np.random.default_rng(0))
    return points[signed_distance(mesh, points + 2e-4 * normals) > 1e-4]


def is_closed(mesh: TriangleMesh) -> bool:
    """Is each connected surface watertight, its faces outwards?"""
    surfaces = as_trimesh(mesh).split(only_watertight=False)
    return all(s.is_watertight and s.is_winding_consistent and s.volume > 0 for s in surfaces)


@each_object
def test_object_is_closed_and_stands_on_the_table_in_its_real_size(name: str) -> None:
    mesh = solid(name).mesh
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert is_closed(mesh)
    assert low[2] == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(1000 * (high - low), SIZES[name], atol=1)


@each_object
def test_parts_are_closed_and_convex(name: str) -> None:
    for part in solid(name).parts:
        assert is_closed(part)
        assert as_trimesh(part).volume == pytest.approx(ConvexHull(part.vertices).volume, rel=1e-6)


@each_object
def test_parts_are_the_object_within_two_millimetres(name: str) -> None:
    mesh, union = solid(name).mesh, concatenate(list(solid(name).parts))
    surface, surface_of_parts = outer_points(mesh), outer_points(union)
    assert len(surface) > 1000
    assert len(surface_of_parts) > 1000
    assert signed_distance(union, surface).max() < CLOSE
    assert np.abs(signed_distance(mesh, surface_of_parts)).max() < CLOSE


def test_a_cavity_filled_with_a_part_would_be_noticed() -> None:
    mesh = solid("mug").mesh
    filled = TriangleMesh(mesh.vertices, ConvexHull(mesh.vertices).simplices)
    points, _ = sample_surface(filled, 1e5, np.random.default_rng(0))
    assert np.abs(signed_distance(mesh, points)).max() > 10 * CLOSE


@each_object
def test_centre_of_mass_is_over_the_support(name: str) -> None:
    mesh = solid(name).mesh
    centre = as_trimesh(mesh).center_mass
    support = ConvexHull(mesh.vertices[mesh.vertices[:, 2] < 1e-5, :2])
    margin = -(support.equations[:, :2] @ centre[:2] + support.equations[:, 2]).max()
    assert margin > 0.0028  # the flat under the ball is 3 mm in radius


@each_object
def test_object_stays_where_it_stands(name: str) -> None:
    spec = mujoco.MjSpec()
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1])
    body = spec.worldbody.add_body()
    body.add_freejoint()
    for i, part in enumerate(solid(name).parts):
        spec.add_mesh(name=f"{i}", uservert=part.vertices.ravel(), userface=part.faces.ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{i}", density=300)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 500)
    assert data.time == pytest.approx(1)
    assert np.linalg.norm(data.qpos[:3]) < 0.001
    assert math.degrees(2 * math.acos(min(abs(data.qpos[3]), 1))) < 1


@each_object
def test_object_makes_a_scene(name: str) -> None:
    scene = Scene.from_mesh(solid(name).mesh)
    assert scene.notes == ()
    assert scene.table is not None
    assert scene.table.offset == pytest.approx(0, abs=1e-6)
