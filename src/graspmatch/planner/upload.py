"""The hand on the device: uploaded once per gripper and device, and kept."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from graspmatch.geometry.grid import Grid
from graspmatch.kernels import warp_match
from graspmatch.kernels.fields import stack_fields
from graspmatch.kernels.warp_fields import FieldStack
from graspmatch.planner.candidates import Candidates
from graspmatch.types import Gripper, Preshape


@dataclass(frozen=True)
class DeviceHand:
    """All preshapes of a gripper. Matching works about each preshape's pivot, its tool centre point."""

    matching: warp_match.Hand
    samples: Int[np.ndarray, "p"]
    """Number of samples of each preshape."""
    pivots: Float[np.ndarray, "p 3"]
    """[m], gripper frame."""
    corridor: FieldStack
    """Gripper frame."""
    arrival: FieldStack
    """One grid for each finger of each preshape, gripper frame."""


@lru_cache(maxsize=4)
def upload_gripper(gripper: Gripper, device: str) -> DeviceHand:
    """Samples, fields and outlines of all preshapes."""
    preshapes = gripper.preshapes
    arrivals = [Grid(p.hand.origin, p.hand.spacing, arrival) for p in preshapes for arrival in p.arrival]
    return DeviceHand(
        matching=_matching_hand(preshapes, device),
        samples=np.array([len(preshape.weights) for preshape in preshapes]),
        pivots=np.array([preshape.tool_centre_point for preshape in preshapes]),
        corridor=stack_fields([preshape.corridor for preshape in preshapes], device),
        arrival=stack_fields(arrivals, device),
    )


def _matching_hand(preshapes: tuple[Preshape, ...], device: str) -> warp_match.Hand:
    samples = [preshape.samples.points - preshape.tool_centre_point for preshape in preshapes]
    outlines = [preshape.outline - preshape.tool_centre_point for preshape in preshapes]
    inertia = [inverse_inertia(s, p.weights) for s, p in zip(samples, preshapes, strict=True)]
    hand = warp_match.Hand()
    hand.samples = wp.array(np.concatenate(samples), dtype=wp.vec3, device=device)
    hand.weights = wp.array(np.concatenate([p.weights for p in preshapes]), dtype=wp.float32, device=device)
    hand.start, hand.count = _spans(samples, device)
    hand.tool_centre_point = wp.zeros(len(preshapes), dtype=wp.vec3, device=device)
    hand.inverse_inertia = wp.array(np.array(inertia), dtype=wp.mat33, device=device)
    hand.distance = stack_fields([p.hand.shifted(-p.tool_centre_point) for p in preshapes], device)
    nearest = np.concatenate([preshape.nearest_sample.ravel() for preshape in preshapes])
    hand.nearest_sample = wp.array(nearest, dtype=wp.int32, device=device)
    hand.outline = wp.array(np.concatenate(outlines), dtype=wp.vec3, device=device)
    hand.outline_start, hand.outline_count = _spans(outlines, device)
    return hand


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


def pose_arrays(candidates: Candidates, centre_of_mass: Float[np.ndarray, "3"], device: str) -> list[wp.array]:
    """Preshape, position and rotation of each candidate as the kernels take them, object frame."""
    return [
        wp.array(candidates.preshape, dtype=wp.int32, device=device),
        wp.array(candidates.T_world_gripper[:, :3, 3] - centre_of_mass, dtype=wp.vec3, device=device),
        wp.array(candidates.quaternions_xyzw(), dtype=wp.quat, device=device),
    ]
