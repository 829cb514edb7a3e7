"""A hand at any joint values, for planners that choose them: link poses, samples, distances and lowest corners.

Link poses come from a table over the joints and are blended between its nodes, as solving a posture takes milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from graspmatch.config import BakingConfig
from graspmatch.geometry import grid, se3
from graspmatch.geometry.grid import Grid
from graspmatch.geometry.sphere import fibonacci_directions
from graspmatch.gripper.bake import bake_links
from graspmatch.gripper.kinematics import HandModel, load_hand, pose_links
from graspmatch.gripper.zoo import card_path
from graspmatch.planner.seed import asked_for
from graspmatch.types import GraspmatchError, Gripper, PointCloud

Array = np.ndarray

SPREAD = np.deg2rad(10)
"""How far beyond the preshapes a joint that only spreads may go [rad]."""
SAMPLE_SPACING = 0.008
"""Of the samples of the inner surface [m]."""
NEAR = 0.005
"""How far around a link distances are known [m]."""
TABLE_STEP, FEWEST_NODES = 0.1, 9
"""Longest step of a joint in the table of link poses [rad or m], and the least number of nodes."""


@dataclass(frozen=True, eq=False)
class LinkFields:
    """Signed distance of each link [m], read at the nearest node, a millimetre or two away."""

    values: Float[Array, "k"]
    """Of all grids, one after the other."""
    start: Int[Array, "l"]
    shape: Int[Array, "l 3"]
    origin: Float[Array, "l 3"]
    """In nodes."""
    spacing: np.float32

    @classmethod
    def of(cls, fields: tuple[Grid, ...]) -> LinkFields:
        size = [field.values.size for field in fields]
        return cls(
            values=np.concatenate([field.values.ravel() for field in fields]).astype(np.float32),
            start=np.cumsum([0, *size[:-1]]).astype(np.int32),
            shape=np.array([field.shape for field in fields], dtype=np.int32),
            origin=np.array([field.origin / field.spacing for field in fields], dtype=np.float32),
            spacing=np.float32(fields[0].spacing),
        )

    def distance(self, link: Int[Array, "n"], points: Float[Array, "3 n"]) -> Float[Array, "n"]:
        """Of each point from a link, in its frame; infinite outside the link's grid."""
        index, inside = np.zeros(len(link), dtype=np.int32), np.ones(len(link), dtype=bool)
        for axis in range(3):
            size = self.shape[:, axis][link]
            node = np.rint(points[axis] / self.spacing - self.origin[:, axis][link]).astype(np.int32)
            inside &= (node >= 0) & (node < size)
            index = index * size + node
        index += self.start[link]
        return np.where(inside, self.values[np.where(inside, index, 0)], np.float32(np.inf))


@dataclass(frozen=True, eq=False)
class HandShape:
    """What the cost asks of a hand: link poses over the joints; samples, distances and corners of each link."""

    gripper: Gripper
    lower: Float[Array, "d"]
    """What the swarm may choose: from open to closed, and a little beyond the preshapes' spread."""
    upper: Float[Array, "d"]
    driver: Int[Array, "l 2"]
    """The joint that moves each link along each axis of the table; any other joint where none does."""
    poses: Float[Array, "a b l 4 4"]
    """T_gripper_link where the joints of either axis stand at even shares of their range."""
    samples: tuple[PointCloud, ...]
    """Of the inner surface, for each link in its frame, as all below."""
    fields: LinkFields
    balls: Float[Array, "l 4"]
    """Centre and radius of a ball around each link."""
    corners: Float[Array, "l e 3"]
    """The points of each link that lie farthest in many directions."""

    def links(self, joints: Float[Array, "m d"]) -> Float[Array, "m l 4 4"]:
        """T_gripper_link, blended between the nodes of the table."""
        share = (joints - self.lower) / np.maximum(self.upper - self.lower, 1e-9)
        most = np.array(self.poses.shape[:2]) - 1
        u = np.clip(share, 0, 1)[:, self.driver] * most
        low = np.minimum(u.astype(int), np.maximum(most - 1, 0))
        high = np.minimum(low + 1, most)
        a, b = np.moveaxis((u - low).astype(np.float32), -1, 0)[..., None, None]
        link = np.arange(len(self.driver))
        corner = [[self.poses[i, j, link] for j in (low[..., 1], high[..., 1])] for i in (low[..., 0], high[..., 0])]
        return (1 - a) * ((1 - b) * corner[0][0] + b * corner[0][1]) + a * ((1 - b) * corner[1][0] + b * corner[1][1])


def hand_shape(gripper: Gripper) -> HandShape:
    """Made once per hand and process, in seconds; kept by content, as the same hand may be loaded many times.

    Raises `GraspmatchError` for a hand with links that more than two driven joints move.
    """
    if gripper.content_hash not in _shapes:
        _shapes[gripper.content_hash] = _shape_of(gripper)
    return _shapes[gripper.content_hash]


_shapes: dict[str, HandShape] = {}


def _shape_of(gripper: Gripper) -> HandShape:
    model = load_hand(card_path(gripper.name), gripper.description)
    preshapes = np.array([gripper.preshapes[i].joints for i in asked_for(gripper)])
    closes = gripper.closed_joints != gripper.open_joints
    least, most = np.sort([gripper.open_joints, gripper.closed_joints], axis=0)
    lower = np.where(closes, least, np.maximum(gripper.lower, preshapes.min(axis=0) - SPREAD))
    upper = np.where(closes, most, np.minimum(gripper.upper, preshapes.max(axis=0) + SPREAD))
    axis, driver = shared_axes(_moves(model, lower, upper), closes, gripper)
    baked = bake_links(model.links, BakingConfig(link_spacing=0.003, margin=NEAR))
    far = fibonacci_directions(64)
    return HandShape(
        gripper=gripper,
        lower=lower,
        upper=upper,
        driver=driver,
        poses=_pose_table(model, lower, upper, axis),
        samples=_inner_samples(model, gripper, baked.fields),
        fields=LinkFields.of(baked.fields),
        balls=np.array([_ball(hull) for hull in baked.hulls], dtype=np.float32),
        corners=np.array([h[np.argmax(h @ far.T, axis=0)] for h in baked.hulls], dtype=np.float32),
    )


def _ball(points: Float[Array, "n 3"]) -> Float[Array, "4"]:
    """Centre of the bounding box, and the distance from there to the farthest point."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return np.append(centre, np.linalg.norm(points - centre, axis=-1).max())


def _moves(model: HandModel, lower: Float[Array, "d"], upper: Float[Array, "d"]) -> Bool[Array, "d l"]:
    """Which joint moves which link."""
    home = pose_links(model, lower)
    nudged = [pose_links(model, lower + nudge) for nudge in np.diag(0.1 * (upper - lower))]
    return np.array([np.abs(T - home).max(axis=(1, 2)) > 1e-7 for T in nudged])


def shared_axes(
    moves: Bool[Array, "d l"], closes: Bool[Array, "d"], gripper: Gripper
) -> tuple[Int[Array, "d"], Int[Array, "l 2"]]:
    """The axis of each joint, of two, such that no two joints of one axis move the same link; who moves each link.

    Joints that spread come first and go to the first axis, the others to the second where they can: a smaller table.
    """
    axis = np.zeros(len(moves), dtype=int)
    driver = np.zeros((moves.shape[1], 2), dtype=int)
    taken = np.zeros((2, moves.shape[1]), dtype=bool)
    for j in np.argsort(closes, kind="stable"):
        free = np.flatnonzero(~np.any(taken & moves[j], axis=-1))
        if len(free) == 0:
            raise GraspmatchError(
                f"{gripper.name} has a link that more than two driven joints move, '{gripper.joint_names[j]}' among "
                f"them; a hand can be posed here whose links are moved by at most two driven joints each."
            )
        axis[j] = free[-1] if closes[j] else free[0]
        taken[axis[j]] |= moves[j]
        driver[moves[j], axis[j]] = j
    return axis, driver


def _pose_table(
    model: HandModel, lower: Float[Array, "d"], upper: Float[Array, "d"], axis: Int[Array, "d"]
) -> Float[Array, "a b l 4 4"]:
    """Link poses on the lattice of the two axes; one node along an axis without joints."""
    span = [np.append((upper - lower)[axis == k], -1.0).max() for k in range(2)]
    count = [1 if s <= 0 else max(FEWEST_NODES, int(np.ceil(s / TABLE_STEP)) + 1) for s in span]
    shares = [np.linspace(0, 1, n) for n in count]
    rows = [[lower + np.array([u, v])[axis] * (upper - lower) for v in shares[1]] for u in shares[0]]
    return np.array([[pose_links(model, joints) for joints in row] for row in rows], dtype=np.float32)


def _inner_samples(model: HandModel, gripper: Gripper, fields: tuple[Grid, ...]) -> tuple[PointCloud, ...]:
    """The samples of the card's preshapes in the frames of the links that they lie on, one in each voxel of a link."""
    found: list[list[Array]] = [[] for _ in fields]
    for preshape in [gripper.preshapes[i] for i in asked_for(gripper)]:
        T_link_gripper = se3.inverse(pose_links(model, preshape.joints))
        local = se3.apply(T_link_gripper, preshape.samples.points)
        own = np.argmin(np.abs([grid.interpolate(f, p) for f, p in zip(fields, local, strict=True)]), axis=0)
        for i, T in enumerate(T_link_gripper):
            found[i].append(np.hstack([local[i], preshape.samples.normals @ T[:3, :3].T])[own == i])
    return tuple(_thinned(np.concatenate(rows)) for rows in found)


def _thinned(rows: Float[Array, "n 6"]) -> PointCloud:
    """The first point, with its normal, of each voxel."""
    voxel = np.floor(rows[:, :3] / SAMPLE_SPACING)
    kept = rows[np.sort(np.unique(voxel, axis=0, return_index=True)[1])].astype(np.float32)
    return PointCloud(kept[:, :3], kept[:, 3:])


def depths(
    hand: HandShape, T_link: Float[Array, "m l 4 4"], points: Float[Array, "n 3"]
) -> tuple[Int[Array, "k"], Int[Array, "k"], Float[Array, "k"]]:
    """Pose, point and depth [m] of the points near links, once a link; below zero it is the distance to the link."""
    R, t = T_link[..., :3, :3], T_link[..., :3, 3]
    centre = (R @ hand.balls[:, :3, None])[..., 0] + t
    # |x - c| < r, as x.x / 2 - r2 < c.x with the products of all pairs in one matrix.
    least = (np.sum(centre**2, axis=-1) - (hand.balls[:, 3] + NEAR) ** 2) / 2
    near = np.append(centre, -least[..., None], axis=-1) @ np.append(points, np.ones((len(points), 1), "f"), axis=-1).T
    body, point = np.divmod(np.flatnonzero(near > np.sum(points**2, axis=-1) / 2), len(points))
    pose, link = np.divmod(body, T_link.shape[1])
    offset = points.T[:, point] - t.reshape(-1, 3).T[:, body]
    axes = np.ascontiguousarray(R.reshape(-1, 9).T)
    local = [sum(offset[j] * axes[3 * j + i][body] for j in range(3)) for i in range(3)]
    return pose, point, -hand.fields.distance(link, np.stack(local))


def lowest_corner(hand: HandShape, T_link: Float[Array, "m l 4 4"], up: Float[Array, "3"]) -> Float[Array, "m"]:
    """Height of the lowest corner of each hand along `up` [m]."""
    up = up.astype(np.float32)
    along = (up @ T_link[..., :3, :3])[..., None, :] @ np.swapaxes(hand.corners, -1, -2)
    return (along[..., 0, :].min(axis=-1) + T_link[..., :3, 3] @ up).min(axis=-1)
