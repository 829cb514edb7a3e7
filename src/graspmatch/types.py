"""The nouns that more than one stage shares. Metres, radians, newtons; `T_a_b` maps b-coordinates to a-coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from graspmatch.errors import GraspmatchError as GraspmatchError
from graspmatch.geometry.grid import Grid
from graspmatch.geometry.mesh import TriangleMesh

Array = np.ndarray


@dataclass(frozen=True)
class PointCloud:
    """Points, and outward unit normals where they are known."""

    points: Float[Array, "n 3"]
    """[m]"""
    normals: Float[Array, "n 3"] | None = None


@dataclass(frozen=True)
class Plane:
    """The points x with normal . x = offset; the free side is where the normal points."""

    normal: Float[Array, "3"]
    offset: float
    """[m]"""


@dataclass(frozen=True)
class Finger:
    """One finger: the links that move together and the driven joints that move them."""

    name: str
    links: tuple[str, ...]
    joints: tuple[int, ...]
    """Indices into `Gripper.joint_names` of the driven joints that close this finger."""


@dataclass(frozen=True)
class Link:
    """One rigid body of the hand, geometry in its own frame."""

    name: str
    collision: TriangleMesh
    """What can touch."""
    visual: TriangleMesh
    """What a picture shows."""
    rgba: tuple[float, float, float, float]


@dataclass(frozen=True)
class Preshape:
    """One posture of the fingers as one rigid shape in the gripper frame, with all that matching asks of it."""

    name: str
    joints: Float[Array, "d"]
    """Driven joint values."""
    is_fingertips: bool
    """Whether the fingertips alone hold: for thin, flat and small things."""
    closed: Float[Array, "d"]
    """Those at which closing from here ends when nothing stops the fingers."""
    samples: PointCloud
    """S: samples of the inner surface, with normals; those without weight last."""
    weights: Float[Array, "n"]
    """Weight of each sample in the matching error; their mean is one."""
    tool_centre_point: Float[Array, "3"]
    """TCP [m]: the weighted centre of the inner surface, as the paper defines it."""
    hand: Grid
    """G: signed distance of the whole hand [m], negative inside."""
    corridor: Grid
    """Smallest value of G on the straight way in: signed distance of the volume that the approach sweeps [m]."""
    nearest_sample: Int[Array, "nx ny nz"]
    """Index of the nearest sample at each node of the grid `hand`."""
    arrival: Float[Array, "f nx ny nz"]
    """Closing fraction at which each finger first covers the node, on the grid `hand`; 2 where it never does."""
    outline: Float[Array, "v 3"]
    """Corners of the convex hulls of all links [m]: a plane clear of them is clear of the hand."""
    finger_outlines: tuple[Float[Array, "k _ 3"], ...]
    """For each finger, the same for its links at k closing fractions, evenly from 0 to 1."""


@dataclass(
    frozen=True, eq=False
)  # equal is identical: arrays have no truth, and what is made from a hand is kept by it
class Gripper:
    """A hand: its description, its frames and its baked preshapes. The gripper frame is the base link of the file."""

    name: str
    description: Path
    """The URDF or MJCF file."""
    base_link: str
    joint_names: tuple[str, ...]
    """The d driven joints; couplings of the file and of the card give the others."""
    lower: Float[Array, "d"]
    upper: Float[Array, "d"]
    open_joints: Float[Array, "d"]
    closed_joints: Float[Array, "d"]
    """Where a driven joint that closes ends, if the preshape does not say otherwise; of one that only spreads, its open
    value."""
    links: tuple[Link, ...]
    fingers: tuple[Finger, ...]
    approach: Float[Array, "3"]
    """Unit vector towards the object, gripper frame."""
    closing: Float[Array, "3"]
    """Unit vector along which the fingers close, gripper frame."""
    tool_centre_point: Float[Array, "3"]
    """Where the fingertips meet [m], gripper frame."""
    finger_force: float
    """Rated force of one finger [N]."""
    opening: float
    """Widest clear distance between the fingers [m]."""
    approach_distance: float
    """Length of the straight way in [m], which the preshapes' corridors cover."""
    preshapes: tuple[Preshape, ...]
    content_hash: str
    """Of the card, the description and its meshes."""

    @property
    def T_gripper_canonical(self) -> Float[Array, "4 4"]:
        """Canonical frame: origin at the base, +z approach, +x closing."""
        T = np.eye(4)
        T[:3, :3] = np.stack([self.closing, np.cross(self.approach, self.closing), self.approach], axis=-1)
        return T

    @property
    def T_gripper_pregrasp(self) -> Float[Array, "4 4"]:
        """Where the straight way in begins, as the hand at the grasp sees it."""
        T = np.eye(4)
        T[:3, 3] = -self.approach_distance * self.approach
        return T


@dataclass(frozen=True)
class Provenance:
    """Where a set of grasps came from."""

    gripper: str
    gripper_hash: str
    config: str
    """The planner's configuration as JSON."""
    seed: int
    device: str
    version: str
    source: str = ""
    """File or array that the scene came from."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of each stage [s]."""


@dataclass(frozen=True)
class GraspSet:
    """n grasps, best first; length zero when there are none, and `explain()` says why."""

    joint_names: tuple[str, ...]
    preshape_names: tuple[str, ...]
    T_world_gripper: Float[Array, "n 4 4"]
    T_world_pregrasp: Float[Array, "n 4 4"]
    """Where the straight approach begins."""
    preshape: Int[Array, "n"]
    """Index into `preshape_names`."""
    pregrasp_joints: Float[Array, "n d"]
    grasp_joints: Float[Array, "n d"]
    """Driven joint values at first contact. Fingers on one drive stop at the mean of their contacts: where they meet
    the object one after the other, the first pushes it until the last touches too."""
    score: Float[Array, "n"]
    """Confidence, 0 to 1: the share of grasps like this one that arrive and hold where one arrival in four is a few
    millimetres off; of what a camera sees, every one (`grip.inexact`). Less by the share of the object's outline in the
    image that something nearer hides (`Scene.cut`), and the farther from what was seen a finger touches."""
    quality: Float[Array, "n"]
    """Smallest wrench that the closed fingers cannot resist besides the object's weight, averaged over small errors of
    the pose, in units of one finger's force; below zero, what is missing to hold the object."""
    clearance: Float[Array, "n"]
    """Smallest distance of hand and approach to object, obstacles and table [m], positive when free."""
    matching_error: Float[Array, "n"]
    """Mean squared distance of the inner surface to the object, eq. (14) [m2]."""
    loss: Float[Array, "n"]
    """The paper's whole loss, eq. (13) [m2]."""
    fingers_touching: Int[Array, "n"]
    """How many fingers meet the object when they close."""
    tally: dict[str, int]
    """How many candidates each stage began with and dropped, in order: reason to count."""
    provenance: Provenance
    advice: str = ""
    """What would help, when nothing is left."""

    def __len__(self) -> int:
        return len(self.T_world_gripper)

    def best(self, count: int) -> GraspSet:
        """The first so many."""
        per_grasp = {
            entry.name: getattr(self, entry.name)[:count]
            for entry in fields(self)
            if isinstance(getattr(self, entry.name), np.ndarray)
        }
        return replace(self, **per_grasp)

    def explain(self) -> str:
        """What became of the candidates, as text."""
        total = self.tally.get("candidates", 0)
        lines = [f"{len(self)} grasp{'s' * (len(self) != 1)} for {self.provenance.gripper} from {total} candidates."]
        lines += [f"  {count:6d}  {reason}" for reason, count in self.tally.items() if reason != "candidates" and count]
        return "\n".join(lines + ([self.advice] if self.advice else []))


@dataclass(frozen=True)
class SimulationReport:
    """Verdicts of the simulator on n grasps, in their order."""

    protocol: str
    """`lift`, `fc6` or `tug`."""
    settings: str
    """The protocol's configuration as JSON: friction and all."""
    engine: str
    gripper: str
    object: str
    mass: float
    """Of the object [kg]."""
    bulge: float
    """How far the convex parts that physics knows reach beyond the mesh, at 95 % of their surface [m]."""
    held: Bool[Array, "n"]
    reason: tuple[str, ...]
    """Why each did not hold; empty where it held."""
    slip: Float[Array, "n"]
    """Motion of the object in the hand after closing [m]."""
    turn: Float[Array, "n"]
    """[rad]"""
    push: Float[Array, "n"]
    """Motion of the object before closing [m]."""
    fingers_touching: Int[Array, "n"]
    """Fingers on the object when they had closed."""
    seconds: Float[Array, "n"]
    """Wall time of each trial [s]."""

    def __len__(self) -> int:
        return len(self.held)
