"""The table and the things on it, in scenes made by code and in real captures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from depth_scenes import SHAPE, Box, Cylinder, K, Setting, camera_at, noisy, render
from graspmatch.errors import GraspmatchError
from graspmatch.geometry.se3 import apply, from_parts, rotation_exp
from graspmatch.scene.camera import Camera
from graspmatch.scene.depth import depth_image
from graspmatch.scene.plane import find_plane
from graspmatch.scene.read import CloudFile
from graspmatch.scene.scene import Scene
from graspmatch.scene.segment import NOTHING, TABLE, Segmentation, segment
from graspmatch.scene.view import View, view_of_cloud, view_of_depth
from graspmatch.types import Plane
from segmentation import FOOT, Labelled, above, agreement, captures

Array = np.ndarray

CAN = Cylinder(0.05, 0.05, 0.035, 0.12)
THREE = Setting((Box(-0.15, 0, (0.06, 0.1, 0.12), 0.3), CAN, Box(0.2, -0.05, (0.1, 0.06, 0.05), 1)))
SETTINGS = {
    "apart": THREE,
    "small table": Setting((Cylinder(0, 0, 0.035, 0.12),), table=(0.25, 0.2)),
    "table half hidden": Setting((Box(0, -0.05, (0.35, 0.2, 0.15)), Cylinder(0.25, 0, 0.03, 0.1)), table=(0.7, 0.4)),
    "from above": replace(THREE, camera=camera_at(88, 0.7)),
    "from afar": replace(THREE, camera=camera_at(40, 1.3)),
    "nearly level": replace(THREE, camera=camera_at(18, 0.6)),
    "before a wall": replace(THREE, wall=0.5, camera=camera_at(25, 0.7)),
    "cup and box": Setting((Cylinder(0, 0, 0.04, 0.1, is_hollow=True), Box(0.1, 0, (0.05, 0.05, 0.1)))),
    "cup from above": Setting((Cylinder(0, 0, 0.04, 0.1, is_hollow=True),), camera=camera_at(65, 0.6)),
    "two cans touch": Setting((Cylinder(-0.035, 0, 0.035, 0.12), Cylinder(0.035, 0, 0.035, 0.1))),
    "a box on a box": Setting((Box(0, 0, (0.2, 0.15, 0.08)), Box(0.02, 0.0, (0.1, 0.08, 0.07), 0.3, z=0.08))),
    "flat things": Setting((Box(0, 0, (0.1, 0.06, 0.012)), Box(0.15, 0, (0.09, 0.06, 0.01)))),
}
LEAST_OVERLAP = 0.8
"""Intersection over union of each thing in noise, its foot of some millimetres missing."""


def view_of(setting: Setting, *, seed: int = 0, is_placed: bool = True) -> tuple[View, Array]:
    """What a cheap camera sees of a setting, and the thing of each pixel."""
    true, ids = render(setting)
    camera = setting.camera if is_placed else Camera(K)
    return view_of_depth(depth_image(noisy(true, np.random.default_rng(seed)), camera)), ids


def overlaps(found: Segmentation, ids: Array) -> list[float]:
    """How well each thing was found."""
    everywhere = np.ones(ids.size, dtype=bool)
    return [agreement(found, (ids == thing).ravel(), everywhere) for thing in range(ids.max() + 1)]


@pytest.mark.parametrize("is_placed", [True, False], ids=["pose known", "pose unknown"])
@pytest.mark.parametrize("name", list(SETTINGS))
def test_every_thing_is_found_and_nothing_else(name: str, is_placed: bool) -> None:
    view, ids = view_of(SETTINGS[name], is_placed=is_placed)
    found = segment(view)
    assert len(found) == len(SETTINGS[name].things)
    assert min(overlaps(found, ids)) > LEAST_OVERLAP


@pytest.mark.parametrize("is_placed", [True, False])
@pytest.mark.parametrize("name", ["apart", "small table", "before a wall", "from afar"])
def test_the_table_is_where_it_is(name: str, is_placed: bool) -> None:
    view, _ = view_of(SETTINGS[name], is_placed=is_placed)
    table = segment(view).table
    T = SETTINGS[name].camera.pose
    assert table is not None
    assert np.degrees(np.arccos(table.normal @ T[2, :3])) < 0.5
    assert table.offset == pytest.approx(-T[2, 3], abs=0.003)


def test_a_tilted_table_is_found_and_a_steep_one_is_no_table() -> None:
    view, _ = view_of(THREE)
    for degrees, is_found in ((15, True), (50, False)):
        turned = rotation_exp(np.radians([degrees, 0.0, 0.0])) @ view.T_world_view[:3, :3]
        tilted = replace(view, up=turned[2])
        if is_found:
            assert len(segment(tilted)) == 3
        else:
            with pytest.raises(GraspmatchError, match=r"No support plane|Nothing stands"):
                segment(tilted)


def test_nothing_changes_with_the_order_of_a_cloud() -> None:
    view, ids = view_of(THREE)
    points = apply(view.T_world_view, view.points[view.is_seen].astype(float))
    order = np.random.default_rng(0).permutation(len(points))
    origin = view.T_world_view[:3, 3]
    found = segment(view_of_cloud(CloudFile(points[order]), sensor_origin=origin))
    assert len(found) == 3
    labels = np.empty(len(points), dtype=int)
    labels[order] = found.labels
    things = ids.ravel()[view.is_seen]
    for thing in range(3):
        values, counts = np.unique(labels[things == thing], return_counts=True)
        assert counts[values >= 0].max() > 0.85 * counts.sum()


def test_the_labels_say_table_and_nothing_too() -> None:
    view, ids = view_of(THREE)
    labels = segment(view).labels
    assert np.all(labels[~view.is_seen] == NOTHING)
    below = view.is_seen & (ids.ravel() == -1)
    assert np.mean(labels[below] == TABLE) > 0.99


def test_a_thing_is_picked_by_number_pixel_and_mask_alike() -> None:
    depth = noisy(render(THREE)[0], np.random.default_rng(0))
    ids = render(THREE)[1]
    rows, columns = np.nonzero(ids == 1)
    pixel = (float(np.median(columns)), float(np.median(rows)))
    by_pixel = Scene.from_depth(depth, THREE.camera, at=pixel, complete=False)
    by_mask = Scene.from_depth(depth, THREE.camera, mask=(ids == 1), complete=False)
    by_number = [Scene.from_depth(depth, THREE.camera, object=number, complete=False) for number in range(3)]
    numbered = min(by_number, key=lambda scene: float(np.linalg.norm(scene.centre_of_mass - by_pixel.centre_of_mass)))
    for scene in (by_pixel, by_mask, numbered):
        np.testing.assert_allclose(scene.centre_of_mass[:2], [CAN.x, CAN.y], atol=0.03)
        np.testing.assert_allclose(scene.centre_of_mass, by_pixel.centre_of_mass, atol=0.003)


def test_the_values_of_a_mask_are_the_numbers_of_its_objects() -> None:
    depth, ids = render(THREE)
    mask = np.where(ids == 0, 7, np.where(ids == 2, 40, 0)).astype(np.uint8)
    scene = Scene.from_depth(depth, THREE.camera, mask=mask, object=40)
    np.testing.assert_allclose(scene.centre_of_mass[:2], [0.2, -0.05], atol=0.03)
    with pytest.raises(GraspmatchError, match=r"no object 1\. Found: 7: .* 40: "):
        Scene.from_depth(depth, THREE.camera, mask=mask, object=1)


def test_a_mask_that_reaches_over_the_edge_marks_the_object_only() -> None:
    depth, ids = render(Setting(THREE.things[:2], table=(0.5, 0.4)))
    wide = np.zeros(SHAPE, dtype=bool)
    rows, columns = np.nonzero(ids == 1)
    wide[rows.min() - 15 : rows.max() + 15, columns.min() - 15 : columns.max() + 15] = True
    scene = Scene.from_depth(depth, THREE.camera, mask=wide)
    assert np.ptp(scene.target.points, axis=0).max() < 0.15


def test_a_scene_is_in_the_world_of_the_camera_pose() -> None:
    depth = noisy(render(THREE)[0], np.random.default_rng(0))
    scene = Scene.from_depth(depth, THREE.camera, at=pixel_of(THREE, np.array([0.05, 0.05, 0.06])))
    assert scene.table is not None
    np.testing.assert_allclose(scene.table.normal, [0, 0, 1], atol=0.01)
    assert scene.table.offset == pytest.approx(0, abs=0.003)
    assert scene.sensor_origin is not None
    np.testing.assert_allclose(scene.sensor_origin, THREE.camera.pose[:3, 3])
    from_axis = np.hypot(*(scene.target.points[:, :2] - [CAN.x, CAN.y]).T)
    is_side = scene.target.points[:, 2] < 0.11
    assert np.median(np.abs(from_axis[is_side] - CAN.radius)) < 0.0015


def test_normals_look_at_the_camera_and_others_are_obstacles() -> None:
    depth = noisy(render(THREE)[0], np.random.default_rng(0))
    scene = Scene.from_depth(depth, THREE.camera, at=pixel_of(THREE, np.array([0.05, 0.05, 0.06])), complete=False)
    assert scene.target.normals is not None
    assert scene.sensor_origin is not None
    assert scene.view is not None
    towards = scene.sensor_origin - scene.target.points
    assert np.all(np.einsum("ni,ni->n", scene.target.normals, towards) >= 0)
    for thing in (THREE.things[0], THREE.things[2]):
        near = np.linalg.norm(scene.obstacles.points[:, :2] - [thing.x, thing.y], axis=1) < 0.07
        assert np.count_nonzero(near) > 100
    gap = np.linalg.norm(scene.obstacles.points[:, :2] - [CAN.x, CAN.y], axis=1)
    assert gap.min() > CAN.radius  # nothing of the target is in its own way
    assert scene.obstacles.points[:, 2].min() > 0.001  # nor is the table


def test_moving_the_camera_frame_moves_the_scene() -> None:
    depth = noisy(render(THREE)[0], np.random.default_rng(0))
    T = from_parts(rotation_exp(np.array([0.0, 0.0, 1.0])), np.array([2.0, -1.0, 0.3]))
    here = Scene.from_depth(depth, THREE.camera, object=0)
    there = Scene.from_depth(depth, THREE.camera.placed(T @ THREE.camera.pose), object=0)
    np.testing.assert_allclose(there.centre_of_mass, apply(T, here.centre_of_mass[None])[0], atol=2e-4)
    assert there.table is not None
    assert there.table.offset == pytest.approx(0.3, abs=0.003)


def test_a_given_plane_is_the_table() -> None:
    depth, _ = render(THREE)
    plane = Plane(np.array([0.0, 0.0, 2.0]), 0.0)
    scene = Scene.from_depth(depth, THREE.camera, table=plane, object=0)
    assert scene.table is not None
    np.testing.assert_allclose(scene.table.normal, [0, 0, 1], atol=1e-6)
    assert Scene.from_depth(depth, THREE.camera, table=None, object=0).table is None


REFUSED: dict[str, tuple[Callable[[Array, Array], object], str]] = {
    "no intrinsics": (lambda depth, ids: Scene.from_depth(depth), "needs the camera's intrinsics"),
    "unknown number": (lambda depth, ids: Scene.from_depth(depth, THREE.camera, object=9), "no object 9. Found: 0:"),
    "pixel on the table": (lambda depth, ids: Scene.from_depth(depth, THREE.camera, at=(20, 400)), "no object at the"),
    "pixel outside": (lambda depth, ids: Scene.from_depth(depth, THREE.camera, at=(700, 10)), "is no pixel"),
    "number and pixel": (lambda depth, ids: Scene.from_depth(depth, THREE.camera, at=(1, 1), object=0), "one of them"),
    "mask of another size": (
        lambda depth, ids: Scene.from_depth(depth, THREE.camera, mask=(ids == 0)[::2]),
        "640 x 240 pixels, the view 640 x 480",
    ),
    "empty mask": (lambda depth, ids: Scene.from_depth(depth, THREE.camera, mask=ids > 9), "zero everywhere"),
    "mask of the table": (
        lambda depth, ids: Scene.from_depth(depth, THREE.camera, mask=ids == -1),
        "Of what the mask marks",
    ),
    "table elsewhere": (
        lambda depth, ids: Scene.from_depth(depth, THREE.camera, table=0.4, correct="off"),
        "No point lies within 2 cm",
    ),
    "mask without rows": (
        lambda depth, ids: Scene.from_view(np.random.default_rng(0).random((500, 3)), mask=np.ones((9, 9), dtype=bool)),
        "no rows and columns",
    ),
}


@pytest.mark.parametrize("name", list(REFUSED))
def test_what_cannot_be_done_is_said(name: str) -> None:
    depth, ids = render(THREE)
    call, expected = REFUSED[name]
    with pytest.raises(GraspmatchError, match=expected):
        call(depth, ids)


def test_an_empty_table_is_said() -> None:
    with pytest.raises(GraspmatchError, match="Nothing stands on the support plane"):
        segment(view_of(Setting((), floor=None))[0])


def test_a_scene_without_a_plane_is_said() -> None:
    ball = np.random.default_rng(0).normal(size=(20000, 3))
    ball *= 0.04 / np.linalg.norm(ball, axis=1, keepdims=True)
    with pytest.raises(GraspmatchError, match="No support plane was found"):
        find_plane(ball)


def pixel_of(setting: Setting, point_world: Array) -> tuple[float, float]:
    """Column and row that see a point."""
    T = np.linalg.inv(setting.camera.pose)
    x, y, z = K @ (T[:3, :3] @ point_world + T[:3, 3])
    return float(x / z), float(y / z)


@pytest.fixture(scope="module")
def real() -> dict[str, Labelled]:
    """The captures, by name."""
    from segmentation import CAPTURES

    if not CAPTURES.is_dir():
        pytest.skip("needs the captures of ../shared/data, which are not part of the repository")
    return {capture.name: capture for capture in captures()}


@pytest.mark.parametrize(
    ("name", "count"),
    [("blue_mug", 1), ("mustard", 1), ("white_bowl", 1), ("test0", 2), ("test11", 3), ("table_mug", 1)],
)
def test_real_captures_have_the_objects_that_people_see(name: str, count: int, real: dict[str, Labelled]) -> None:
    assert len(segment(real[name].view)) == count


@pytest.mark.parametrize("name", ["test0", "test11"])
def test_objects_agree_with_hand_made_labels(name: str, real: dict[str, Labelled]) -> None:
    capture = real[name]
    found = segment(capture.view)
    assert min(agreement(found, marked, capture.view.is_seen) for marked in capture.objects) > 0.98


@pytest.mark.parametrize("name", ["blue_mug", "mustard", "white_bowl"])
def test_objects_agree_with_their_authors_clouds_above_the_foot(name: str, real: dict[str, Labelled]) -> None:
    capture = real[name]
    found = segment(capture.view)
    assert agreement(found, capture.objects[0], above(found, capture.view, FOOT)) > 0.99
    assert agreement(found, capture.objects[0], capture.view.is_seen) > 0.83  # they leave out the bottom of the bowl


def test_a_cloud_of_an_object_alone_has_no_table(real: dict[str, Labelled]) -> None:
    from segmentation import CAPTURES

    with pytest.raises(GraspmatchError, match="a cloud of the object alone"):
        Scene.from_view(CAPTURES / "gpd" / "krylon.pcd")
    assert len(Scene.from_cloud(CAPTURES / "gpd" / "krylon.pcd").target.points) > 1000


def test_boxes_in_a_pile_stay_apart_where_creases_are_seen() -> None:
    heights = {(i, j): 0.04 + 0.03 * ((i + 2 * j) % 3) for i, j in product((-1, 0, 1), repeat=2)}
    pile = Setting(tuple(Box(0.07 * i, 0.06 * j, (0.06, 0.05, h), 0.4 * i + j) for (i, j), h in heights.items()))
    scores = []
    for seed in range(3):
        view, ids = view_of(pile, seed=seed)
        found = segment(view)
        large = [thing for thing in range(9) if np.count_nonzero(ids == thing) > 1500]
        scores += [overlap for thing, overlap in enumerate(overlaps(found, ids)) if thing in large]
    assert len(scores) >= 9
    assert np.median(scores) > 0.8


@pytest.mark.parametrize("knows_sensor", [True, False])
def test_a_cloud_in_a_robot_frame_has_its_table_level(knows_sensor: bool) -> None:
    view, _ = view_of(THREE)
    height = np.array([0.3, 0.1, 0.75])
    points = apply(view.T_world_view, view.points[view.is_seen].astype(float)) + height
    points = points[points[:, 2] > 0.5]  # no floor: all in front of the origin, as if a camera were there
    sensor = view.T_world_view[:3, 3] + height if knows_sensor else None
    found = segment(view_of_cloud(CloudFile(points), sensor_origin=sensor))
    assert found.table is not None
    np.testing.assert_allclose(found.table.normal, [0, 0, 1], atol=0.02)
    assert len(found) == 3


def test_gravity_alone_tells_a_table_from_a_wall() -> None:
    setting = replace(THREE, wall=0.25, camera=camera_at(12, 0.7))
    depth = noisy(render(setting)[0], np.random.default_rng(0))
    up_camera = setting.camera.pose[2, :3]
    scene = Scene.from_depth(depth, K, up=up_camera, object=0)
    assert scene.table is not None
    assert np.degrees(np.arccos(scene.table.normal @ up_camera)) < 1


def test_a_cloud_in_millimetres_is_refused_until_it_is_said() -> None:
    view, _ = view_of(THREE)
    cloud = CloudFile(1000 * view.points.astype(float), shape=SHAPE)
    with pytest.raises(GraspmatchError, match="--unit mm"):
        view_of_cloud(cloud)
    assert len(segment(view_of_cloud(cloud, scale=0.001, sensor_origin=np.zeros(3)))) == 3


def a_setting(rng: np.random.Generator) -> Setting:
    """One to six boxes, cans and cups at least a hand's breadth apart, seen from anywhere in front."""
    things: list[Box | Cylinder] = []
    count = int(rng.integers(1, 7))
    while len(things) < count:
        x, y = float(rng.uniform(-0.25, 0.25)), float(rng.uniform(-0.2, 0.2))
        if any(np.hypot(x - thing.x, y - thing.y) < 0.11 for thing in things):
            continue
        if rng.random() < 0.5:
            a, b, c = rng.uniform(0.03, 0.1, 3)
            things.append(Box(x, y, (float(a), float(b), float(c)), float(rng.uniform(0, 3))))
        else:
            radius, height = float(rng.uniform(0.02, 0.05)), float(rng.uniform(0.04, 0.2))
            things.append(Cylinder(x, y, radius, height, is_hollow=bool(rng.random() < 0.4)))
    return Setting(tuple(things), camera=camera_at(float(rng.uniform(20, 80)), float(rng.uniform(0.5, 1.1))))


def test_scenes_at_random_are_taken_apart() -> None:
    scores = []
    for seed in range(12):
        view, ids = view_of(a_setting(np.random.default_rng(seed)), seed=seed, is_placed=bool(seed % 2))
        found = segment(view)
        visible = np.bincount(ids[ids >= 0].ravel())
        scores += [overlap for thing, overlap in enumerate(overlaps(found, ids)) if visible[thing] > 400]
    assert len(scores) > 30
    assert np.mean(np.array(scores) > LEAST_OVERLAP) > 0.9
