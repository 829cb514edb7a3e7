"""The ray tracer against what geometry says, and the layout of pictures of grasps."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from graspmatch.apps.picture import (
    Panel,
    beside,
    captioned,
    clearest_azimuth,
    contact_sheet,
    picture_of_grasps,
    point_cloud_bodies,
)
from graspmatch.apps.render import Body, Camera, camera_around, corner_normals, project, render, visible_shares
from graspmatch.errors import GraspmatchError
from graspmatch.geometry.mesh import TriangleMesh, concatenate, face_normals_areas
from graspmatch.geometry.se3 import from_parts, translation
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet, Gripper, Link, Plane, PointCloud, Provenance

RED, GREEN, BLUE = (0.8, 0.1, 0.1, 1.0), (0.1, 0.7, 0.1, 1.0), (0.1, 0.1, 0.8, 1.0)
TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
UP = np.array([0.0, 0.0, 1.0])
# At the origin of the world, looking along its x axis, z up.
AHEAD = Camera(from_parts(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3)), math.radians(40))


def ball(centre: tuple[float, float, float], radius: float) -> TriangleMesh:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return TriangleMesh(np.array(mesh.vertices) + centre, np.array(mesh.faces))


def block(centre: tuple[float, float, float], extents: tuple[float, float, float]) -> TriangleMesh:
    mesh = trimesh.creation.box(extents)
    return TriangleMesh(np.array(mesh.vertices) + centre, np.array(mesh.faces))


def wall(distance: float, rgba: tuple[float, float, float, float]) -> Body:
    """A plate across the view of `AHEAD`."""
    return Body(block((distance, 0, 0), (0.01, 2, 2)), rgba)


def linear(image: np.ndarray) -> np.ndarray:
    """Radiance, up to the renderer's soft shoulder, of display values."""
    value = image / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def coloured(image: np.ndarray) -> np.ndarray:
    """Where one channel stands out: the background and the table are nearly grey."""
    return np.ptp(image.astype(int), axis=-1) > 60


def test_silhouette_of_a_sphere_has_the_size_and_place_of_its_projection(device: str) -> None:
    size, radius, distance = (180, 120), 0.1, 0.5
    image = render([Body(ball((distance, 0, 0), radius), RED)], camera=AHEAD, size=size, device=device)
    focal = size[1] / 2 / math.tan(AHEAD.fov / 2)
    expected = math.pi * (focal * math.tan(math.asin(radius / distance))) ** 2
    inside = linear(image)[..., 2] < 0.4  # half way between the ball and the background
    assert inside.sum() / expected == pytest.approx(1.0, abs=0.02)
    rows, columns = np.nonzero(inside)
    centre = project(AHEAD, np.array([[distance, 0.0, 0.0]]), size)[0]
    np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], centre, atol=0.2)


def test_left_is_left_and_up_is_up() -> None:
    bodies = [Body(ball((0.5, 0.1, 0), 0.03), RED), Body(ball((0.5, 0, 0.1), 0.03), GREEN)]
    image = render(bodies, camera=AHEAD, size=(60, 60)).astype(int)
    left = np.argwhere(image[..., 0] > image[..., 1] + 60).mean(axis=0)
    top = np.argwhere(image[..., 1] > image[..., 0] + 60).mean(axis=0)
    assert left[1] < 25
    assert 25 < left[0] < 35
    assert top[0] < 25
    assert 25 < top[1] < 35


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_body_hides_the_other(order: int) -> None:
    bodies = [wall(0.5, RED), wall(0.7, GREEN)][::order]
    centre = render(bodies, camera=AHEAD, size=(12, 8))[4, 6].astype(int)
    assert centre[0] > centre[1] + 60
    assert visible_shares(bodies, [AHEAD])[0].tolist() == [1.0, 0.0][::order]


def brightness_at(image: np.ndarray, camera: Camera, point: tuple[float, float, float]) -> float:
    """Mean radiance of the 3 x 3 pixels around a world point."""
    size = (image.shape[1], image.shape[0])
    x, y = project(camera, np.array([point]), size)[0].astype(int)
    return float(linear(image)[y - 1 : y + 2, x - 1 : x + 2].mean())


@pytest.mark.parametrize(("alpha", "casts"), [(1.0, True), (0.3, False)])
def test_bodies_cast_shadows_away_from_the_light_and_ghosts_cast_none(alpha: float, casts: bool) -> None:
    camera = camera_around(np.array([[-0.15, -0.15, 0.0], [0.15, 0.15, 0.1]]), 0.0, 35.0)
    cube = Body(block((0, 0, 0.05), (0.1, 0.1, 0.1)), (0.8, 0.1, 0.1, alpha))
    image = render([cube], camera=camera, size=(150, 100), table=TABLE)
    # The light stands at the upper left behind the camera, which is on +x: y is to the right.
    lit, shaded = (brightness_at(image, camera, (-0.03, y, 0.0)) for y in (-0.09, 0.09))
    assert shaded < 0.75 * lit if casts else shaded > 0.95 * lit


def test_the_table_darkens_towards_a_contact() -> None:
    camera = camera_around(np.array([[-0.2, -0.2, 0.0], [0.2, 0.2, 0.1]]), 0.0, 35.0)
    image = render([Body(block((0, 0, 0.05), (0.1, 0.1, 0.1)), RED)], camera=camera, size=(150, 100), table=TABLE)
    # On the lit side, where only the sky is hidden by the block.
    near, middle, far = (brightness_at(image, camera, (0.0, y, 0.0)) for y in (-0.06, -0.09, -0.16))
    assert near < middle < far


def test_a_ghost_blends_in_proportion_to_its_alpha() -> None:
    def seen(alpha: float) -> np.ndarray:
        bodies = [wall(0.7, RED), wall(0.5, (0.1, 0.1, 0.8, alpha))]
        return linear(render(bodies, camera=AHEAD, size=(12, 8))[4, 6])

    quarter, half, three_quarters = seen(0.25), seen(0.5), seen(0.75)
    assert quarter[0] > half[0] > three_quarters[0]
    assert quarter[2] < half[2] < three_quarters[2]
    np.testing.assert_allclose(half, (quarter + three_quarters) / 2, atol=0.006)  # values are rounded to 1/255


def test_ghosts_behind_something_are_not_seen_and_nearer_ghosts_lie_on_top() -> None:
    def centre(*bodies: Body) -> list[int]:
        return render(list(bodies), camera=AHEAD, size=(12, 8))[4, 6].tolist()

    ghost_green, ghost_blue = (0.1, 0.7, 0.1, 0.8), (0.1, 0.1, 0.8, 0.8)
    hidden, bare = centre(wall(0.5, RED), wall(0.6, ghost_blue)), centre(wall(0.5, RED))
    np.testing.assert_allclose(hidden, bare, atol=1)  # the scene is larger with the ghost, and light follows its size
    _red, green, blue = centre(wall(0.7, RED), wall(0.5, ghost_green), wall(0.6, ghost_blue))
    assert green > blue
    _red, green, blue = centre(wall(0.7, RED), wall(0.6, ghost_green), wall(0.5, ghost_blue))
    assert blue > green


def test_the_picture_does_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    bodies = [Body(ball((0, 0, 0.05), 0.05), RED), Body(block((0.1, 0, 0.02), (0.04, 0.04, 0.04)), GREEN)]
    camera = camera_around(bodies, 30.0)
    images = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("GRASPMATCH_THREADS", threads)
        images.append(render(bodies, camera=camera, size=(90, 61), table=TABLE))
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_array_equal(images[0], images[2])


def test_smooth_surfaces_show_no_noise() -> None:
    image = linear(render([Body(ball((0.5, 0, 0), 0.1), RED)], camera=AHEAD, size=(180, 120)))
    middle = image[45:75, 75:105, 0]
    bend = np.abs(np.diff(middle, n=2, axis=1))
    assert bend.max() < 0.03 * middle.mean()


def test_nothing_to_show_is_a_picture_of_the_background() -> None:
    image = render([], camera=AHEAD, size=(12, 8))
    assert image.shape == (8, 12, 3)
    assert image.min() > 180
    with pytest.raises(GraspmatchError, match="0 x 8"):
        render([], camera=AHEAD, size=(0, 8))


def test_corner_normals_are_radial_on_a_sphere_and_flat_on_a_box() -> None:
    sphere = ball((0, 0, 0), 1.0)
    np.testing.assert_allclose(corner_normals(sphere), sphere.vertices[sphere.faces], atol=0.02)
    cube = block((0, 0, 0), (1, 2, 3))
    np.testing.assert_allclose(corner_normals(cube), np.repeat(face_normals_areas(cube)[0][:, None], 3, axis=1))


def test_corner_normals_join_vertices_at_the_same_place() -> None:
    sphere = ball((0, 0, 0), 1.0)
    soup = TriangleMesh(sphere.vertices[sphere.faces].reshape(-1, 3), np.arange(3 * len(sphere.faces)).reshape(-1, 3))
    np.testing.assert_allclose(corner_normals(soup), corner_normals(sphere), atol=1e-12)


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 25), (130, 5), (-75, 60), (10, 90)])
@pytest.mark.parametrize("aspect", [0.6, 2.0])
def test_a_camera_frames_what_it_is_given_tightly(azimuth: float, elevation: float, aspect: float) -> None:
    body = Body(block((0.3, -0.2, 0.7), (0.1, 0.4, 0.2)), RED)
    camera = camera_around([body], azimuth, elevation, aspect=aspect, margin=0.1)
    share = project(camera, body.mesh.vertices, (1000, round(1000 / aspect))) / [1000, round(1000 / aspect)]
    assert share.min() > 0.099
    assert share.max() < 0.901
    np.testing.assert_allclose(share.min(axis=0) + share.max(axis=0), 1.0, atol=0.25)
    assert np.ptp(share, axis=0).max() > 0.75


def test_a_camera_stands_where_its_azimuth_says() -> None:
    bounds = np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]])
    position = camera_around(bounds, 90.0, 0.0).T_world_camera[:3, 3]
    assert position[1] > 0.2
    np.testing.assert_allclose(position[[0, 2]], 0.0, atol=1e-9)
    sideways = camera_around(bounds, 0.0, 80.0, up=np.array([0.0, 1.0, 0.0])).T_world_camera[:3, 3]
    assert sideways[1] > 0.9 * np.linalg.norm(sideways)


def test_the_clearest_view_is_not_through_the_hand() -> None:
    target = Body(ball((0, 0, 0.05), 0.04), RED)
    hand = [Body(block((0.08, 0, 0.08), (0.02, 0.3, 0.16)), GREEN)]
    azimuth = clearest_azimuth(target, hand, [], UP)
    assert math.cos(math.radians(azimuth)) < 0.3


def test_a_cloud_becomes_spheres_around_its_points() -> None:
    points = np.array([[0.0, 0, 0], [1, 2, 3], [-1, 0, 5]])
    mesh = point_cloud_bodies(points, 0.1).mesh
    assert mesh.faces.shape == (60, 3)
    corners = mesh.vertices.reshape(3, 12, 3) - points[:, None]
    np.testing.assert_allclose(np.linalg.norm(corners, axis=-1), 0.1)
    normals, areas = face_normals_areas(mesh)
    outward = mesh.vertices[mesh.faces].mean(axis=1) - np.repeat(points, 20, axis=0)
    assert (np.sum(normals * outward, axis=-1) > 0.07).all()
    np.testing.assert_allclose(areas, areas[0])


def test_captions_are_drawn_in_the_lower_left_corner() -> None:
    plain = np.full((120, 200, 3), 240, dtype=np.uint8)
    changed = np.argwhere((captioned(Panel(plain, "1   pinch")) != plain).any(axis=-1))
    assert len(changed) > 30
    assert changed[:, 0].min() > 90
    assert changed[:, 1].max() < 120
    np.testing.assert_array_equal(captioned(Panel(plain)), plain)


def test_a_contact_sheet_puts_panels_in_rows() -> None:
    panels = [Panel(np.full((20, 30, 3), 10 * i, dtype=np.uint8)) for i in range(5)]
    sheet = contact_sheet(panels, columns=2)
    assert sheet.shape == (3 * 20 + 2 * 6, 2 * 30 + 6, 3)
    assert sheet[30, 40, 0] == 30
    assert sheet[60, 40, 0] == 255
    assert beside(panels[0], []).shape == (20, 30, 3)
    with pytest.raises(GraspmatchError, match="at least one"):
        contact_sheet([], columns=2)


def block_hand() -> Gripper:
    """Two plates that slide along y, enough of a hand to be drawn."""
    plate = block((0, 0, 0.05), (0.02, 0.01, 0.1))
    links = tuple(Link(name, plate, plate, BLUE) for name in ("left", "right"))
    zero, one = np.zeros(1), np.ones(1)
    return Gripper(
        name="blocks",
        description=Path("blocks.xml"),
        base_link="left",
        joint_names=("slide",),
        lower=zero,
        upper=one,
        open_joints=one,
        closed_joints=zero,
        links=links,
        fingers=(),
        approach=np.array([0.0, 0.0, 1.0]),
        closing=np.array([0.0, 1.0, 0.0]),
        tool_centre_point=np.array([0.0, 0.0, 0.1]),
        finger_force=10.0,
        opening=0.1,
        approach_distance=0.1,
        preshapes=(),
        content_hash="",
    )


def slide(joints: np.ndarray) -> np.ndarray:
    """Poses of the two plates."""
    return np.stack([translation(np.array([0.0, side * joints[0], 0.0])) for side in (1, -1)])


def grasps_from_above(n: int) -> GraspSet:
    grasp = np.tile(from_parts(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 0.15])), (n, 1, 1))
    return GraspSet(
        joint_names=("slide",),
        preshape_names=("pinch",),
        T_world_gripper=grasp,
        T_world_pregrasp=translation(np.array([0, 0, 0.08])) @ grasp,
        preshape=np.zeros(n, dtype=int),
        pregrasp_joints=np.full((n, 1), 0.05),
        grasp_joints=np.full((n, 1), 0.035),
        score=np.linspace(0.9, 0.5, n),
        clearance=np.full(n, 0.01),
        matching_error=np.full(n, 1e-6),
        loss=np.full(n, 1e-6),
        quality=np.full(n, 1e-6),
        fingers_touching=np.full(n, 2),
        tally={"candidates": n},
        provenance=Provenance("blocks", "", "{}", 0, "cpu", "0"),
    )


@pytest.mark.parametrize(("found", "count"), [(1, 4), (2, 4), (9, 4), (9, 1)])
def test_a_picture_of_grasps_has_the_size_asked_for_and_shows_object_and_hand(
    found: int, count: int, tmp_path: Path
) -> None:
    scene = Scene.from_mesh(ball((0, 0, 0.03), 0.03))
    path = tmp_path / "grasps.png"
    picture_of_grasps(
        scene, block_hand(), grasps_from_above(found), path, link_poses=slide, count=count, size=(160, 90)
    )
    image = np.array(Image.open(path)).astype(int)
    assert image.shape == (90, 160, 3)
    halves = [image] if min(found, count) == 1 else [image[:, :106], image[:, 112:]]
    for half in halves:
        assert (half[..., 0] > half[..., 2] + 50).any()  # the terracotta object
        assert (half[..., 2] > half[..., 0] + 50).any()  # the blue hand
    assert [file.name for file in tmp_path.iterdir()] == ["grasps.png"]


def test_without_grasps_the_picture_shows_the_scene_and_says_so(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(2000, 3))
    cloud = 0.05 * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    scene = Scene.from_cloud(cloud, obstacles=PointCloud(cloud[:100] * 0.3 + [0.15, 0, 0]))
    picture_of_grasps(
        scene, block_hand(), grasps_from_above(0), tmp_path / "none.png", link_poses=slide, size=(150, 100)
    )
    image = np.array(Image.open(tmp_path / "none.png")).astype(int)
    assert coloured(image)[20:80, 50:100].mean() > 0.3
    assert (image[85:, :60].max(axis=-1) < 120).any()  # ink of the caption


@pytest.mark.parametrize("name", ["missing/grasps.png", "folder"])
def test_a_path_that_cannot_be_written_is_an_error_and_leaves_nothing(name: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    scene = Scene.from_mesh(ball((0, 0, 0.03), 0.03))
    with pytest.raises(GraspmatchError, match="Cannot write"):
        picture_of_grasps(scene, block_hand(), grasps_from_above(0), tmp_path / name, link_poses=slide, size=(30, 20))
    assert [file.name for file in tmp_path.iterdir()] == ["folder"]


def test_overlapping_parts_of_one_ghost_count_once() -> None:
    plate = wall(0.5, BLUE).mesh
    once = Body(plate, (0.1, 0.1, 0.8, 0.4))
    twice = Body(concatenate([plate, block((0.55, 0, 0), (0.01, 2, 2))]), (0.1, 0.1, 0.8, 0.4))
    images = [render([wall(0.7, RED), ghost], camera=AHEAD, size=(12, 8)) for ghost in (once, twice)]
    np.testing.assert_array_equal(images[0], images[1])
