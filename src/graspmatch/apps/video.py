"""Videos of a grasp in simulation, .gif or .mp4, and strips of its moments: hand and object before one camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from graspmatch.apps.film import Film, draw_frame, prepare_film
from graspmatch.apps.picture import (
    OBJECT,
    Body,
    Panel,
    camera_around,
    captioned,
    clearest_azimuth,
    contact_sheet,
    write_png,
)
from graspmatch.formats.files import check_place, write_atomically
from graspmatch.geometry.mesh import TriangleMesh, transformed
from graspmatch.geometry.se3 import apply, inverse, is_rigid
from graspmatch.types import GraspmatchError, Link, Plane

Array = np.ndarray
Progress = Callable[[int, int], object]
"""Called after each frame with the number of frames done and of all."""

ELEVATION = 18.0
"""Of the camera above the table [degrees]."""
STILL = 5e-5
"""A motion [m, rad] that no picture shows."""
STEADY = 2
"""A change of a pixel's display value that a .gif leaves out, which saves most of its size."""
FASTEST = {".gif": 50, ".mp4": 240}
"""Frames a second; players slow down faster .gif files."""


@dataclass(frozen=True)
class _Motion:
    """Bodies in their own frames, the object first, and where they are in each frame."""

    bodies: list[Body]
    T_world_body: Float[Array, "k b 4 4"]
    captions: Sequence[str]


def write_video(
    path: Path | str,
    links: Sequence[Link],
    object_mesh: TriangleMesh,
    T_world_link: Float[Array, "k l 4 4"],
    T_world_object: Float[Array, "k 4 4"],
    captions: Sequence[str],
    *,
    fps: int = 25,
    size: tuple[int, int] = (640, 480),
    table: Plane | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> None:
    """Write k frames as .gif or .mp4, each shown for 1 / `fps` seconds, with its caption in the lower left corner.

    `size` is (width, height); .mp4 needs even numbers and takes the next lower ones. Raises `GraspmatchError` for
    another suffix, for poses that are none, and if the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in FASTEST:
        raise GraspmatchError(f"Cannot write a video as {path.name}. Possible endings: {', '.join(FASTEST)}.")
    fastest = FASTEST[path.suffix.lower()]
    if not 1 <= fps <= fastest:
        raise GraspmatchError(f"{path.name} cannot show {fps} frames a second; 1 to {fastest} are possible.")
    check_place(path)
    motion = _motion(links, object_mesh, T_world_link, T_world_object, captions)
    write = _write_gif
    if path.suffix.lower() == ".mp4":
        write = _write_mp4
        size = (size[0] - size[0] % 2, size[1] - size[1] % 2)
    film = _film(motion, size, table, device)
    write_atomically(path, lambda temporary: write(temporary, film, motion, fps, progress))


def film_strip(
    path: Path | str,
    links: Sequence[Link],
    object_mesh: TriangleMesh,
    T_world_link: Float[Array, "k l 4 4"],
    T_world_object: Float[Array, "k 4 4"],
    captions: Sequence[str],
    *,
    moments: Sequence[int],
    columns: int = 4,
    size: tuple[int, int] = (400, 300),
    table: Plane | None = None,
    device: str = "cpu",
) -> None:
    """Write a PNG of some frames (see `key_moments`) in rows, from the camera of the video; `size` is that of one."""
    check_place(Path(path))
    motion = _motion(links, object_mesh, T_world_link, T_world_object, captions)
    outside = [i for i in moments if not 0 <= i < len(motion.captions)]
    if outside:
        raise GraspmatchError(f"There is no frame {outside[0]}; frames 0 to {len(motion.captions) - 1} are possible.")
    film = _film(motion, size, table, device)
    panels = [Panel(draw_frame(film, motion.T_world_body[i]), captions[i]) for i in moments]
    write_png(contact_sheet(panels, columns=min(columns, max(len(panels), 1))), Path(path))


def key_moments(phase: Sequence[str]) -> list[int]:
    """The first frame, and of each phase the middle (but of the first phase) and the last one: 8 of four phases."""
    runs = [[i for i, _ in run] for _, run in groupby(enumerate(phase), key=lambda pair: pair[1])]
    moments = {run[k] for run in runs for k in (len(run) // 2, -1)}
    if runs:
        moments = moments - {runs[0][len(runs[0]) // 2]} | {runs[0][0], runs[0][-1]}
    return sorted(moments)


def _motion(
    links: Sequence[Link],
    object_mesh: TriangleMesh,
    T_world_link: Float[Array, "k l 4 4"],
    T_world_object: Float[Array, "k 4 4"],
    captions: Sequence[str],
) -> _Motion:
    """The bodies that have a shape, checked to fit their poses."""
    needed = ((len(captions), len(links), 4, 4), (len(captions), 4, 4))
    given = (T_world_link.shape, T_world_object.shape)
    if given != needed or len(captions) == 0:
        asked = f"Of {len(captions)} captions and {len(links)} links the poses have shapes {needed[0]} and {needed[1]}"
        raise GraspmatchError(f"{asked}, and a video has a frame at least; got {given[0]} and {given[1]}.")
    T_world_body = np.concatenate([T_world_object[:, None], T_world_link], axis=1)
    is_pose = is_rigid(T_world_body).all(axis=1)
    if not is_pose.all():
        raise GraspmatchError(f"Frame {int(np.argmin(is_pose))} has a pose that is none (not finite, or not rigid).")
    if len(object_mesh.faces) == 0:
        raise GraspmatchError("The object's mesh has no triangles; a video needs at least one.")
    meshes = [link.visual if len(link.visual.faces) else link.collision for link in links]
    bodies = [Body(object_mesh, OBJECT)]
    bodies += [Body(mesh, (*link.rgba[:3], 1.0)) for link, mesh in zip(links, meshes, strict=True)]
    drawn = [i for i, body in enumerate(bodies) if len(body.mesh.faces)]
    return _Motion([bodies[i] for i in drawn], T_world_body[:, drawn], captions)


def _film(motion: _Motion, size: tuple[int, int], table: Plane | None, device: str) -> Film:
    """One camera for all frames: from the side, a little above, where the closed fingers hide least of the object."""
    up = np.array([0.0, 0.0, 1.0]) if table is None else table.normal
    object_, *hand = [
        Body(transformed(body.mesh, T), body.rgba)
        for body, T in zip(motion.bodies, motion.T_world_body[_closed_moment(motion.T_world_body)], strict=True)
    ]
    azimuth = clearest_azimuth(object_, hand, [], up, device=device) if hand else 40.0
    reached = _reached_points(motion)
    swept = Body(TriangleMesh(reached, np.zeros((0, 3), dtype=int)), OBJECT)
    camera = camera_around([swept], azimuth, ELEVATION, aspect=size[0] / size[1], margin=0.07, up=up)
    box = np.stack([reached.min(axis=0), reached.max(axis=0)])
    return prepare_film(motion.bodies, box, camera, size=size, table=table, device=device)


def _closed_moment(T_world_body: Float[Array, "k b 4 4"]) -> int:
    """The frame by which the fingers have made nearly all of their way; the middle one where they make none."""
    hand = T_world_body[:, 1:]
    if hand.shape[1] == 0:
        return len(hand) // 2
    T_palm_link = inverse(hand[:, :1]) @ hand
    way = np.cumsum(np.abs(np.diff(T_palm_link, axis=0)).sum(axis=(1, 2, 3)))
    if len(way) == 0 or way[-1] < STILL:
        return len(hand) // 2
    return int(np.searchsorted(way, 0.95 * way[-1])) + 1


def _reached_points(motion: _Motion) -> Float[Array, "n 3"]:
    """Outermost points of all bodies in all frames [m], but of an object only while it is near the hand's way: one that
    is thrown away would make the rest small."""
    ways = np.moveaxis(motion.T_world_body, 1, 0)
    outermost = [apply(way, _outermost(body.mesh.vertices)) for body, way in zip(motion.bodies, ways, strict=True)]
    if len(outermost) > 1:
        hand = np.concatenate(outermost[1:], axis=1).reshape(-1, 3)
        first = outermost[0][0]
        spare = 0.5 * np.linalg.norm(np.ptp(first, axis=0))
        lower = np.minimum(hand.min(axis=0), first.min(axis=0)) - spare
        upper = np.maximum(hand.max(axis=0), first.max(axis=0)) + spare
        is_near = np.all((outermost[0] > lower) & (outermost[0] < upper), axis=(1, 2))
        outermost[0] = outermost[0][is_near]
    return np.concatenate([points.reshape(-1, 3) for points in outermost])


def _outermost(points: Float[Array, "n 3"]) -> Float[Array, "m 3"]:
    """The farthest point in each of the 26 directions of a cube's faces, edges and corners."""
    directions = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return points[np.unique(np.argmax(points @ directions.T, axis=0))]


def _frames(film: Film, motion: _Motion, progress: Progress | None) -> Iterator[UInt8[Array, "h w 3"]]:
    """All frames in turn; where nothing moves, the picture is the one before under a new caption."""
    drawn, image = None, None
    for i, (T_world_body, caption) in enumerate(zip(motion.T_world_body, motion.captions, strict=True)):
        if drawn is None or image is None or np.abs(T_world_body - drawn).max() > STILL:
            drawn, image = T_world_body, draw_frame(film, T_world_body)
        yield captioned(Panel(image, caption))
        if progress is not None:
            progress(i + 1, len(motion.captions))


def _write_mp4(path: Path, film: Film, motion: _Motion, fps: int, progress: Progress | None) -> None:
    import av

    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "20", "preset": "veryfast"})
        stream.width, stream.height = film.size
        stream.pix_fmt = "yuv420p"
        for image in _frames(film, motion, progress):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def _write_gif(path: Path, film: Film, motion: _Motion, fps: int, progress: Progress | None) -> None:
    """With one palette for all frames, and only what changes in each."""
    palette = _palette(film, motion)
    images = _steady(_frames(film, motion, progress))
    frames = (Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    ends = np.round(np.arange(len(motion.captions) + 1) * 100 / fps).astype(int)  # the format counts hundredths
    durations = (10 * np.diff(ends)).tolist()
    options: dict[str, Any] = {"duration": durations, "loop": 0, "optimize": True}
    next(frames).save(path, format="GIF", save_all=True, append_images=frames, **options)


def _palette(film: Film, motion: _Motion) -> Image.Image:
    """255 colours that suit frames from all over the video, so that one is left for what does not change."""
    some = np.unique(np.linspace(0, len(motion.captions) - 1, 6).astype(int))
    panels = [Panel(draw_frame(film, motion.T_world_body[i]), motion.captions[int(i)]) for i in some]
    images = [captioned(panel) for panel in panels]
    return Image.fromarray(np.concatenate(images)).quantize(255, method=Image.Quantize.MEDIANCUT)


def _steady(images: Iterator[UInt8[Array, "h w 3"]]) -> Iterator[UInt8[Array, "h w 3"]]:
    """Images in which a pixel keeps its colour until that is too far from what it should be."""
    shown = None
    for image in images:
        if shown is None:
            shown = image
        else:
            changed = np.abs(image.astype(np.int16) - shown).max(axis=-1, keepdims=True) > STEADY
            shown = np.where(changed, image, shown)
        yield shown
