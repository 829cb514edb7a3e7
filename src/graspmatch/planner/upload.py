"""The hand on the device: uploaded once per gripper and device, and kept."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import warp as wp
from jaxtyping import Float, Int
from scipy import ndimage

from graspmatch.geometry.cloud import hull_corners
from graspmatch.geometry.grid import Grid
from graspmatch.kernels import warp_collide
from graspmatch.kernels.fields import in_blocks, pack_levels, stack_fields
from graspmatch.kernels.launch import upload
from graspmatch.kernels.warp_fields import NEVER, FieldStack
from graspmatch.planner.candidates import Candidates
from graspmatch.types import Gripper, Preshape

DISTANCE_STEP = 0.00025
"""Between levels of distance fields [m]: the last one is 6 cm away."""
ARRIVAL_STEP = 1 / 250
"""Between levels of closing fractions."""
SLOWEST = 1.5
"""Times as long as 99 % of a finger's surface takes: longer than hardly any of it."""
MARGIN = 2
"""Nodes, so that those on the border of what is swept have neighbours."""


@dataclass(frozen=True)
class DeviceHand:
    """All preshapes of a gripper. Matching works about each preshape's pivot, its tool centre point."""

    matching: warp_collide.Hand
    samples: Int[np.ndarray, "p"]
    """Number of samples of each preshape that are matched: the first ones, those that have weight."""
    starts: Int[np.ndarray, "p"]
    """First sample of each preshape."""
    rows: Float[np.ndarray, "4 n"]
    """x, y, z [m] about the pivot and weight of all samples."""
    pivots: Float[np.ndarray, "p 3"]
    """[m], gripper frame."""
    matching_levels: wp.array
    """Of the distances in `matching`."""
    outline: wp.array
    """Corners of all preshapes about their pivots, in blocks."""
    corners: Float[np.ndarray, "p v 3"]
    """Of the convex hull of the open hand, gripper frame [m]; those that have fewer have their first one again."""
    hulls: wp.array
    """The same on the device."""
    swept_corners: Float[np.ndarray, "p f v 3"]
    """The same for what each finger sweeps when it closes."""
    corridor: FieldStack
    """Gripper frame."""
    corridor_levels: wp.array
    arrival: FieldStack
    """One grid for each finger of each preshape, gripper frame."""
    arrival_levels: wp.array
    slowest: Float[np.ndarray, "g"]
    """For each grid the closing fraction that hardly any part of the finger's surface takes for a metre [1/m]."""
    swept_levels: wp.array
    """Of the distances from what each finger sweeps, on the same grids."""


@lru_cache(maxsize=4)
def upload_gripper(gripper: Gripper, device: str) -> DeviceHand:
    """Samples, fields and outlines of all preshapes."""
    preshapes = gripper.preshapes
    arrivals = [grid for preshape in preshapes for grid in swept_grids(preshape)]
    corridors = [preshape.corridor for preshape in preshapes]
    outlines = [in_blocks(preshape.outline - preshape.tool_centre_point) for preshape in preshapes]
    corners = padded([hull_corners(preshape.outline) for preshape in preshapes])
    return DeviceHand(
        matching=_matching_hand(preshapes, device),
        corners=corners,
        hulls=wp.array(corners, dtype=wp.vec3, device=device),
        swept_corners=swept_corners(preshapes),
        outline=wp.array(np.concatenate(outlines).ravel(), dtype=wp.float32, device=device),
        samples=np.array([np.count_nonzero(preshape.weights) for preshape in preshapes]),
        starts=np.cumsum([0, *(len(preshape.weights) for preshape in preshapes[:-1])]),
        rows=np.concatenate([sample_rows(preshape) for preshape in preshapes], axis=1),
        pivots=np.array([preshape.tool_centre_point for preshape in preshapes]),
        matching_levels=pack_levels([preshape.hand for preshape in preshapes], DISTANCE_STEP, device),
        corridor=stack_fields(corridors, device),
        corridor_levels=pack_levels(corridors, DISTANCE_STEP, device),
        arrival=stack_fields(arrivals, device),
        arrival_levels=pack_levels(arrivals, ARRIVAL_STEP, device),
        slowest=np.array([slowest_of(arrival) for arrival in arrivals]),
        swept_levels=pack_levels([swept_distance(arrival) for arrival in arrivals], DISTANCE_STEP, device),
    )


def _matching_hand(preshapes: tuple[Preshape, ...], device: str) -> warp_collide.Hand:
    samples = [preshape.samples.points - preshape.tool_centre_point for preshape in preshapes]
    inertia = [inverse_inertia(s, p.weights) for s, p in zip(samples, preshapes, strict=True)]
    hand = warp_collide.Hand()
    hand.samples = wp.array(np.concatenate(samples), dtype=wp.vec3, device=device)
    hand.weights = wp.array(np.concatenate([p.weights for p in preshapes]), dtype=wp.float32, device=device)
    hand.start, _ = _spans(samples, device)
    _, hand.count = _spans([p.weights[p.weights > 0] for p in preshapes], device)
    hand.tool_centre_point = wp.zeros(len(preshapes), dtype=wp.vec3, device=device)
    hand.inverse_inertia = wp.array(np.array(inertia), dtype=wp.mat33, device=device)
    hand.distance = stack_fields([p.hand.shifted(-p.tool_centre_point) for p in preshapes], device)
    hand.distance_step = DISTANCE_STEP
    nearest = np.concatenate([preshape.nearest_sample.ravel() for preshape in preshapes])
    hand.nearest_sample = wp.array(nearest, dtype=wp.int32, device=device)
    hand.outline_start, _ = _spans([in_blocks(preshape.outline) for preshape in preshapes], device)
    _, hand.outline_count = _spans([preshape.outline for preshape in preshapes], device)
    return hand


def swept_grids(preshape: Preshape) -> list[Grid]:
    """When each finger arrives, where any of them does and `MARGIN` nodes around: little of a hand's grid, so that it
    stays in a core's cache."""
    arrives = np.any(preshape.arrival < NEVER, axis=0)
    reaches = [np.any(arrives, axis=others) for others in ((1, 2), (0, 2), (0, 1))]
    first = np.array([max(np.argmax(there) - MARGIN, 0) for there in reaches])
    end = np.array([len(there) - max(np.argmax(there[::-1]) - MARGIN, 0) for there in reaches])
    box = tuple(slice(a, b) for a, b in zip(first, end, strict=True))
    origin = preshape.hand.origin + preshape.hand.spacing * first
    return [Grid(origin, preshape.hand.spacing, arrival[box]) for arrival in preshape.arrival]


def slowest_of(arrival: Grid) -> float:
    """The closing fraction that hardly any part of a finger's surface takes for a metre [1/m]."""
    swept = np.where(arrival.values < NEVER, arrival.values, np.nan)
    slowness = np.linalg.norm(np.gradient(swept, arrival.spacing), axis=0)
    known = slowness[np.isfinite(slowness)]
    return SLOWEST * float(np.quantile(known, 0.99)) if len(known) else np.inf


def swept_distance(arrival: Grid) -> Grid:
    """How far each node is from those that the finger sweeps [m]."""
    nodes = np.asarray(ndimage.distance_transform_edt(arrival.values >= NEVER))
    return replace(arrival, values=arrival.spacing * nodes)


def swept_corners(preshapes: tuple[Preshape, ...]) -> Float[np.ndarray, "p f v 3"]:
    """Of the convex hull of what each finger of each preshape sweeps when it closes."""
    hulls = [hull_corners(swept.reshape(-1, 3)) for preshape in preshapes for swept in preshape.finger_outlines]
    corners = padded(hulls)
    return corners.reshape(len(preshapes), -1, *corners.shape[1:])


def padded(clouds: list[Float[np.ndarray, "_ 3"]]) -> Float[np.ndarray, "n m 3"]:
    """Clouds of different lengths as one array; the shorter ones have their first point again."""
    longest = max(len(cloud) for cloud in clouds)
    return np.array([np.concatenate([cloud, np.tile(cloud[:1], (longest - len(cloud), 1))]) for cloud in clouds])


def sample_rows(preshape: Preshape) -> Float[np.ndarray, "4 n"]:
    """x, y, z [m] about the pivot and weight of each sample."""
    return np.vstack([(preshape.samples.points - preshape.tool_centre_point).T, preshape.weights])


def _spans(parts: list[np.ndarray], device: str) -> tuple[wp.array, wp.array]:
    """First index and length of each part when they lie one behind the other."""
    lengths = [len(part) for part in parts]
    return tuple(wp.array(v, dtype=wp.int32, device=device) for v in (np.cumsum([0, *lengths[:-1]]), lengths))  # type: ignore[return-value]


def inverse_inertia(points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, "n"]) -> Float[np.ndarray, "3 3"]:
    """Rotational block of A in eq. (3): inverse of the Gauss-Newton matrix sum w (|s|^2 I - s s^T) / sum w [1/m2].

    A millionth of a square metre keeps it finite for samples on a line.
    """
    second = np.einsum("n,ni,nj->ij", weights, points, points) / weights.sum()
    return np.linalg.inv((np.trace(second) + 1e-6) * np.eye(3) - second)


def lowest(
    corners: Float[np.ndarray, "p *parts v 3"], preshape: Int[np.ndarray, "n"], up: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n *parts"]:
    """How far up the lowest corner of each candidate's preshape lies from its origin, of each part where there are
    several [m]; `up` are unit vectors in the frame of the corners."""
    least = np.empty((len(preshape), *corners.shape[1:-2]))
    for index in np.unique(preshape):
        chosen = np.flatnonzero(preshape == index)
        along = up[chosen] @ corners[index].reshape(-1, 3).T
        least[chosen] = along.reshape(len(chosen), *corners.shape[1:-1]).min(axis=-1, initial=np.inf)
    return least


def pose_arrays(
    candidates: Candidates,
    centre_of_mass: Float[np.ndarray, "3"],
    device: str,
    pivots: Float[np.ndarray, "p 3"] | None = None,
) -> list[wp.array]:
    """Preshape and pose of each candidate as the kernels take them, object frame: the pose of the gripper frame, or of
    that at the pivot of its preshape."""
    T_object_hand = candidates.T_world_gripper.copy()
    T_object_hand[:, :3, 3] -= centre_of_mass
    if pivots is not None:
        T_object_hand[:, :3, 3] += np.einsum("nij,nj->ni", T_object_hand[:, :3, :3], pivots[candidates.preshape])
    return [upload(candidates.preshape, wp.int32, device), upload(T_object_hand, wp.mat44, device)]
