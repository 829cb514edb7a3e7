"""Objects made by code are what they claim to be."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.geometry.se3 import from_parts, rotation_exp
from graspmatch.scene.shapes import convex, convex_hull, extruded, joined, moved, mug, revolved, revolved_parts, swept


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


def volume(mesh: TriangleMesh) -> float:
    """Signed, of all parts together [m3]."""
    return float(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume)


def straight_bar(radius: list[float], length: float = 0.2, sides: int = 256):
    """A bar along x whose radius changes at even steps."""
    k = len(radius)
    path = np.stack([np.linspace(0, length, k), np.zeros(k), np.zeros(k)], axis=-1)
    return swept(path, np.tile([1.0, 0.0, 0.0], (k, 1)), np.array(radius), axis=np.array([0.0, 0.0, 1.0]), sides=sides)


def test_solid_of_revolution_has_the_volume_of_a_cylinder() -> None:
    profile = np.array([[0, 0], [0.1, 0], [0.1, 0.3], [0, 0.3]])
    assert parts_of(revolved(profile, segments=256).mesh)[0].volume == pytest.approx(np.pi * 0.1**2 * 0.3, rel=1e-3)


def test_convex_profile_is_one_part_and_a_waist_makes_several_discs() -> None:
    cylinder = np.array([[0, 0], [0.1, 0], [0.1, 0.3], [0, 0.3]])
    waist = np.array([[0, 0], [0.1, 0], [0.05, 0.1], [0.1, 0.2], [0, 0.2]])
    assert len(revolved_parts(cylinder)) == 1
    parts = revolved_parts(waist)
    assert len(parts) == 2
    assert sum(volume(part) for part in parts) == pytest.approx(volume(revolved(waist).mesh))


def test_wall_of_a_cup_is_a_ring_of_sectors_around_a_disc() -> None:
    cup = np.array([[0, 0], [0.05, 0], [0.05, 0.1], [0.045, 0.1], [0.045, 0.005], [0, 0.005]])
    parts = revolved_parts(cup)
    assert len(parts) == 17
    # Sectors bridge the hollow of the wall, by about a fifth of its thickness here.
    assert volume(revolved(cup).mesh) < sum(volume(part) for part in parts) < 1.2 * volume(revolved(cup).mesh)


def test_bar_has_the_volume_of_a_cylinder_and_a_cone_and_straight_stretches_are_one_part() -> None:
    cylinder, cone = straight_bar([0.01] * 4), straight_bar([0.01, 0.008, 0.006])
    assert volume(cylinder.mesh) == pytest.approx(np.pi * 0.01**2 * 0.2, rel=1e-3)
    assert volume(cone.mesh) == pytest.approx(np.pi * 0.2 * (0.01**2 + 0.01 * 0.006 + 0.006**2) / 3, rel=1e-3)
    assert [len(bar.parts) for bar in (cylinder, cone)] == [1, 1]
    assert volume(cone.parts[0]) == pytest.approx(volume(cone.mesh), rel=1e-6)


def test_thin_middle_of_a_bar_is_not_bridged() -> None:
    bar = straight_bar([0.02, 0.01, 0.02])
    assert len(bar.parts) == 2
    assert sum(volume(part) for part in bar.parts) == pytest.approx(volume(bar.mesh), rel=1e-6)


def test_prism_with_a_hole_is_closed_and_its_parts_leave_the_hole_free() -> None:
    frame = np.array([(0, 3), (0, 0), (3, 0), (3, 3), (0, 3), (1, 2), (2, 2), (2, 1), (1, 1), (1, 2)]) / 100
    prism = extruded(frame, 0.02)
    (surface,) = parts_of(prism.mesh)
    assert surface.is_watertight
    assert surface.is_winding_consistent
    assert surface.euler_number == 0  # of a torus
    assert surface.volume == pytest.approx(8e-4 * 0.02)
    assert sum(volume(part) for part in prism.parts) == pytest.approx(surface.volume)


def test_hull_of_a_cube_leaves_out_what_is_inside() -> None:
    corners = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    hull = convex_hull(corners)
    assert trimesh.Trimesh(hull.vertices, hull.faces, process=False).is_watertight
    assert volume(hull) == pytest.approx(8)
    assert not np.any(np.all(hull.vertices == 0, axis=1))


def test_moving_and_joining_keep_surface_and_parts_together() -> None:
    cube = convex(np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float))
    T = from_parts(rotation_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([5.0, 0.0, 0.0]))
    both = joined([cube, moved(cube, T)])
    assert volume(both.mesh) == pytest.approx(2)
    assert len(both.parts) == 2
    np.testing.assert_allclose(both.parts[1].vertices.min(axis=0), [4, 0, 0], atol=1e-12)
    np.testing.assert_allclose(both.mesh.vertices.max(axis=0), [5, 1, 1], atol=1e-12)
