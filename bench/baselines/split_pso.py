"""SplitPSO: a particle swarm that takes turns between the pose of the palm and the joints of the fingers.

Kiatos, Malassiotis, Sarantopoulos, "A Geometric Approach for Grasping Unknown Objects With Multifingered Hands", IEEE
T-RO 37(3), 2021; our own implementation, for Table III of the shape matching paper. As there, the whole cloud of the
object takes the place of the shape completion network.

From the publication and the parameters that its authors released:
- Starts: random surface points more than 1 cm above the table; a frame from the principal directions of the normals
  within 2 cm; the hand faces against the normal, in four turns about it, and is pushed forward until it touches.
- Cost: shape complementarity, a term of distance and one of alignment of normals (weight 0.5) between each sample of
  the inner hand and its nearest object point, no farther than 3 cm, where an object point counts for its nearest
  sample only and the sum is over the number of all samples; and a penalty for the object points inside the hand.
- Swarm: in each iteration the palm's swarm moves with the best joints so far, then the joints' swarm with the best
  palm; inertia 0.72, attractions 1.49; particles start within 2 cm and 20 degrees of the start, joints up to 10 degrees
  of spread away and up to 50 degrees (here 0.36 of the stroke) further closed; joints are kept within their limits.

Decided by us:
- The distance counts as a share of the 3 cm, so that both terms have one scale and a sample without a partner gains
  nothing: 1 - cost is at most 1. The penalty is the summed depth of points 8 mm apart, its weight chosen by us; there
  is one for the table too.
- More starts, particles and iterations than the released ones (20, 5 and 10), as far as the published time allows, and
  for each surface point the best turn and preshape of the card. The best pair of palm and joints is kept together, so
  that its cost never rises.
- The samples of the hand are those of its baked preshapes; its posture at any joints is that of `posed_hand`.
- Execution: the pregrasp is the grasp opened until the straight way in is 3 mm clear, backed off by up to 2 cm where
  the palm or a finger would touch; grasps without such a way, and those that meet the table, are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from baselines.posed_hand import SPREAD, HandShape, depths, hand_shape, lowest_corner
from baselines.result import grasp_set
from graspmatch.geometry import grid, se3
from graspmatch.geometry.cloud import normal_sector, voxel_downsample, voxel_means
from graspmatch.geometry.grid import Grid
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, GraspSet, Gripper

Array = np.ndarray

RADIUS, ALIGNMENT = 0.03, 0.5
"""Farthest partner of a sample [m], and the weight of its normal's alignment beside that of its distance."""
PENETRATION, SUNK = 6.0, 20.0
"""Weights of the depth of object points in the hand, summed, and of the hand's depth in the table [1/m]."""
INERTIA, OWN, SOCIAL = 0.72, 1.49, 1.49
SHIFT, TURN, STROKE = 0.02, np.deg2rad(20), 50 / 140
"""Where particles start: [m], [rad], share of the stroke for joints that close; `SPREAD` for those that spread."""
TURNS = 4
"""Turns of the hand about the normal, evenly over half a turn."""
POINT_SPACING, SOLID_SPACING = 0.005, 0.008
"""Of the object's points as partners, and as things not to be hit [m]."""
CLEARANCE = 0.003
"""Of the way in and of the hand above the table [m]: a link's distance is off by about 1 mm."""
OPENINGS = np.array([0.15, 0.3, 0.5, 0.75, 1.0])
"""Tried for the pregrasp: shares of the way from the grasp's joints to the open hand."""
STEPS_BACK = np.concatenate([np.arange(0, 0.021, 0.002), np.arange(0.03, 0.151, 0.01)])
"""Where the way in is looked at [m]; up to `LARGEST_RETREAT` the grasp itself may be backed off."""
LARGEST_RETREAT = 0.0201


def split_pso(
    scene: Scene, gripper: Gripper, seed: int, *, starts: int = 40, particles: int = 20, iterations: int = 25
) -> GraspSet:
    """One grasp from each start that ends with a free way in, best first; score is 1 - cost, no less than 0.

    For the built-in hands. Raises `GraspmatchError` for a hand with links that more than two driven joints move.
    """
    rng = np.random.default_rng(seed)
    hand, target = hand_shape(gripper), target_of(scene)
    T, joints, preshape = start_grasps(scene, hand, target, starts, rng)
    tally = {"candidates": len(T)}
    T, joints, _ = optimise(T, joints, hand, target, particles, iterations, rng)
    T, pregrasp, kept = way_in(T, joints, hand, target, tally)
    score = np.clip(1 - cost(T, joints[kept], hand, target), 0, 1).astype(float)
    T[:, :3, 3] += scene.centre_of_mass
    advice = "" if tally["candidates"] else "The hand can face no point of the object without touching something."
    chosen = preshape[kept], pregrasp, joints[kept], score
    return grasp_set("split_pso", T, *chosen, gripper, tally, seed, advice=advice, source=scene.source)


# The object


@dataclass(frozen=True, eq=False)
class Target:
    """The scene around the centre of mass, which is the origin of all coordinates of this file."""

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    nearest: Grid
    """Index of the nearest point at each node."""
    solid: Float[Array, "m 3"]
    """Object and obstacles, thinned: for the swarm."""
    dense: Float[Array, "k 3"]
    """The same, closer: for the way in."""
    up: Float[Array, "3"]
    table: float
    """Height of the table along `up` [m]; -inf where there is none."""


def target_of(scene: Scene) -> Target:
    """The scene's cloud, thinned, with its nearest points on a grid."""
    cloud = scene.target.points - scene.centre_of_mass
    normals = scene.target.normals
    if normals is None:
        raise GraspmatchError("SplitPSO compares normals: the target cloud needs them.")
    points, voxel = voxel_downsample(cloud, POINT_SPACING, labels=normal_sector(normals))
    mean = voxel_means(normals, voxel, len(points))
    origin, shape = grid.covering(points.min(axis=0) - RADIUS, points.max(axis=0) + RADIUS, POINT_SPACING)
    nodes = grid.node_positions(origin, POINT_SPACING, shape)
    solid = np.concatenate([cloud, scene.obstacles.points - scene.centre_of_mass])
    up, table = np.array([0.0, 0.0, 1.0]), -np.inf
    if scene.table is not None:
        up, table = scene.table.normal, scene.table.offset - float(scene.table.normal @ scene.centre_of_mass)
    return Target(
        points=points.astype(np.float32),
        normals=(mean / np.linalg.norm(mean, axis=-1, keepdims=True)).astype(np.float32),
        nearest=Grid(origin, POINT_SPACING, np.reshape(KDTree(points).query(nodes)[1], shape)),
        solid=voxel_downsample(solid, SOLID_SPACING)[0].astype(np.float32),
        dense=voxel_downsample(solid, POINT_SPACING)[0].astype(np.float32),
        up=up,
        table=table,
    )


# The cost


def cost(T: Float[Array, "m 4 4"], joints: Float[Array, "m d"], hand: HandShape, target: Target) -> Float[Array, "m"]:
    """Lack of shape complementarity plus penalties for object points in the hand and for the hand in the table."""
    T_link = T.astype(np.float32)[:, None] @ hand.links(joints)
    pose, _, depth = depths(hand, T_link, target.solid)
    inside = np.bincount(pose, np.maximum(depth, 0), minlength=len(T))
    sunk = np.maximum(target.table + CLEARANCE - lowest_corner(hand, T_link, target.up), 0)
    return 1 - complementarity(T_link, hand, target) + PENETRATION * inside + SUNK * sunk


def complementarity(T_link: Float[Array, "m l 4 4"], hand: HandShape, target: Target) -> Float[Array, "m"]:
    """Mean gain of the samples: nearness and alignment of those that are some object point's nearest, 0 of others."""
    R = np.swapaxes(T_link[..., :3, :3], -1, -2)
    points = np.concatenate([se3.apply(T_link[:, i], on.points) for i, on in enumerate(hand.samples)], axis=1)
    normals = np.concatenate([on.normals @ R[:, i] for i, on in enumerate(hand.samples)], axis=1)
    index, distance = partners(points, target)
    flat = index + len(target.points) * np.arange(len(points))[:, None]
    nearest = np.full(len(points) * len(target.points), np.float32(RADIUS))
    np.minimum.at(nearest, flat.ravel(), distance.ravel())
    alignment = -np.einsum("msi,msi->ms", normals, target.normals[index])
    gain = (1 - ALIGNMENT) * (1 - distance / RADIUS) + ALIGNMENT * alignment
    return np.where((distance < RADIUS) & (distance <= nearest[flat]), gain, 0).mean(axis=-1)


def partners(points: Float[Array, "m s 3"], target: Target) -> tuple[Int[Array, "m s"], Float[Array, "m s"]]:
    """Index of the object point nearest to the node around each point, and the distance to it [m]."""
    node = np.rint((points - target.nearest.origin) / target.nearest.spacing).astype(int)
    node = np.clip(node, 0, np.array(target.nearest.shape) - 1)
    index = target.nearest.values[tuple(np.moveaxis(node, -1, 0))]
    return index, np.linalg.norm(points - target.points[index], axis=-1)


# Starts


def start_grasps(
    scene: Scene, hand: HandShape, target: Target, count: int, rng: np.random.Generator
) -> tuple[Float[Array, "n 4 4"], Float[Array, "n d"], Int[Array, "n"]]:
    """For up to `count` surface points the best turn and preshape, pushed forward until the hand touches something."""
    gripper = hand.gripper
    frames = normal_frames(target, 2 * count, rng)
    turn = np.arange(TURNS) * np.pi / TURNS
    about_z = se3.rotation_exp(turn[:, None] * np.array([0.0, 0.0, 1.0]))
    R = frames[:, None, None, :3, :3] @ about_z[:, None] @ gripper.T_gripper_canonical[:3, :3].T
    preshapes = np.arange(len(gripper.preshapes))
    R = np.broadcast_to(R, (len(frames), TURNS, len(preshapes), 3, 3))
    tcp = np.array([preshape.tool_centre_point for preshape in gripper.preshapes])
    T = se3.from_parts(R, frames[:, None, None, :3, 3] - (R @ tcp[:, :, None])[..., 0])
    choice = np.full((len(frames), TURNS, len(preshapes)), np.inf)
    for index, preshape in enumerate(gripper.preshapes):
        pushed, is_free = push_forward(T[:, :, index].reshape(-1, 4, 4), index, hand, target)
        T[:, :, index] = pushed.reshape(*T.shape[:2], 4, 4)
        joints = np.broadcast_to(preshape.joints, (len(pushed), len(preshape.joints)))
        lack = np.where(is_free, cost(pushed, joints, hand, target), np.inf)
        choice[:, :, index] = lack.reshape(choice.shape[:2])
    flat = choice.reshape(len(frames), -1)
    best = np.argmin(flat, axis=-1)
    kept = np.flatnonzero(np.isfinite(flat.min(axis=-1)))[:count]
    chosen = best[kept] % len(preshapes)
    joints = np.array([preshape.joints for preshape in gripper.preshapes])[chosen]
    return T.reshape(len(frames), -1, 4, 4)[kept, best[kept]], joints, chosen


def normal_frames(target: Target, count: int, rng: np.random.Generator) -> Float[Array, "n 4 4"]:
    """Frames at random surface points: z against the normal, x across the axis along which the surface bends least."""
    heights = target.points @ target.up - target.table
    above = np.flatnonzero(heights > min(0.01, np.median(heights)))
    chosen = rng.choice(above, min(count, len(above)), replace=False)
    frames = np.empty((len(chosen), 4, 4))
    near = KDTree(target.points).query_ball_point(target.points[chosen], 0.02)
    for i, (point, around) in enumerate(zip(chosen, near, strict=True)):
        normals = target.normals[around].astype(float)
        straight = np.linalg.eigh(normals.T @ normals)[1][:, 0]
        mean = normals.mean(axis=0)
        z = -mean if np.linalg.norm(mean) > 0.1 else -target.normals[point].astype(float)
        rotation = se3.rotation_facing(z, np.cross(straight, z))
        frames[i] = se3.from_parts(rotation, target.points[point].astype(float))
    return frames


def push_forward(
    T: Float[Array, "m 4 4"], index: int, hand: HandShape, target: Target
) -> tuple[Float[Array, "m 4 4"], Bool[Array, "m"]]:
    """The hand in a preshape, as deep as it gets from 10 cm before to 10 cm behind its pose; whether it is free."""
    preshape, approach = hand.gripper.preshapes[index], hand.gripper.approach
    lowest_corner = (target.up @ T[:, :3, :3] @ preshape.outline.T).min(axis=-1) + T[:, :3, 3] @ target.up
    rise = T[:, :3, :3] @ approach @ target.up

    def moved(way: Float[Array, "m"]) -> Float[Array, "m 4 4"]:
        return T @ se3.translation(way[:, None] * approach)

    def is_free(way: Float[Array, "m"]) -> Bool[Array, "m"]:
        height = lowest_corner + way * rise - np.maximum(rise, 0) * hand.gripper.approach_distance
        clear = height - target.table > CLEARANCE
        for i, T_gripper in zip(np.flatnonzero(clear), se3.inverse(moved(way)[clear]), strict=True):
            clear[i] = not _hits(preshape.corridor, se3.apply(T_gripper, target.solid))
        return clear

    low, high = np.full(len(T), -0.1), np.full(len(T), 0.1)
    starts_free = is_free(low)
    for _ in range(6):
        middle = (low + high) / 2
        free = is_free(middle)
        low, high = np.where(free, middle, low), np.where(free, high, middle)
    return moved(low), starts_free


def _hits(field: Grid, points: Float[Array, "n 3"]) -> bool:
    """Whether any point is at a node within the body of a distance field."""
    node = np.rint((points - field.origin) / field.spacing).astype(int)
    node = node[np.all((node >= 0) & (node < field.shape), axis=-1)]
    return bool(np.any(field.values[tuple(node.T)] < 0))


# The swarms


@dataclass
class Swarm:
    """For each of c starts p particles in n dimensions."""

    position: Float[Array, "c p n"]
    lower: Float[Array, "n"]
    upper: Float[Array, "n"]

    def __post_init__(self) -> None:
        self.velocity = np.zeros_like(self.position)
        self.best = self.position.copy()
        self.best_cost = np.full(self.position.shape[:2], np.inf)

    def move(self, costs: Float[Array, "c p"], leader: Float[Array, "c n"], rng: np.random.Generator) -> None:
        """Remember what was better, then fly on towards each particle's best and the leader."""
        better = costs < self.best_cost
        self.best_cost = np.where(better, costs, self.best_cost)
        self.best = np.where(better[..., None], self.position, self.best)
        own, social = rng.random((2, *self.position.shape))
        self.velocity *= INERTIA
        self.velocity += OWN * own * (self.best - self.position) + SOCIAL * social * (leader[:, None] - self.position)
        self.position = np.clip(self.position + self.velocity, self.lower, self.upper)


def optimise(
    T: Float[Array, "c 4 4"],
    joints: Float[Array, "c d"],
    hand: HandShape,
    target: Target,
    particles: int,
    iterations: int,
    rng: np.random.Generator,
) -> tuple[Float[Array, "c 4 4"], Float[Array, "c d"], Float[Array, "k c"]]:
    """The best palm and joints of each start, and their cost before the first and after each iteration."""
    palms, fingers = palm_swarm(len(T), particles, rng), finger_swarm(joints, hand, particles, rng)
    offset, joints = np.zeros((len(T), 6)), joints.copy()
    best = cost(T, joints, hand, target)
    history = [best]
    for _ in range(iterations):
        trial = displaced(T, palms.position, hand)
        costs = swarm_cost(trial, np.broadcast_to(joints[:, None], fingers.position.shape), hand, target)
        best, offset = led(best, offset, costs, palms)
        palms.move(costs, offset, rng)
        now = np.broadcast_to(displaced(T, offset[:, None], hand), trial.shape)
        costs = swarm_cost(now, fingers.position, hand, target)
        best, joints = led(best, joints, costs, fingers)
        fingers.move(costs, joints, rng)
        history.append(best)
    return displaced(T, offset[:, None], hand)[:, 0], joints, np.array(history)


def palm_swarm(starts: int, particles: int, rng: np.random.Generator) -> Swarm:
    """Offsets and rotation vectors of the hand from its start, which is the first particle."""
    direction = rng.normal(size=(starts, particles, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    angle, shift = rng.uniform(-TURN, TURN, (starts, particles, 1)), rng.uniform(-SHIFT, SHIFT, direction.shape)
    position = np.concatenate([shift, angle * direction], axis=-1)
    position[:, 0] = 0
    return Swarm(position, np.full(6, -np.inf), np.full(6, np.inf))


def finger_swarm(joints: Float[Array, "c d"], hand: HandShape, particles: int, rng: np.random.Generator) -> Swarm:
    """Joint values from those of the start on towards closed; joints that spread, to both sides."""
    stroke = hand.gripper.closed_joints - hand.gripper.open_joints
    shape = (len(joints), particles, joints.shape[1])
    change = np.where(stroke != 0, STROKE * stroke * rng.random(shape), rng.uniform(-SPREAD, SPREAD, shape))
    change[:, 0] = 0
    return Swarm(np.clip(joints[:, None] + change, hand.lower, hand.upper), hand.lower, hand.upper)


def displaced(T: Float[Array, "c 4 4"], offset: Float[Array, "c p 6"], hand: HandShape) -> Float[Array, "c p 4 4"]:
    """The hand turned about its tool centre point and shifted, both in its own frame."""
    tcp = hand.gripper.tool_centre_point
    R = se3.rotation_exp(offset[..., 3:])
    return T[:, None] @ se3.from_parts(R, offset[..., :3] + tcp - R @ tcp)


def swarm_cost(
    T: Float[Array, "c p 4 4"], joints: Float[Array, "c p d"], hand: HandShape, target: Target
) -> Float[Array, "c p"]:
    """The cost of all particles, one start after the other, so that what is computed stays in the cache."""
    return np.reshape([cost(T[i], joints[i], hand, target) for i in range(len(T))], T.shape[:2])


def led(
    best: Float[Array, "c"], leader: Float[Array, "c n"], costs: Float[Array, "c p"], swarm: Swarm
) -> tuple[Float[Array, "c"], Float[Array, "c n"]]:
    """The lowest cost so far and where it was found: at the leader, or at the best particle of the swarm."""
    rows, first = np.arange(len(best)), np.argmin(costs, axis=-1)
    found = costs[rows, first]
    better = found < best
    return np.where(better, found, best), np.where(better[:, None], swarm.position[rows, first], leader)


# Execution


def way_in(
    T: Float[Array, "c 4 4"], joints: Float[Array, "c d"], hand: HandShape, target: Target, tally: dict[str, int]
) -> tuple[Float[Array, "n 4 4"], Float[Array, "n d"], Int[Array, "n"]]:
    """Grasp poses, backed off as little as possible, with their pregrasp joints, and which of the grasps they are."""
    tally |= {"in collision with the table": 0, "in collision with object or obstacles on the way in": 0}
    poses, pregrasps, kept = [], [], []
    for index in range(len(T)):
        opened = opened_joints(joints[index], hand)
        back = T[index] @ se3.translation(-STEPS_BACK[:, None] * hand.gripper.approach)
        T_link = back[None, :, None].astype(np.float32) @ hand.links(opened)[:, None]
        bodies = T_link.reshape(-1, *T_link.shape[2:])
        pose, _, depth = depths(hand, bodies, target.dense)
        hit = np.bincount(pose[depth > -CLEARANCE], minlength=len(bodies)).reshape(T_link.shape[:2])
        high = (lowest_corner(hand, bodies, target.up) > target.table + CLEARANCE).reshape(T_link.shape[:2])
        first = len(STEPS_BACK) - np.argmax(hit[1:, ::-1] > 0, axis=-1)  # the step after the last that hits
        first = np.where(np.any(hit[1:] > 0, axis=-1), first, 0)
        opening = int(np.argmin(first))
        step = first[opening]
        if step == len(STEPS_BACK) or STEPS_BACK[step] > LARGEST_RETREAT:
            tally["in collision with object or obstacles on the way in"] += 1
        elif not (np.all(high[: opening + 2, step]) and np.all(high[opening + 1, step:])):
            tally["in collision with the table"] += 1
        else:
            poses.append(back[step])
            pregrasps.append(opened[opening + 1])
            kept.append(index)
    d = joints.shape[1]
    return np.reshape(poses, (-1, 4, 4)), np.reshape(pregrasps, (-1, d)), np.array(kept, dtype=int)


def opened_joints(joints: Float[Array, "d"], hand: HandShape) -> Float[Array, "k d"]:
    """The grasp's joints, and these opened by each of `OPENINGS`; joints that only spread stay."""
    gripper = hand.gripper
    goal = np.where(gripper.closed_joints != gripper.open_joints, gripper.open_joints, joints)
    return joints + np.append(0.0, OPENINGS)[:, None] * (goal - joints)
