"""The far side that is guessed of an object seen from one side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from depth_scenes import Box, Cylinder, Setting, camera_at, noisy, render
from graspmatch.geometry.se3 import rotation_exp
from graspmatch.scene.captured import HAND_REACH, completed
from graspmatch.scene.complete import far_side
from graspmatch.scene.household import bowl
from graspmatch.scene.scene import Scene
from graspmatch.scene.sight import sight_lines
from graspmatch.types import PointCloud

Array = np.ndarray

CAN = Cylinder(0.02, 0.0, 0.035, 0.12)
CARTON = Box(0.0, 0.03, (0.07, 0.05, 0.14), yaw=0.5)
LYING = Box(0.0, 0.0, (0.16, 0.06, 0.05), yaw=-0.3)
IN_FRONT = Box(0.0, -0.05, (0.05, 0.05, 0.05))
CUP = Cylinder(0.0, 0.0, 0.045, 0.1, is_hollow=True)


def scene_of(*things: Box | Cylinder, complete: bool = True, elevation: float = 45, number: int = 0) -> Scene:
    setting = Setting(things, camera=camera_at(elevation, 0.6))
    depth, _ = render(setting)
    image = noisy(depth, np.random.default_rng(0))
    return Scene.from_depth(image, setting.camera, table=0.0, object=number, complete=complete)


def guessed(scene: Scene) -> PointCloud:
    assert scene.is_guessed is not None
    assert scene.target.normals is not None
    return PointCloud(scene.target.points[scene.is_guessed], scene.target.normals[scene.is_guessed])


def distance_to(thing: Box | Cylinder, points: Array) -> Array:
    """From the surface of a solid [m]."""
    if isinstance(thing, Cylinder):
        radial = np.hypot(points[:, 0] - thing.x, points[:, 1] - thing.y) - thing.radius
        level = np.abs(points[:, 2] - thing.height / 2) - thing.height / 2
        off = np.stack([radial, level], axis=-1)
    else:
        turned = (points - [thing.x, thing.y, thing.size[2] / 2]) @ rotation_exp(np.array([0.0, 0.0, thing.yaw]))
        off = np.abs(turned) - np.array(thing.size) / 2
    return np.abs(np.linalg.norm(np.maximum(off, 0), axis=-1) + np.minimum(off.max(axis=-1), 0))


def centre_of(thing: Box | Cylinder) -> Array:
    height = thing.height if isinstance(thing, Cylinder) else thing.size[2]
    return np.array([thing.x, thing.y, height / 2])


@pytest.mark.parametrize("thing", [CAN, CARTON, LYING])
def test_the_far_side_is_where_it_is_and_the_centre_of_mass_moves_there(thing: Box | Cylinder) -> None:
    before, after = scene_of(thing, complete=False), scene_of(thing)
    errors = [np.linalg.norm(scene.centre_of_mass - centre_of(thing)) for scene in (before, after)]
    assert errors[0] > 0.015  # too near to the camera
    assert errors[1] < 0.006
    far = guessed(after)
    assert np.percentile(distance_to(thing, far.points), 90) < 0.006
    outward = far.points - centre_of(thing)
    assert far.normals is not None
    assert np.mean(np.sum(far.normals * outward, axis=-1) > 0) > 0.95
    np.testing.assert_allclose(np.linalg.norm(far.normals, axis=-1), 1.0, atol=1e-6)
    # It closes the object: sides that the camera did not see have points now.
    assert far.points[:, 1].max() > before.target.points[:, 1].max() - 0.005


def test_what_was_seen_stays_as_it_was() -> None:
    before, after = scene_of(CARTON, complete=False), scene_of(CARTON)
    assert before.is_guessed is None
    assert after.is_guessed is not None
    np.testing.assert_array_equal(after.target.points[~after.is_guessed], before.target.points)
    assert completed(after) is after


@pytest.mark.parametrize("thing", [CAN, CARTON, CUP])
def test_nothing_is_guessed_where_the_camera_saw_free_space(thing: Box | Cylinder) -> None:
    scene = scene_of(thing)
    assert scene.view is not None
    assert scene.is_guessed is not None
    lines = sight_lines(scene.view, scene.target.points[~scene.is_guessed], 2 * HAND_REACH)
    assert lines is not None
    ahead = lines.beyond(guessed(scene).points)
    assert np.all(~(ahead > 0.006))


@pytest.mark.parametrize("thing", [CAN, CARTON, CUP])
def test_places_in_doubt_are_hidden_and_beside_the_object(thing: Box | Cylinder) -> None:
    scene = scene_of(thing)
    assert scene.view is not None
    assert len(scene.doubtful) > 100
    lines = sight_lines(scene.view, scene.seen_points, 2 * HAND_REACH)
    assert lines is not None
    assert np.all(~(lines.beyond(scene.doubtful) > 0.006))
    apart = KDTree(scene.target.points).query(scene.doubtful)[0]
    assert np.percentile(apart, 95) < 0.02
    assert len(scene_of(thing, complete=False).doubtful) == 0


def test_a_cup_stays_open() -> None:
    far = guessed(scene_of(CUP, elevation=50))
    off_axis = np.hypot(far.points[:, 0] - CUP.x, far.points[:, 1] - CUP.y)
    inside = (off_axis < CUP.radius - 0.015) & (far.points[:, 2] > 0.02)
    assert np.mean(inside) < 0.1
    assert np.mean(np.abs(off_axis - CUP.radius) < 0.01) > 0.6


def test_what_is_nearer_to_another_thing_is_not_of_the_object() -> None:
    scene = scene_of(CARTON, complete=False)
    assert scene.view is not None
    assert scene.table is not None
    lines = sight_lines(scene.view, scene.target.points, 0.1)
    assert lines is not None
    alone = far_side(scene.target, scene.table, lines)
    low = scene.target.points[:, 2] < 0.05
    upper = PointCloud(scene.target.points[~low], scene.target.normals[~low])  # type: ignore[index]
    on_top = far_side(upper, scene.table, lines, scene.target.points[low])
    assert alone is not None
    assert on_top is not None
    assert alone.guessed.points[:, 2].min() < 0.01
    assert np.mean(on_top.guessed.points[:, 2] > 0.035) > 0.95
    assert on_top.centre_of_mass[2] > alone.centre_of_mass[2] + 0.015


def test_without_a_table_or_a_sensor_nothing_is_guessed() -> None:
    scene = scene_of(CAN, complete=False)
    assert scene.view is not None
    assert completed(replace(scene, table=None)).is_guessed is None
    assert completed(replace(scene, view=None)).is_guessed is None
    assert completed(replace(scene, view=replace(scene.view, origin=None))).is_guessed is None


def test_sight_lines_tell_free_from_hidden() -> None:
    scene = scene_of(CAN, complete=False)
    assert scene.view is not None
    assert scene.sensor_origin is not None
    lines = sight_lines(scene.view, scene.target.points, 0.1)
    assert lines is not None
    points = scene.target.points[::10]
    ray = points - scene.sensor_origin
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    assert np.mean(lines.beyond(points - 0.03 * ray) > 0.015) > 0.95
    assert np.mean(lines.beyond(points + 0.03 * ray) < -0.015) > 0.9
    behind_the_camera = scene.sensor_origin - 0.1 * ray[:5]
    assert np.isnan(lines.beyond(behind_the_camera)).all()


def test_other_things_reach_down_to_the_table_where_nobody_saw() -> None:
    carton = Box(0.0, 0.06, (0.1, 0.04, 0.1))
    seen, both = (scene_of(IN_FRONT, carton, complete=complete, number=1) for complete in (False, True))
    assert seen.centre_of_mass[1] < 0  # the one of which less is seen
    more = both.obstacles.points[len(seen.obstacles.points) :]
    np.testing.assert_array_equal(both.obstacles.points[: len(seen.obstacles.points)], seen.obstacles.points)
    assert np.percentile(distance_to(carton, more), 80) < 0.008
    behind = more[:, 1] > 0.07
    assert np.mean(behind) > 0.3  # its back
    assert more[behind][:, 2].min() < 0.01


@pytest.mark.parametrize("elevation", [30, 45])
def test_what_overhangs_has_no_skirt_at_its_foot(elevation: float) -> None:
    pytest.importorskip("mujoco")
    from graspmatch.apps.bench.glimpse import glimpse_of
    from graspmatch.apps.bench.glimpse import scene_of as scene_of_glimpse
    from graspmatch.config import ViewConfig

    mesh = bowl().mesh
    view = ViewConfig(elevation=np.radians(elevation))
    scene = scene_of_glimpse(glimpse_of([mesh], np.eye(4), view, np.random.default_rng(0)))
    far, camera = guessed(scene).points, np.array([-1.0, 0.0])
    foot = np.linalg.norm(mesh.vertices[mesh.vertices[:, 2] < 0.006, :2], axis=-1).max()
    rim = np.linalg.norm(mesh.vertices[:, :2], axis=-1).max()
    assert rim > foot + 0.02
    in_front = (far[:, 2] < 0.008) & (far[:, :2] @ camera > foot + 0.012)
    assert not in_front.any()
