"""Baking: one posture of the fingers becomes a `Preshape`, with everything that planning asks of the hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import warp as wp
from jaxtyping import Float
from scipy.spatial import KDTree

from graspmatch.config import BakingConfig
from graspmatch.geometry import grid as grids
from graspmatch.geometry import se3
from graspmatch.geometry.cloud import hull_corners
from graspmatch.geometry.grid import Grid
from graspmatch.geometry.mesh import TriangleMesh, concatenate, transformed
from graspmatch.gripper.card import Posture
from graspmatch.gripper.fingertips import TIP_SAMPLES, find_tips, tip_weights
from graspmatch.gripper.kinematics import HandModel, pose_links
from graspmatch.gripper.samples import inner_surface
from graspmatch.kernels import warp_bake
from graspmatch.kernels.fields import stack_fields
from graspmatch.kernels.launch import launch
from graspmatch.types import Finger, GraspmatchError, Link, PointCloud, Preshape

DEVICE = "cpu"
"""Baking happens once per hand and is cached: it need not be fast."""


@dataclass(frozen=True)
class BakedLinks:
    """The links of a hand as signed distance fields, each in its own frame, and the corners of their convex hulls."""

    links: tuple[Link, ...]
    fields: tuple[Grid, ...]
    hulls: tuple[Float[np.ndarray, "_ 3"], ...]


def bake_links(links: Sequence[Link], config: BakingConfig) -> BakedLinks:
    """Signed distance field and hull of each link's collision mesh."""
    fields = tuple(link_field(link.collision, config) for link in links)
    return BakedLinks(tuple(links), fields, tuple(hull_corners(link.collision.vertices) for link in links))


def link_field(mesh: TriangleMesh, config: BakingConfig) -> Grid:
    """Signed distance to a mesh [m], negative inside, on a grid that reaches `margin` beyond it."""
    lower, upper = mesh.vertices.min(axis=0) - config.margin, mesh.vertices.max(axis=0) + config.margin
    origin, shape = grids.covering(lower, upper, config.link_spacing)
    nodes = grids.node_positions(origin, config.link_spacing, shape)
    distance = wp.empty(len(nodes), dtype=wp.float32, device=DEVICE)
    device_mesh = wp.Mesh(
        wp.array(mesh.vertices, dtype=wp.vec3, device=DEVICE),
        wp.array(mesh.faces.ravel(), dtype=wp.int32, device=DEVICE),
        support_winding_number=True,
    )
    x = wp.array(nodes, dtype=wp.vec3, device=DEVICE)
    launch(warp_bake.mesh_distance, len(nodes), [device_mesh.id, x], [distance], DEVICE)
    return Grid(origin, config.link_spacing, distance.numpy().reshape(shape))


def bake_preshape(
    hand: HandModel,
    baked: BakedLinks,
    fingers: tuple[Finger, ...],
    posture: Posture,
    config: BakingConfig,
    *,
    others: Sequence[Preshape] = (),
) -> Preshape | None:
    """All fields and samples of a posture; none of fingertips that cannot be seen from between the fingers. Fingertips
    take their fields from another preshape that moves alike."""
    same = next((other for other in others if _moves_alike(other, posture)), None)
    try:
        samples, weights = _weighted_samples(hand, baked, posture, pose_links(hand, posture.joints))
    except GraspmatchError:
        if posture.finger_shares is None:
            raise
        return None  # tips that nearly touch can hide each other: nobody asked for this posture by name
    body = _body(hand, baked, fingers, posture, config) if same is None else _body_of(same)
    grid = body.hand
    nodes = grids.node_positions(grid.origin, grid.spacing, grid.shape)
    return Preshape(
        name=posture.name,
        joints=posture.joints,
        is_fingertips=posture.finger_shares is not None,
        closed=posture.closed,
        samples=samples,
        weights=weights,
        tool_centre_point=np.average(samples.points, axis=0, weights=weights),
        nearest_sample=np.asarray(KDTree(samples.points).query(nodes)[1], dtype=np.int32).reshape(grid.shape),
        **vars(body),
    )


def _moves_alike(preshape: Preshape, posture: Posture) -> bool:
    return np.array_equal(preshape.joints, posture.joints) and np.array_equal(preshape.closed, posture.closed)


@dataclass(frozen=True)
class _Body:
    """What a preshape knows of the whole hand, samples or not."""

    hand: Grid
    corridor: Grid
    arrival: Float[np.ndarray, "f nx ny nz"]
    outline: Float[np.ndarray, "v 3"]
    finger_outlines: tuple[Float[np.ndarray, "k _ 3"], ...]


def _body_of(preshape: Preshape) -> _Body:
    return _Body(**{entry.name: getattr(preshape, entry.name) for entry in fields(_Body)})


def _body(
    hand: HandModel, baked: BakedLinks, fingers: tuple[Finger, ...], posture: Posture, config: BakingConfig
) -> _Body:
    """All fields of a posture."""
    T_gripper_link = closing_motion(hand, baked, posture.joints, posture.closed, config)
    outline = _posed_corners(baked.hulls, T_gripper_link[0], range(len(baked.links)))
    moving = [_link_indices(baked.links, finger.links) for finger in fingers]
    outlines = tuple(np.stack([_posed_corners(baked.hulls, T, links) for T in T_gripper_link]) for links in moving)
    # One grid for the hand and for all that its fingers reach while closing.
    everything = np.concatenate([outline, *(o.reshape(-1, 3) for o in outlines)])
    spacing, approach = config.grid_spacing, np.array(hand.card.approach)
    origin, shape = grids.covering(
        everything.min(axis=0) - config.margin, everything.max(axis=0) + config.margin, spacing
    )
    origin = ending_between_nodes(origin, spacing, everything, approach)
    nodes = grids.node_positions(origin, spacing, shape)
    stack = stack_fields(baked.fields, DEVICE)
    field = Grid(origin, spacing, _hand_distance(stack, T_gripper_link[0], nodes).reshape(shape))
    arrival = np.stack([_arrival(stack, T_gripper_link, links, nodes).reshape(shape) for links in moving])
    return _Body(field, corridor(field, approach, config), arrival, outline, outlines)


def ending_between_nodes(
    origin: Float[np.ndarray, "3"], spacing: float, points: Float[np.ndarray, "n 3"], approach: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """The origin of a grid, moved by less than a cell such that the foremost point is midway between two nodes.

    What a finger covers is rounded to the nearest node at its end, which is then right: with flat things on a table,
    one millimetre of the fingertips is all that touches. Where the approach is no axis of the grid, nothing is gained.
    """
    axis = int(np.argmax(np.abs(approach)))
    side = np.sign(approach[axis])
    nodes = (side * (points[:, axis] * side).max() - origin[axis]) / spacing
    moved = origin.copy()
    moved[axis] += spacing * (nodes - np.floor(nodes) - 0.5)
    return moved


def closing_motion(
    hand: HandModel,
    baked: BakedLinks,
    joints: Float[np.ndarray, "d"],
    closed: Float[np.ndarray, "d"],
    config: BakingConfig,
) -> Float[np.ndarray, "k l 4 4"]:
    """Link poses from `joints` to `closed`, in even steps so short that no corner passes over a cell of the grid."""

    def motion(steps: int) -> Float[np.ndarray, "k l 4 4"]:
        return np.stack([pose_links(hand, joints + u * (closed - joints)) for u in np.linspace(0, 1, steps)])

    coarse = motion(config.fewest_closing_steps)
    corners = [se3.apply(coarse[:, i], np.tile(hull, (len(coarse), 1, 1))) for i, hull in enumerate(baked.hulls)]
    longest = max(float(np.linalg.norm(np.diff(path, axis=0), axis=-1).max()) for path in corners)
    steps = int(np.ceil(longest * (len(coarse) - 1) / config.grid_spacing)) + 1
    return coarse if steps <= len(coarse) else motion(steps)


def _weighted_samples(
    hand: HandModel, baked: BakedLinks, posture: Posture, T_gripper_link: Float[np.ndarray, "l 4 4"]
) -> tuple[PointCloud, Float[np.ndarray, "n"]]:
    """S and its weights, those without weight last."""
    card, rule = hand.card, hand.card.samples
    mesh = concatenate([transformed(link.collision, T) for link, T in zip(baked.links, T_gripper_link, strict=True)])
    view = card.approach, posture.tool_centre_point, rule.method
    if posture.finger_shares is None:
        samples = inner_surface(mesh, *view, rule.voxel_size, reach=posture.reach)
        return samples, np.ones(len(samples.points))
    tips = find_tips(hand)
    samples = inner_surface(mesh, *view, min(rule.voxel_size, tips.length / TIP_SAMPLES))
    weights = tip_weights(samples.points, posture.finger_shares, T_gripper_link, baked.fields, tips)
    if not weights.any():
        raise GraspmatchError(f"The fingertips of {card.name} cannot be seen in the preshape {posture.name}.")
    order = np.argsort(weights == 0, kind="stable")
    assert samples.normals is not None  # they are of a mesh
    return PointCloud(samples.points[order], samples.normals[order]), weights[order]


def _link_indices(links: Sequence[Link], names: Sequence[str]) -> list[int]:
    """Indices of the named links; those without geometry have none."""
    return [i for i, link in enumerate(links) if link.name in names]


def _posed_corners(hulls, T_gripper_link: Float[np.ndarray, "l 4 4"], links) -> Float[np.ndarray, "v 3"]:
    return np.concatenate([se3.apply(T_gripper_link[i], hulls[i]) for i in links])


def _transforms(T_gripper_link: Float[np.ndarray, "m 4 4"]) -> wp.array:
    return wp.array(se3.inverse(T_gripper_link), dtype=wp.mat44, device=DEVICE)


def _hand_distance(stack, T_gripper_link, nodes: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """G: distance to the nearest link."""
    out = wp.empty(len(nodes), dtype=wp.float32, device=DEVICE)
    links = wp.array(np.arange(len(T_gripper_link)), dtype=wp.int32, device=DEVICE)
    x = wp.array(nodes, dtype=wp.vec3, device=DEVICE)
    launch(warp_bake.hand_distance, len(nodes), [stack, _transforms(T_gripper_link), links, x], [out], DEVICE)
    return out.numpy()


def _arrival(stack, T_gripper_link: Float[np.ndarray, "k l 4 4"], links: list[int], nodes) -> Float[np.ndarray, "n"]:
    """Closing fraction at which the links first cover each node."""
    steps, count = T_gripper_link.shape[:2]
    out = wp.empty(len(nodes), dtype=wp.float32, device=DEVICE)
    link = wp.array(np.array(links), dtype=wp.int32, device=DEVICE)
    x = wp.array(nodes, dtype=wp.vec3, device=DEVICE)
    inputs = [stack, _transforms(T_gripper_link.reshape(-1, 4, 4)), count, steps, link, x]
    launch(warp_bake.closing_arrival, len(nodes), inputs, [out], DEVICE)
    return out.numpy()


def corridor(hand: Grid, approach: Float[np.ndarray, "3"], config: BakingConfig) -> Grid:
    """The field of the hand's straight way in, on a grid that reaches back as far as the way does."""
    upper = hand.origin + hand.spacing * (np.array(hand.shape) - 1)
    back = -config.approach_distance * approach
    lower, upper = np.minimum(hand.origin, hand.origin + back), np.maximum(upper, upper + back)
    origin, shape = grids.covering(lower, upper, hand.spacing)
    nodes = wp.array(grids.node_positions(origin, hand.spacing, shape), dtype=wp.vec3, device=DEVICE)
    out = wp.empty(nodes.shape[0], dtype=wp.float32, device=DEVICE)
    way = [wp.vec3(*approach), config.approach_distance, hand.spacing]
    launch(warp_bake.corridor_distance, nodes.shape[0], [stack_fields([hand], DEVICE), *way, nodes], [out], DEVICE)
    return Grid(origin, hand.spacing, out.numpy().reshape(shape))
