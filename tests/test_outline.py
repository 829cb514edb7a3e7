"""Outlines fall into convex pieces that tile them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspmatch.scene.outline import convex_pieces, distance_to_segment, fan, notch_depths
from graspmatch.types import GraspmatchError

ELL = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 3), (0, 3)], dtype=float)
FRAME = np.array([(0, 3), (0, 0), (3, 0), (3, 3), (0, 3), (1, 2), (2, 2), (2, 1), (1, 1), (1, 2)], dtype=float)
"""A square with a square hole, which a slit reaches."""


def area(polygon: np.ndarray) -> float:
    """Positive where it runs counter-clockwise."""
    x, y = polygon.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def star(seed: int, corners: int) -> np.ndarray:
    """A polygon with corners at random distances, all of them seen from the origin."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.4, 0.4, corners)) / corners
    return rng.uniform(0.2, 1.0, (corners, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), corners=st.integers(5, 25), tolerance=st.sampled_from([0.0, 0.05]))
def test_pieces_tile_the_outline_and_are_convex_within_the_tolerance(seed: int, corners: int, tolerance: float) -> None:
    outline = star(seed, corners)
    pieces = [outline[ring] for ring in convex_pieces(outline, tolerance)]
    assert all(area(piece) > 0 for piece in pieces)
    assert sum(area(piece) for piece in pieces) == pytest.approx(area(outline))
    assert max(notch_depths(piece).max() for piece in pieces) <= tolerance + 1e-8


def test_a_convex_outline_stays_whole_and_one_notch_takes_one_cut() -> None:
    assert len(convex_pieces(ELL[:3])) == 1
    assert len(convex_pieces(ELL)) == 2
    assert len(convex_pieces(ELL, tolerance=1.0)) == 1


def test_depth_of_a_notch_is_the_distance_from_the_hull() -> None:
    np.testing.assert_allclose(notch_depths(ELL), [0, 0, 0, 2 / np.sqrt(5), 0, 0], atol=1e-12)


def test_pieces_leave_a_hole_free() -> None:
    pieces = [FRAME[ring] for ring in convex_pieces(FRAME)]
    assert sum(area(piece) for piece in pieces) == pytest.approx(8)
    centres = [piece.mean(axis=0) for piece in pieces]
    assert all(np.abs(centre - 1.5).max() > 0.5 for centre in centres)


def test_a_fan_has_no_empty_triangles_where_corners_are_in_line() -> None:
    polygon = np.array([(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (0, 2)], dtype=float)
    triangles = polygon[fan(polygon)]
    areas = [area(triangle) for triangle in triangles]
    assert min(areas) > 0
    assert sum(areas) == pytest.approx(4)


def test_distance_to_a_segment_ends_with_the_segment() -> None:
    points = np.array([(0.5, 1.0), (2.0, 0.0), (-3.0, 4.0)])
    np.testing.assert_allclose(distance_to_segment(points, np.zeros((1, 2)), np.array([[1.0, 0.0]])), [1, 1, 5])


@pytest.mark.parametrize(
    ("outline", "reason"),
    [
        (ELL[::-1], "runs clockwise"),
        ([(0, 0), (4, 0), (4, 4), (2, -1), (0, 4)], "crosses itself"),
        ([(0, 0), (4, 0), (4, 2), (6, 2), (4, 2), (4, 4), (0, 4)], "folds back"),
    ],
)
def test_what_is_no_outline_is_refused(outline: object, reason: str) -> None:
    with pytest.raises(GraspmatchError, match=reason):
        convex_pieces(np.array(outline, dtype=float))
