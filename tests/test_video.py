"""Frames of moving bodies against still pictures, and videos read back by their decoders."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest
import trimesh
from PIL import Image

from graspmatch.apps import video
from graspmatch.apps.film import draw_frame, prepare_film
from graspmatch.apps.render import Body, camera_around, render
from graspmatch.apps.video import film_strip, key_moments, write_video
from graspmatch.errors import GraspmatchError
from graspmatch.geometry.mesh import TriangleMesh, transformed
from graspmatch.geometry.se3 import from_parts, translation
from graspmatch.types import Link, Plane

TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
SIZE = (80, 60)
PHASES = ["approach"] * 3 + ["close"] * 3 + ["lift"] * 4 + ["hold"] * 5


def block(centre: tuple[float, float, float], extents: tuple[float, float, float]) -> TriangleMesh:
    mesh = trimesh.creation.box(extents)
    return TriangleMesh(np.array(mesh.vertices) + centre, np.array(mesh.faces))


def ball(radius: float) -> TriangleMesh:
    mesh = trimesh.creation.icosphere(3, radius)
    return TriangleMesh(np.array(mesh.vertices), np.array(mesh.faces))


BALL = ball(0.03)
PLATE = block((0, 0, 0.04), (0.02, 0.01, 0.08))
EMPTY = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
LINKS = [
    Link("palm", block((0, 0, 0.085), (0.03, 0.12, 0.02)), EMPTY, (0.2, 0.3, 0.8, 1.0)),
    Link("left", PLATE, PLATE, (0.2, 0.3, 0.8, 1.0)),
    Link("right", PLATE, PLATE, (0.2, 0.3, 0.8, 1.0)),
    Link("frame without a shape", EMPTY, EMPTY, (0.0, 0.0, 0.0, 1.0)),
]


def lift_of_a_ball() -> tuple[np.ndarray, np.ndarray]:
    """Poses of the links and of the ball, in as many frames as there are phases: down, close, up, wait."""
    down = [0.08, 0.04, 0.0] + [0.0] * 12
    closed = [0.0] * 3 + [0.3, 0.6] + [1.0] * 10
    up = np.array([0.0] * 6 + [0.02, 0.05, 0.08, 0.1] + [0.1] * 5)
    T_world_link = np.zeros((15, 4, 4, 4))
    for i in range(15):
        z = 0.01 + down[i] + up[i]
        sides = [0.0, 0.05 - 0.015 * closed[i], -0.05 + 0.015 * closed[i], 0.0]
        T_world_link[i] = translation(np.array([(0.0, y, z) for y in sides]))
    return T_world_link, translation(np.stack([0 * up, 0 * up, 0.03 + up], axis=-1))


def write(path: Path, **options) -> None:
    T_world_link, T_world_object = lift_of_a_ball()
    captions = [f"{phase} {i}" for i, phase in enumerate(PHASES)]
    options = {"fps": 25, "size": SIZE, "table": TABLE, **options}
    write_video(path, LINKS, BALL, T_world_link, T_world_object, captions, **options)


def read_gif(path: Path) -> tuple[list[np.ndarray], list[int]]:
    """Frames, and how long each is shown [ms]."""
    images, durations = [], []
    with Image.open(path) as image:
        for i in range(getattr(image, "n_frames", 1)):
            image.seek(i)
            images.append(np.array(image.convert("RGB")).astype(int))
            durations.append(image.info["duration"])
    return images, durations


def read_mp4(path: Path) -> tuple[list[np.ndarray], float]:
    """Frames and duration [s]."""
    with av.open(str(path)) as container:
        images = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
        return images, (container.duration or 0) / 1e6


def terracotta(image: np.ndarray) -> np.ndarray:
    """Where the object is."""
    return image[..., 0] > image[..., 2] + 40


def test_frames_look_like_still_pictures_wherever_the_bodies_have_moved(device: str) -> None:
    bodies = [Body(block((0, 0, 0), (0.1, 0.06, 0.04)), (0.8, 0.1, 0.1, 1.0)), Body(BALL, (0.1, 0.7, 0.1, 1.0))]
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    camera = camera_around(np.array([[-0.1, -0.15, 0.0], [0.1, 0.15, 0.12]]), 30.0, aspect=1.5)
    places = [
        np.stack([translation(np.array([0, -0.05, 0.02])), translation(np.array([0, 0.08, 0.04]))]),
        np.stack([from_parts(quarter, np.array([0, 0.09, 0.06])), translation(np.array([0.02, -0.08, 0.03]))]),
    ]
    film = None
    for T_world_body in places:
        still = [Body(transformed(body.mesh, T), body.rgba) for body, T in zip(bodies, T_world_body, strict=True)]
        points = np.concatenate([body.mesh.vertices for body in still])
        box = np.stack([points.min(axis=0), points.max(axis=0)])
        film = film or prepare_film(bodies, box, camera, size=(150, 100), table=TABLE, device=device)
        frame = draw_frame(film, T_world_body).astype(int)
        expected = render(still, camera=camera, size=(150, 100), table=TABLE, device=device).astype(int)
        difference = np.abs(frame - expected).max(axis=-1)
        assert np.mean(difference) < 3.0
        assert np.mean(difference > 30) < 0.02  # steps at edges, which still pictures smooth more widely


def test_a_body_beside_the_camera_does_not_keep_others_from_being_seen() -> None:
    camera = camera_around(np.array([[-0.05, -0.05, -0.05], [0.05, 0.05, 0.05]]), 0.0)
    bodies = [Body(BALL, (0.8, 0.1, 0.1, 1.0))] * 2
    film = prepare_film(bodies, np.array([[-0.05] * 3, [0.05] * 3]), camera, size=(60, 40))
    behind = camera.T_world_camera @ translation(np.array([0.0, 0.0, -1.0]))
    assert terracotta(draw_frame(film, np.stack([np.eye(4), behind])).astype(int)).any()


def test_a_gif_shows_every_change_for_the_right_time(tmp_path: Path) -> None:
    write(tmp_path / "lift.gif")
    images, durations = read_gif(tmp_path / "lift.gif")
    assert len(images) == len(PHASES)  # the captions differ even where nothing moves
    assert durations == [40] * len(PHASES)
    assert images[0].shape == (60, 80, 3)
    tops = [np.nonzero(terracotta(image))[0].min() for image in images]
    assert tops[0] == tops[3] > tops[7] > tops[9] == tops[14]
    moved = [np.abs(b - a)[:36].max() for a, b in pairwise(images)]
    assert min(moved[:2] + moved[6:8]) > 60
    assert max(moved[10:]) == 0  # above the caption the held object stands still


def test_a_gif_keeps_to_the_clock_at_rates_that_its_hundredths_cannot_express(tmp_path: Path) -> None:
    write(tmp_path / "lift.gif", fps=30)
    durations = read_gif(tmp_path / "lift.gif")[1]
    assert sum(durations) == 500
    assert set(durations) <= {30, 40}


@pytest.mark.parametrize(("size", "expected"), [((80, 60), (60, 80, 3)), ((81, 61), (60, 80, 3))])
def test_an_mp4_has_all_frames_and_even_sides(size: tuple[int, int], expected: tuple[int, ...], tmp_path: Path) -> None:
    write(tmp_path / "lift.MP4", size=size)
    images, seconds = read_mp4(tmp_path / "lift.MP4")
    assert len(images) == len(PHASES)
    assert seconds == pytest.approx(len(PHASES) / 25, abs=0.01)
    assert images[0].shape == expected
    assert np.abs(images[9] - images[0]).max() > 60
    assert [file.name for file in tmp_path.iterdir()] == ["lift.MP4"]


def test_progress_counts_all_frames(tmp_path: Path) -> None:
    calls = []
    write(tmp_path / "lift.gif", progress=lambda done, total: calls.append((done, total)))
    assert calls == [(i + 1, len(PHASES)) for i in range(len(PHASES))]


def test_pictures_are_drawn_only_where_something_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    monkeypatch.setattr(video, "draw_frame", lambda film, T: drawn.append(T) or draw_frame(film, T))
    write(tmp_path / "lift.mp4")
    assert len(drawn) == 10


@pytest.mark.parametrize("name", ["lift.avi", "lift", "lift.gif.png"])
def test_an_unknown_ending_is_an_error_that_lists_what_is_possible(name: str, tmp_path: Path) -> None:
    with pytest.raises(GraspmatchError, match=r"\.gif, \.mp4"):
        write(tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_a_failure_on_the_way_leaves_nothing_behind(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(done: int, total: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / f"lift.{suffix}", progress=fail)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_an_error_before_anything_is_drawn(tmp_path: Path) -> None:
    calls = []
    with pytest.raises(GraspmatchError, match="there is no folder"):
        write(tmp_path / "missing" / "lift.mp4", progress=lambda done, total: calls.append(done))
    assert not calls


def test_too_many_frames_a_second_for_a_gif_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(GraspmatchError, match="1 to 50"):
        write(tmp_path / "lift.gif", fps=100)


def test_poses_that_do_not_fit_or_are_none_are_errors(tmp_path: Path) -> None:
    T_world_link, T_world_object = lift_of_a_ball()
    path, captions = tmp_path / "lift.mp4", [""] * 15
    with pytest.raises(GraspmatchError, match="3 links"):
        write_video(path, LINKS[:3], BALL, T_world_link, T_world_object, captions)
    with pytest.raises(GraspmatchError, match="14 captions"):
        write_video(path, LINKS, BALL, T_world_link, T_world_object, captions[1:])
    with pytest.raises(GraspmatchError, match="at least"):
        write_video(path, LINKS, BALL, T_world_link[:0], T_world_object[:0], [])
    with pytest.raises(GraspmatchError, match="no triangles"):
        write_video(path, LINKS, EMPTY, T_world_link, T_world_object, captions)
    T_world_object[7, 0, 3] = math.nan
    with pytest.raises(GraspmatchError, match="Frame 7"):
        write_video(path, LINKS, BALL, T_world_link, T_world_object, captions)
    assert not list(tmp_path.iterdir())


def test_the_whole_motion_is_in_the_picture_but_an_object_thrown_away_does_not_shrink_it(tmp_path: Path) -> None:
    T_world_link, T_world_object = lift_of_a_ball()
    thrown = T_world_object.copy()
    thrown[10:, 0, 3] += 5.0
    seen = []
    for T in (T_world_object, thrown):
        write_video(tmp_path / "lift.gif", LINKS, BALL, T_world_link, T, [""] * 15, size=SIZE, table=TABLE)
        images = read_gif(tmp_path / "lift.gif")[0]
        seen.append([int(terracotta(image).sum()) for image in images])
        assert not any(terracotta(image)[[0, -1]].any() for image in images)
    assert min(seen[0]) > 0.5 * max(seen[0])
    assert seen[1][0] > 0.8 * seen[0][0]
    assert seen[1][-1] == 0


def test_the_key_moments_are_the_start_and_the_middle_and_end_of_each_phase() -> None:
    assert key_moments(PHASES) == [0, 2, 4, 5, 8, 9, 12, 14]
    assert key_moments(["lift"]) == [0]
    assert key_moments([]) == []


def test_a_film_strip_shows_the_asked_moments_in_rows(tmp_path: Path) -> None:
    T_world_link, T_world_object = lift_of_a_ball()
    recorded = (LINKS, BALL, T_world_link, T_world_object, PHASES)
    film_strip(tmp_path / "strip.png", *recorded, moments=key_moments(PHASES), columns=4, size=SIZE, table=TABLE)
    with Image.open(tmp_path / "strip.png") as image:
        strip = np.array(image).astype(int)
    assert strip.shape == (2 * 60 + 6, 4 * 80 + 3 * 6, 3)
    first, last = terracotta(strip[:60, :80]), terracotta(strip[-60:, -80:])
    assert first.any()
    assert last.any()
    assert np.nonzero(last)[0].max() < np.nonzero(first)[0].max()
    with pytest.raises(GraspmatchError, match="frames 0 to 14"):
        film_strip(tmp_path / "strip.png", *recorded, moments=[15])


def test_a_film_strip_needs_no_table_and_no_hand(tmp_path: Path) -> None:
    T_world_object = lift_of_a_ball()[1]
    film_strip(
        tmp_path / "strip.png", [], BALL, np.zeros((15, 0, 4, 4)), T_world_object, PHASES, moments=[0, 9], size=SIZE
    )
    assert (tmp_path / "strip.png").is_file()
