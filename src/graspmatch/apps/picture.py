"""Pictures of grasps: the hand on the object, drawn by the ray tracer, laid out as captioned panels in one PNG file."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import KDTree

from graspmatch.apps.render import Body as Body
from graspmatch.apps.render import Camera as Camera
from graspmatch.apps.render import camera_around as camera_around
from graspmatch.apps.render import render as render
from graspmatch.apps.render import visible_shares
from graspmatch.formats.files import write_atomically
from graspmatch.geometry.mesh import TriangleMesh, concatenate, transformed
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, GraspSet, Gripper, Plane

Array = np.ndarray
LinkPoses = Callable[[np.ndarray], np.ndarray]
"""Driven joint values (d,) to `T_gripper_link` (l, 4, 4), in the order of `Gripper.links`."""

OBJECT = (0.86, 0.47, 0.33, 1.0)
OBSTACLE = (0.72, 0.74, 0.76, 1.0)
GHOST = (0.25, 0.50, 0.78, 0.19)
INK = (62, 68, 76)
GAP = 6
"""White between panels [pixels]."""
MOST_SPHERES = 5000
"""A denser cloud is drawn with fewer, larger spheres."""


@dataclass(frozen=True)
class Panel:
    """A picture with a line of text in its lower left corner."""

    image: UInt8[Array, "h w 3"]
    caption: str = ""


def picture_of_grasps(
    scene: Scene,
    gripper: Gripper,
    grasps: GraspSet,
    path: Path,
    *,
    link_poses: LinkPoses,
    count: int = 4,
    size: tuple[int, int] = (896, 504),
    device: str = "cpu",
) -> None:
    """Write a PNG of the `count` best grasps: the best one large, its pregrasp as a ghost, the next ones beside it.

    Without grasps it shows the scene alone. Raises `GraspmatchError` if the file cannot be written.
    """
    world = _world(scene)
    shown = min(max(count, 1), len(grasps))
    sizes = _panel_sizes(size, max(shown, 1))
    panels = []
    for i in range(shown):
        at_grasp, at_pregrasp = _hand_at(gripper, grasps, i, link_poses)
        ghosts = [ghost_of(at_pregrasp)] if i == 0 else []
        panels.append(Panel(_draw(world, at_grasp, ghosts, sizes[i], device), _caption(grasps, i)))
    if not panels:
        panels = [Panel(_draw(world, [], [], sizes[0], device), "no grasp")]
    write_png(beside(panels[0], panels[1:]), path)


def contact_sheet(panels: Sequence[Panel], *, columns: int) -> UInt8[Array, "h w 3"]:
    """Panels of one size in rows of `columns`, captions drawn."""
    if not panels:
        raise GraspmatchError("A contact sheet needs at least one panel.")
    tiles = [captioned(panel) for panel in panels]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    rows = [_joined(tiles[i : i + columns], axis=1) for i in range(0, len(tiles), columns)]
    return _joined(rows, axis=0)


def beside(main: Panel, sides: Sequence[Panel]) -> UInt8[Array, "h w 3"]:
    """One panel, and others in a column to its right that is as high."""
    left = captioned(main)
    if not sides:
        return left
    return _joined([left, _joined([captioned(panel) for panel in sides], axis=0)], axis=1)


def captioned(panel: Panel) -> UInt8[Array, "h w 3"]:
    """The panel's picture with its caption in it."""
    height = panel.image.shape[0]
    points = max(round(height / 42), 13)
    image = Image.fromarray(panel.image)
    font = ImageFont.load_default(size=points)
    ImageDraw.Draw(image).text((points, height - 0.8 * points), panel.caption, fill=INK, font=font, anchor="ls")
    return np.array(image)


def write_png(image: UInt8[Array, "h w 3"], path: Path) -> None:
    """Write the file whole or not at all."""
    write_atomically(Path(path), lambda temporary: Image.fromarray(image).save(temporary, format="PNG"))


def point_cloud_bodies(
    points: Float[Array, "n 3"], radius: float, rgba: tuple[float, float, float, float] = OBJECT
) -> Body:
    """A cloud as icosahedra of a radius [m], which the renderer shades as spheres."""
    ball = _icosahedron()
    vertices = (points[:, None] + radius * ball.vertices).reshape(-1, 3)
    faces = (np.arange(len(points))[:, None, None] * len(ball.vertices) + ball.faces).reshape(-1, 3)
    return Body(TriangleMesh(vertices, faces), rgba)


def hand_bodies(
    gripper: Gripper, T_world_gripper: Float[Array, "4 4"], T_gripper_link: Float[Array, "l 4 4"]
) -> list[Body]:
    """The links of a hand at a pose and posture, in their own colours."""
    meshes = [link.visual if len(link.visual.faces) else link.collision for link in gripper.links]
    return [
        Body(transformed(mesh, T_world_gripper @ T), (*link.rgba[:3], 1.0))
        for link, mesh, T in zip(gripper.links, meshes, T_gripper_link, strict=True)
    ]


def ghost_of(bodies: Sequence[Body]) -> Body:
    """One translucent body in the shape of several."""
    return Body(concatenate([body.mesh for body in bodies]), GHOST)


def clearest_azimuth(
    target: Body, hand: Sequence[Body], others: Sequence[Body], up: Float[Array, "3"], *, device: str = "cpu"
) -> float:
    """Azimuth [degrees] from which the hand hides least of the target, while much of the hand itself is seen."""
    azimuths = np.arange(20.0, 380.0, 45.0)
    cameras = [camera_around([target, *hand], azimuth, up=up) for azimuth in azimuths]
    alone = visible_shares([target, *others], cameras, device=device)[:, 0]
    together = visible_shares([target, *others, *hand], cameras, device=device)
    seen = together[:, 0] / np.maximum(alone, 1e-9)
    hand_seen = together[:, 1 + len(others) :].sum(axis=1)
    return float(azimuths[np.argmax(seen + 0.5 * hand_seen / max(float(hand_seen.max()), 1e-9))])


@dataclass(frozen=True)
class _World:
    """What stands there without the hand."""

    target: Body
    others: list[Body]
    table: Plane | None
    up: Float[Array, "3"]


def _world(scene: Scene) -> _World:
    target = Body(scene.mesh, OBJECT) if scene.mesh is not None else _cloud_body(scene.target.points, OBJECT)
    others = [_cloud_body(scene.obstacles.points, OBSTACLE)] if len(scene.obstacles.points) else []
    up = np.array([0.0, 0.0, 1.0])
    if scene.table is not None:
        up = scene.table.normal
    elif scene.sensor_origin is not None:  # nothing says where up is: show the side that was seen
        towards_sensor = scene.sensor_origin - scene.centre_of_mass
        up = towards_sensor / max(float(np.linalg.norm(towards_sensor)), 1e-9)
    return _World(target, others, scene.table, up)


def _cloud_body(points: Float[Array, "n 3"], rgba: tuple[float, float, float, float]) -> Body:
    """A cloud as spheres so large that neighbours overlap."""
    points = points[:: math.ceil(len(points) / MOST_SPHERES)]
    if len(points) < 2:
        return point_cloud_bodies(points, 0.002, rgba)
    # The nearest neighbour is often much nearer than the next ones, and those must meet too.
    spacing = float(np.median(KDTree(points).query(points, k=min(5, len(points)))[0][:, -1]))
    return point_cloud_bodies(points, 0.6 * max(spacing, 1e-4), rgba)


def _hand_at(gripper: Gripper, grasps: GraspSet, index: int, link_poses: LinkPoses) -> tuple[list[Body], list[Body]]:
    """The hand at the grasp and at its pregrasp."""
    closed, open_ = link_poses(grasps.grasp_joints[index]), link_poses(grasps.pregrasp_joints[index])
    return (
        hand_bodies(gripper, grasps.T_world_gripper[index], closed),
        hand_bodies(gripper, grasps.T_world_pregrasp[index], open_),
    )


def _draw(
    world: _World, hand: list[Body], ghosts: list[Body], size: tuple[int, int], device: str
) -> UInt8[Array, "h w 3"]:
    azimuth = 40.0
    if hand:  # as if the ghosts were solid: they too should not lie over what is to be seen
        solid = [Body(ghost.mesh, (*ghost.rgba[:3], 1.0)) for ghost in ghosts]
        azimuth = clearest_azimuth(world.target, [*hand, *solid], world.others, world.up, device=device)
    camera = camera_around([world.target, *hand, *ghosts], azimuth, up=world.up, aspect=size[0] / size[1])
    bodies = [world.target, *world.others, *hand, *ghosts]
    return render(bodies, camera=camera, size=size, table=world.table, device=device)


def _caption(grasps: GraspSet, index: int) -> str:
    """Rank, preshape, score and the root of the loss."""
    preshape = grasps.preshape_names[grasps.preshape[index]]
    loss = 1000 * math.sqrt(max(float(grasps.loss[index]), 0.0))
    return f"{index + 1}   {preshape}   score {grasps.score[index]:.2f}   loss {loss:.1f} mm"


def _panel_sizes(size: tuple[int, int], count: int) -> list[tuple[int, int]]:
    """Width and height of the large panel and of those in the column at its right; with the gaps they fill `size`."""
    width, height = size
    if count == 1:
        return [size]
    side = round(0.3 * width)
    edges = [round(i * (height + GAP) / (count - 1)) for i in range(count)]
    return [(width - side - GAP, height)] + [(side, low - high - GAP) for high, low in pairwise(edges)]


def _joined(tiles: Sequence[UInt8[Array, "_ _ 3"]], axis: int) -> UInt8[Array, "h w 3"]:
    """Tiles one after the other with a white gap between them."""
    shape = list(tiles[0].shape)
    shape[axis] = GAP
    gap = np.full(shape, 255, dtype=np.uint8)
    pieces = [piece for tile in tiles for piece in (gap, tile)]
    return np.concatenate(pieces[1:], axis=axis)


def _icosahedron() -> TriangleMesh:
    """Unit icosahedron: three golden rectangles, and a face wherever three corners are mutual neighbours."""
    golden = (1 + math.sqrt(5)) / 2
    rectangle = np.array([(0.0, i, j * golden) for i in (-1, 1) for j in (-1, 1)])
    corners = np.concatenate([np.roll(rectangle, k, axis=1) for k in range(3)])
    near = np.linalg.norm(corners[:, None] - corners, axis=-1) < 2.1  # an edge is 2 long
    faces = [f for f in combinations(range(12), 3) if near[f[0], f[1]] and near[f[1], f[2]] and near[f[0], f[2]]]
    faces = [f if np.linalg.det(corners[list(f)]) > 0 else f[::-1] for f in faces]
    return TriangleMesh(corners / np.linalg.norm(corners[0]), np.array(faces))
