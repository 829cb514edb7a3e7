"""What happens when the fingers close: where they push the object, what they touch there, whether they hold it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import warp as wp
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from graspmatch.config import GripConfig
from graspmatch.geometry.cloud import farthest_along, first_of_voxels, nearest, normal_sector
from graspmatch.kernels import warp_hold, warp_reach, warp_wrench
from graspmatch.kernels.fields import in_blocks, pack_bytes
from graspmatch.kernels.launch import download, launch, upload
from graspmatch.kernels.warp_blocks import BLOCK
from graspmatch.kernels.warp_fields import NEVER
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.upload import ARRIVAL_STEP, DISTANCE_STEP, pose_arrays, upload_gripper
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper

Array = np.ndarray

GRAVITY = 9.81
"""[m/s2]"""
FINEST = 0.0025
"""Spacing of the points that fingers can touch, finer than which clouds are not [m]."""
ROOM = 0.012
"""Points farther from where fingers sweep are not touched, even if the object is pushed [m]."""
EDGE = 0.5
"""Cosine between normals of neighbours beside an edge, at most; those of opposite sides are the other way [-1, 1]."""
NEIGHBOURS = 8
"""Points in which an edge is looked for."""
NO_TABLE = -1.0e6
"""Height of the table where there is none [m]."""
SEARCHES = 6
"""Steps of the search for the wrench that friction cannot balance."""
DESCENTS = 12
"""Steps of the search for the weakest direction."""


class Room:
    """Scratch and results of `hold` on the device, for as many grasps as came at once so far."""

    def __init__(self) -> None:
        self.size = (0, 0, 0)

    def make(self, n: int, fingers: int, points: int, device: str) -> None:
        """Room for n grasps that reach so many points, unless there is."""
        if self.size[0] >= n and self.size[1:] == (fingers, points):
            return
        self.size = (n, fingers, points)
        self.contacts = room_for_contacts(n, fingers, device)
        self.reached = _room_for_points(n, fingers, points, device)
        self.fraction = wp.empty((n, fingers), dtype=wp.float32, device=device)
        self.figures = wp.empty((n, warp_hold.FIGURES), dtype=wp.float32, device=device)


@dataclass(frozen=True)
class Touchable:
    """The object as closing fingers meet it, on the device, and what it weighs on."""

    body: warp_reach.Body
    centre_of_mass: Float[Array, "3"]
    length: float
    """Root mean square distance of its surface from the centre of mass [m]: torques are measured by it."""
    room: Room
    """Where closing hands leave what they find: making it takes as long as closing some of them."""


@dataclass(frozen=True)
class Held:
    """What came of n grasps of f fingers."""

    held: Bool[Array, "n"]
    """Whether friction balanced the object's weight after the lift."""
    margin: Float[Array, "n"]
    """Smallest wrench that is not resisted then, besides the weight; below zero, what is missing to hold the object.
    In units of one finger's force and, for torques, of that times the object's length."""
    fraction: Float[Array, "n f"]
    """Closing fraction at which each finger touches; 2 where it does not."""
    contacts: Int[Array, "n"]
    """Of fingers and palm in the end."""
    pushed: Float[Array, "n"]
    """Way of the object's centre of mass while the fingers close [m] ..."""
    turned: Float[Array, "n"]
    """... and how far it turns [rad]."""
    slipped: Float[Array, "n"]
    """Way of the centre of mass after that [m]."""
    beyond: Float[Array, "n"]
    """How far from what was seen of the object a finger touches it in the end, at most [m]."""


@dataclass(frozen=True)
class HeldAt(Held):
    """And where: the contacts in the end, gripper frame, of the fingers, the palm and the table."""

    count: Int[Array, "n g"]
    point: Float[Array, "n g c 3"]
    """[m]"""
    push: Float[Array, "n g c 3"]
    """Unit vectors along which the contacts push the object: against its normals."""


def touchable(scene: Scene, most: int, device: str) -> Touchable:
    """The object thinned to at most so many evenly spread points, those of opposite sides kept apart."""
    points, normals = scene.target.points - scene.centre_of_mass, scene.target.normals
    assert normals is not None  # every scene estimates them
    spacing, sectors = FINEST, normal_sector(normals)
    index = first_of_voxels(points, spacing, labels=sectors)
    if len(index) > most:
        index = first_of_voxels(points, spacing * np.sqrt(len(index) / most), labels=sectors)
    index = np.random.default_rng(0).permutation(index)  # any of the first are spread evenly too
    down = -scene.table.normal if scene.table is not None else np.array([0.0, 0.0, -1.0])
    corners = points[farthest_along(OUTWARD, points)]
    body = warp_reach.Body()
    body.points = upload(points[index], wp.vec3, device)
    body.blocks = upload(in_blocks(points[index]).ravel(), wp.float32, device)
    body.normals = upload(normals[index], wp.vec3, device)
    body.is_edge = upload(beside_edge(points[index], normals[index]), wp.int32, device)
    body.beyond = upload(scene.beyond[index], wp.float32, device)
    body.corners = upload(corners, wp.vec3, device)
    body.down = wp.vec3(*down)
    body.table = NO_TABLE
    if scene.table is not None:
        body.table = float(scene.table.offset - scene.table.normal @ scene.centre_of_mass)
    length = max(float(np.sqrt(np.mean(np.sum(points[index] ** 2, axis=-1)))), 1e-3)
    return Touchable(body, scene.centre_of_mass, length, Room())


def beside_edge(points: Float[Array, "n 3"], normals: Float[Array, "n 3"]) -> Bool[Array, "n"]:
    """Whether a neighbour's normal is about across that of the point."""
    _, neighbours = nearest(points, NEIGHBOURS + 1)
    cosine = np.einsum("nki,ni->nk", normals[neighbours], normals)
    return np.any(np.abs(cosine) < EDGE, axis=-1)


def hold(
    candidates: Candidates,
    friction: Float[Array, "n"],
    target: Touchable,
    gripper: Gripper,
    config: GripConfig,
    device: str,
    *,
    upright: bool = False,
) -> Held:
    """Close the fingers of all candidates, each with its own friction, and lift. An object that stays upright is only
    pushed, not turned, and what holds it is asked before it is lifted."""
    n, room = len(candidates), target.room
    room.make(n, len(gripper.fingers), min(config.reachable_points, len(target.body.points)), device)
    inputs = [
        target.body,
        _touching_hand(gripper, device),
        pressure_of(gripper, friction, target.length, config, device),
        _course(gripper, config, upright=upright),
        _directions(device),
        *pose_arrays(candidates, target.centre_of_mass, device),
    ]
    outputs = [room.reached, room.contacts, room.fraction, room.figures]
    launch(warp_hold.hold, n, inputs, outputs, device)
    figures = download(room.figures)[:n].astype(float).T
    return Held(
        held=figures[warp_hold.STATE] == warp_hold.HELD,
        margin=figures[warp_hold.MARGIN],
        fraction=download(room.fraction)[:n].astype(float),
        contacts=figures[warp_hold.TOUCHES].astype(int),
        pushed=figures[0],
        turned=figures[1],
        slipped=figures[2],
        beyond=figures[warp_hold.BEYOND],
    )


def hold_at(
    candidates: Candidates,
    friction: Float[Array, "n"],
    target: Touchable,
    gripper: Gripper,
    config: GripConfig,
    device: str,
) -> HeldAt:
    """The same, and where the contacts are."""
    held = hold(candidates, friction, target, gripper, config, device)
    n, contacts = len(candidates), target.room.contacts
    return HeldAt(
        **vars(held),
        count=download(contacts.count)[:n].astype(int),
        point=download(contacts.point)[:n].astype(float),
        push=download(contacts.push)[:n].astype(float),
    )


def pressure_of(
    gripper: Gripper, friction: Float[Array, "n"], length: float, config: GripConfig, device: str
) -> warp_wrench.Pressure:
    """How the hand presses: drives of one finger as hard as all others against it, a drive of several as one."""
    pressure = warp_wrench.Pressure()
    pressure.drive, pressure.share = _drive_arrays(gripper, device)
    pressure.most = most_force(gripper)
    pressure.friction = upload(friction, wp.float32, device)
    pressure.torsion, pressure.length = config.torsional_friction, length
    return pressure


@lru_cache(maxsize=4)
def _drive_arrays(gripper: Gripper, device: str) -> tuple[wp.array, wp.array]:
    """For each finger the first one of its drive, and how many fingers that closes."""
    drive = drives(gripper)
    share = [drive.count(first) for first in drive]
    return upload(drive, wp.int32, device), upload(share, wp.float32, device)


@lru_cache(maxsize=4)
def _directions(device: str) -> wp.array:
    return upload(DIRECTIONS, wp.spatial_vector, device)


@lru_cache(maxsize=4)
def most_force(gripper: Gripper) -> float:
    """How much harder than rated a finger can press: with a drive of its own, as hard as all others against it."""
    own = len(set(drives(gripper))) == len(gripper.fingers)
    return float(max(len(gripper.fingers) - 1, 1)) if own else 1.0


def drives(gripper: Gripper) -> list[int]:
    """For each finger the first one that a joint of its closes too."""
    joints = [set(finger.joints) for finger in gripper.fingers]
    return [next(g for g, other in enumerate(joints) if other & own) for own in joints]


def _course(gripper: Gripper, config: GripConfig, *, upright: bool) -> warp_hold.Course:
    course = warp_hold.Course()
    course.step, course.patch = config.step, config.patch_depth
    course.turns, course.closing_steps = 0.0 if upright else 1.0, config.closing_steps
    course.lifting_steps = 0 if upright else config.lifting_steps
    course.weight = config.mass * GRAVITY / gripper.finger_force
    course.tolerance = min(config.balanced, course.weight / 2)  # what lies on nothing falls
    course.searches, course.descents = SEARCHES, DESCENTS
    return course


@lru_cache(maxsize=4)
def _touching_hand(gripper: Gripper, device: str) -> warp_reach.Hand:
    """Fields of all preshapes, and where they can touch something, the hand before it closes included."""
    uploaded = upload_gripper(gripper, device)
    out_of_reach = []
    for preshape in gripper.preshapes:
        touches = np.any(preshape.arrival < NEVER, axis=0) | (np.abs(preshape.hand.values) < preshape.hand.spacing)
        steps = max(int(np.ceil(ROOM / preshape.hand.spacing)), 1)
        near = ndimage.binary_dilation(touches, iterations=steps)
        out_of_reach.append(np.where(near, 0, 1).astype(np.uint8))
    hand = warp_reach.Hand()
    hand.arrival, hand.distance = uploaded.arrival, uploaded.matching.distance
    hand.arrival_levels, hand.arrival_step = uploaded.arrival_levels, ARRIVAL_STEP
    hand.slowest = upload(uploaded.slowest, wp.float32, device)
    hand.pivot = upload(uploaded.pivots, wp.vec3, device)
    hand.approach = wp.vec3(*gripper.approach)
    hand.distance_levels, hand.distance_step = uploaded.matching_levels, DISTANCE_STEP
    hand.out_of_reach = pack_bytes(out_of_reach, device)
    hand.swept_levels, hand.room = uploaded.swept_levels, ROOM
    return hand


def room_for_contacts(n: int, fingers: int, device: str) -> warp_wrench.Contacts:
    """None yet, of n grasps."""
    shape = (n, fingers + 2, warp_wrench.CORNERS)
    contacts = warp_wrench.Contacts()
    contacts.count = wp.zeros(shape[:2], dtype=wp.int32, device=device)
    contacts.point = wp.zeros(shape, dtype=wp.vec3, device=device)
    contacts.push = wp.zeros(shape, dtype=wp.vec3, device=device)
    contacts.centre = wp.zeros(n, dtype=wp.vec3, device=device)
    contacts.beyond = wp.zeros(shape[:2], dtype=wp.float32, device=device)
    contacts.touching = wp.zeros(shape[:2], dtype=wp.int32, device=device)
    contacts.start = wp.zeros((n, fingers + 3), dtype=wp.int32, device=device)
    contacts.rows = wp.zeros((n, 7, (fingers + 2) * warp_wrench.CORNERS), dtype=wp.float32, device=device)
    return contacts


def _room_for_points(n: int, fingers: int, room: int, device: str) -> warp_reach.Reached:
    reached = warp_reach.Reached()
    blocks = -(-room // BLOCK)
    reached.index = wp.empty((n, fingers + 2, room), dtype=wp.int32, device=device)
    reached.blocks = wp.empty((n, fingers + 2, blocks * 3 * BLOCK), dtype=wp.float32, device=device)
    reached.size = wp.empty((n, fingers + 2), dtype=wp.int32, device=device)
    reached.count = wp.empty((n, fingers + 1), dtype=wp.int32, device=device)
    reached.near = wp.empty((n, fingers + 1, blocks * BLOCK), dtype=wp.int32, device=device)
    reached.excess = wp.empty((n, fingers + 1, blocks * BLOCK), dtype=wp.float32, device=device)
    reached.slowness = wp.empty((n, fingers, 4, blocks * BLOCK), dtype=wp.float32, device=device)
    return reached


def _unit_vectors(count: int, dimensions: int) -> Float[Array, "k d"]:
    """Unit vectors: both ways along each axis, and some at random."""
    drawn = np.random.default_rng(0).normal(size=(count - 2 * dimensions, dimensions))
    vectors = np.concatenate([np.eye(dimensions), -np.eye(dimensions), drawn])
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


DIRECTIONS = _unit_vectors(64, 6)
"""In the space of wrenches, from which the search for the weakest one starts."""
OUTWARD = _unit_vectors(128, 3)
"""In which the object's corners are looked for."""
