"""Objects made by code are what they claim to be."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.scene.shapes import mug, revolved, swept_tube


def parts_of(mesh: TriangleMesh) -> list[trimesh.Trimesh]:
    """The connected parts of a mesh."""
    return list(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).split(only_watertight=False))


def winding_number(part: trimesh.Trimesh, point: list[float]) -> float:
    """One inside, zero outside: the solid angle of all triangles seen from the point (Van Oosterom 1983)."""
    a, b, c = np.moveaxis(part.triangles - np.asarray(point), 1, 0)
    x, y, z = (np.linalg.norm(edge, axis=-1) for edge in (a, b, c))
    dots = x * y * z + np.sum(a * b, -1) * z + np.sum(a * c, -1) * y + np.sum(b * c, -1) * x
    return float(np.sum(np.arctan2(np.sum(a * np.cross(b, c), -1), dots))) / (2 * np.pi)


def test_mug_is_two_watertight_parts_with_outward_faces() -> None:
    parts = parts_of(mug())
    assert len(parts) == 2
    assert all(part.is_watertight and part.is_winding_consistent and part.volume > 0 for part in parts)


def test_mug_stands_on_the_table_and_fits_a_hand() -> None:
    vertices = mug(0.08, 0.095).vertices
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    np.testing.assert_allclose(low, [-0.04, -0.04, 0.0], atol=1e-9)
    np.testing.assert_allclose(high[1:], [0.04, 0.095], atol=1e-9)
    assert 0.06 < high[0] < 0.08


def test_mug_is_hollow_and_its_handle_ends_inside_the_wall() -> None:
    body, handle = sorted(parts_of(mug(0.08, 0.095)), key=lambda part: -part.volume)
    assert winding_number(body, [0.0, 0.0, 0.05]) == pytest.approx(0, abs=1e-6)
    assert winding_number(body, [0.038, 0.0, 0.05]) == pytest.approx(1, abs=1e-6)
    in_cavity = np.hypot(handle.vertices[:, 0], handle.vertices[:, 1]) < 0.036
    assert not in_cavity.any()
    ends = handle.vertices[np.isclose(handle.vertices[:, 0], 0.038)]
    assert len(ends) > 20
    assert all(winding_number(body, list(end)) == pytest.approx(1, abs=1e-6) for end in ends)


def test_solid_of_revolution_has_the_volume_of_a_cylinder() -> None:
    solid = parts_of(revolved(np.array([[0, 0], [0.1, 0], [0.1, 0.3], [0, 0.3]]), segments=256))[0]
    assert solid.volume == pytest.approx(np.pi * 0.1**2 * 0.3, rel=1e-3)


def test_tube_has_the_volume_of_a_straight_bar() -> None:
    path = np.stack([np.linspace(0, 0.2, 4), np.zeros(4)], axis=-1)
    bar = parts_of(swept_tube(path, np.tile([1.0, 0.0], (4, 1)), 0.01, sides=256))[0]
    assert bar.volume == pytest.approx(np.pi * 0.01**2 * 0.2, rel=1e-3)
