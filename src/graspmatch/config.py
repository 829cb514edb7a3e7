"""The planner's knobs, one frozen dataclass per stage. Defaults are Table I of the paper where it has a value."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

Method = Literal["icp", "sgd-icp", "stein-icp", "annealed-stein-icp"]
SampleMethod = Literal["mesh", "camera"]


@dataclass(frozen=True)
class BakingConfig:
    """How a preshape becomes samples and fields. Everything here is part of the cache's key."""

    grid_spacing: float = 0.003
    """Spacing of the fields of the whole hand [m]."""
    link_spacing: float = 0.002
    """Spacing of the signed distance field of a single link [m]."""
    margin: float = 0.02
    """How far the fields reach beyond the hand [m]."""
    approach_distance: float = 0.15
    """Length of the straight way in that must be free [m]."""
    fewest_closing_steps: int = 24
    """Postures into which the closing motion is cut; more where a finger would move over a grid cell at once."""


@dataclass(frozen=True)
class PoseGaussian:
    """One Gaussian over poses of the gripper in the world."""

    position: tuple[float, float, float]
    """Mean origin of the gripper frame [m]."""
    wxyz: tuple[float, float, float, float]
    """Mean rotation."""
    sigma_position: float = 0.02
    """[m]"""
    sigma_angle: float = 0.2
    """[rad]"""
    weight: float = 1.0


@dataclass(frozen=True)
class SeedingConfig:
    """Where the particles start."""

    pattern: Literal["quarter", "sphere", "gaussians"] = "quarter"
    """Fibonacci points on the quarter sphere that faces the robot, on the full sphere, or draws from `gaussians`."""
    points: int = 94
    """Fibonacci points on the full sphere; `quarter` keeps a quarter of them: (100 - 6) / 4 in Table I."""
    above: int = 6
    """Seeds straight above the object, at evenly spread turns of the hand."""
    fingertips: int = 240
    """Seeds of the fingertips, at opposite points of the surface; 0: none."""
    batches: int = 3
    """So many times at most hands are started anew while no grasp is as sure as `refining.enough`, every second time
    the fingertips alone."""
    robot_direction: tuple[float, float, float] = (-1.0, 0.0, 0.0)
    """Horizontal direction from the object towards the robot, world frame."""
    gaussians: tuple[PoseGaussian, ...] = ()
    """For the pattern `gaussians`: the mixture that `points` poses are drawn from."""


@dataclass(frozen=True)
class MatchingConfig:
    """Algorithm 1."""

    method: Method = "annealed-stein-icp"
    iterations: int = 40
    """k_max."""
    stein_iterations: int = 15
    """k_stein: iterations of (annealed) Stein ICP before SGD-ICP."""
    learning_rate: float = 1.0
    """eta of eqs. (3) and (7)."""
    voxel_size: float = 0.005
    """Spacing of the target cloud R [m]."""
    collision_points: int = 1500
    """Size of the cloud C that collisions are checked with while matching: Table I has 1100 to 1900."""
    batch_from: Literal["gripper", "object"] = "gripper"
    """Which cloud the growing mini-batch is drawn from: the paper says both."""
    com_weight: float = 1.0
    """Weight of the centre-of-mass term, eq. (13)."""
    com_gradient: Literal["loss", "paper"] = "loss"
    """Scale of its gradient: that of the loss (13), or divided by the batch size as eqs. (16) and (17) print it."""
    annealing_cycles: int = 5
    """C of eq. (11)."""
    annealing_exponent: float = 2.0
    """p of eq. (11)."""
    repulsion: float = 1.0
    """Weight of the kernel's gradient in eq. (8), 1 as printed: the variance [m2] that the likelihood gives a residual.
    Zero turns the particles' repulsion off."""
    longest_step: float = 0.05
    """Farthest a particle moves in one Stein step [m]: the repulsion of near particles grows without bound."""
    prior_translation: float = 0.3
    """Standard deviation of the Gaussian prior around each seed [m]."""
    prior_concentration: float = 1.0
    """Concentration kappa of the von Mises prior around each seed's rotation."""
    convergence: float = 2e-4
    """Relative change of the loss below which a free particle has converged."""


@dataclass(frozen=True)
class CollisionConfig:
    """What counts as free after matching."""

    clearance: float = 0.002
    """Least distance of hand and approach to everything [m]; scans bulge, and a touch topples a bottle."""
    largest_retreat: float = 0.05
    """How far a match may be backed off along its approach until it is free [m]."""
    may_open: bool = True
    """Whether a hand may arrive in a wider preshape than was matched: to get free, or for more room."""


@dataclass(frozen=True)
class ClosingConfig:
    """What the fingers must meet when they close."""

    fewest_fingers: int = 2


@dataclass(frozen=True)
class PathConfig:
    """What the way of the hand must keep to, from where its approach begins to where the object is out."""

    lift_height: float = 0.2
    """After closing the hand goes straight up by so much [m]; where things are in the way of hand or object, it goes
    back along its approach instead. 0: the way out is not looked at."""
    workspace: tuple[float, float, float, float, float, float] | None = None
    """Box that the whole hand stays in: least x, y, z and largest x, y, z [m], world frame."""
    approach_along: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Middle of the directions in which hands may approach, world frame; by default from above."""
    approach_angle: float = math.pi
    """Largest angle between the approach and `approach_along` [rad]; by default every direction is allowed."""


@dataclass(frozen=True)
class GripConfig:
    """How the contacts of closed fingers are judged."""

    frictions: tuple[float, ...] = (0.15, 0.3, 0.45)
    """Sliding frictions under which a grasp is tried in turn: rubber on wood or plastic has 0.6, wet or dusty less."""
    torsional_friction: float = 0.005
    """Torque about a contact's normal for each newton [m]."""
    mass: float = 0.3
    """Of an object whose weight must be carried [kg]."""
    patch_depth: float = 0.002
    """How near to a finger that touches more of the object must be, to count as touching too [m]."""
    finalists: int = 24
    """So many promising candidates are tried ..."""
    first_trials: int = 6
    """... so many times, the hand a little displaced, ..."""
    leaders: int = 8
    """... and the surest of them ..."""
    trials: int = 18
    """... so many times in all."""
    position_error: float = 0.002
    """Standard deviation of the displacements along each axis [m] ..."""
    angle_error: float = math.radians(2.0)
    """... and about each axis [rad], through the hand's base."""
    ways_in: int = 24
    """So many times the way in is looked at, the hand displaced more than that: closing fingers centre an object, but
    what meets it on the way fails at once."""
    way_position_error: float = 0.003
    """[m]"""
    way_angle_error: float = math.radians(3.0)
    """[rad]"""
    way_clearance: float = 0.001
    """That a displaced hand must still keep on its way in: meshes, scans and fields are wrong by as much [m]."""
    inexact: float | None = None
    """Share of arrivals that are so displaced; in the others the hand comes as planned. 1 for a robot that is never
    better calibrated than that. None: 0.25 where a mesh tells the whole surface, else 1, for what a camera sees is
    never where it is seen."""
    points: int = 2000
    """Of the object, at most so many ..."""
    reachable_points: int = 400
    """... and of those that one hand can reach."""
    step: float = 0.004
    """Of the object as it gives way [m]."""
    closing_steps: int = 20
    """At most so many while the fingers close ..."""
    lifting_steps: int = 10
    """... and after that, before it counts as lost."""
    balanced: float = 0.03
    """Wrenches that are smaller than this, in units of one finger's force, move nothing."""


@dataclass(frozen=True)
class RefiningConfig:
    """Moving the best grasps a little where that makes them surer."""

    count: int = 6
    """So many of them; 0: none."""
    rounds: int = 3
    """Steps of the search."""
    trials: int = 3
    """Of each grasp in the search ..."""
    contenders: int = 3
    """... and of so many of its neighbours: those that do best in the first of them."""
    enough: float = 0.95
    """Nothing is moved where one is as sure as this."""
    step: float = 0.006
    """First step along each axis [m] ..."""
    angle: float = math.radians(8.0)
    """... and about it [rad]."""


@dataclass(frozen=True)
class RankingConfig:
    """Which grasps come out."""

    count: int = 20
    """At most so many."""
    least_confidence: float | None = None
    """Grasps of a lower score are none. None: 0.3 where a mesh tells the whole surface, so that what is unlikely to
    hold does not come out; else 0, for fingers close on sides that a camera did not see."""
    distinct_distance: float = 0.01
    """Grasps nearer than this [m] ..."""
    distinct_angle: float = 0.26
    """... and turned less than this [rad] count as one; the better stays."""


@dataclass(frozen=True)
class PlannerConfig:
    """All stages, one seed, one device."""

    seeding: SeedingConfig = field(default_factory=SeedingConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    collision: CollisionConfig = field(default_factory=CollisionConfig)
    closing: ClosingConfig = field(default_factory=ClosingConfig)
    path: PathConfig = field(default_factory=PathConfig)
    grip: GripConfig = field(default_factory=GripConfig)
    refining: RefiningConfig = field(default_factory=RefiningConfig)
    ranking: RankingConfig = field(default_factory=RankingConfig)
    seed: int = 0
    """The one integer that all randomness comes from."""
    device: str = "auto"
    """`cpu`, `cuda:0`, or `auto`: CUDA where there is a device."""


def fast(config: PlannerConfig) -> PlannerConfig:
    """The same in a fraction of the time: half as many hands that start once, half as many trials and ways in, no
    refinement."""
    few = max(config.seeding.points // 2, 1), config.seeding.above // 2
    return replace(
        config,
        seeding=replace(config.seeding, points=few[0], above=few[1], batches=1),
        grip=replace(
            config.grip,
            finalists=config.grip.finalists // 2,
            first_trials=config.grip.first_trials // 2,
            ways_in=max(config.grip.ways_in // 2, 1),
            leaders=0,
        ),
        refining=replace(config.refining, count=0),
    )


@dataclass(frozen=True)
class LiftConfig:
    """Protocol `lift`, version 1: approach, close, lift 20 cm, hold for 5 s. What is not here is in `simulate`."""

    friction: float = 0.6
    """Sliding friction of every contact."""
    torsional_friction: float = 0.005
    """[m]"""
    mass: float | None = None
    """Of the object [kg]; none: from its volume, at 300 kg/m3, 50 to 500 g."""
    time_step: float = 0.002
    """[s]"""
    approach_distance: float = 0.15
    """Of the straight way in, where the grasps do not say where it begins [m]."""
    approach_seconds: float = 0.75
    """For the straight way in [s]."""
    closing_seconds: float = 1.0
    """In which a finger that meets nothing closes from the preshape [s]."""
    squeeze_seconds: float = 0.25
    """With all fingers at rest before the lift [s]."""
    lift_height: float = 0.2
    """[m]"""
    lift_seconds: float = 1.5
    hold_seconds: float = 5.0
    least_height: float = 0.1
    """The lowest point of the object must end higher than this above the table [m]."""
    largest_slip: float = 0.05
    """Farthest that the object may move in the hand from the beginning of the lift to the end [m]."""
    largest_turn: float = math.radians(60.0)
    """Farthest that it may turn in the hand [rad]."""
    largest_push: float = 0.02
    """Farthest that the object may be moved before the fingers close [m]."""
    largest_press: float = 50.0
    """Largest force between hand and object before the fingers close [N]."""
    largest_shortfall: float = 0.01
    """Farthest that the hand may stop short of its place [m]."""
    largest_tilt: float = math.radians(2.0)
    """Farthest that it may be turned out of its pose by then [rad]."""


@dataclass(frozen=True)
class ForceClosureConfig:
    """Protocol `fc6`, version 1, of DexGraspBench: no gravity, six pushes, each from the same grasp."""

    friction: float = 0.6
    torsional_friction: float = 0.02
    """[m]"""
    mass: float = 0.1
    """[kg]"""
    time_step: float = 0.004
    """[s]"""
    closing_seconds: float = 1.0
    squeeze_seconds: float = 0.25
    force: float = 1.0
    """Along each axis of the world, both ways [N]."""
    push_seconds: float = 2.0
    largest_slip: float = 0.05
    """[m]"""
    largest_turn: float = math.radians(15.0)
    """[rad]"""
    deepest_start: float = 0.01
    """Deepest penetration of the open hand and the object [m]."""


@dataclass(frozen=True)
class TugConfig:
    """Protocol `tug`, version 1, of GraspDataGen: no gravity, five pulls one after the other."""

    friction: float = 1.0
    torsional_friction: float = 0.005
    """[m]"""
    mass: float = 1.0
    """[kg]"""
    time_step: float = 0.002
    """[s]"""
    closing_seconds: float = 1.0
    acceleration: float = 9.81
    """Of each pull: its force is this times the mass [m/s2]."""
    pull_seconds: float = 0.5


@dataclass(frozen=True)
class SensorConfig:
    """How a simulated depth camera errs; the defaults are those of a RealSense D435 at arm's length."""

    axial_noise: float = 0.0025
    """Standard deviation of the depth, per squared depth [1/m]: 0.9 mm at 0.6 m."""
    noise_width: float = 1.5
    """Neighbours so near share their noise [pixels]: stereo matches windows."""
    scale_error: float = 0.01
    """Standard deviation of the factor that a whole image is wrong by."""
    tilt_error: float = 0.01
    """The same per unit of x / z and of y / z: half of that at the sides of the image."""
    disparity_step: float = 0.001
    """Least step of the depth, per squared depth [1/m]; besides, depths are whole millimetres."""
    dropout: float = 0.005
    """Share of all pixels that measure nothing ..."""
    edge_dropout: float = 0.3
    """... and of those beside an edge."""
    flying: float = 0.3
    """Share of the pixels beside an edge that average what is in front and behind."""
    grazing: float = math.radians(80.0)
    """Surfaces seen at a larger angle to their normal measure nothing [rad]."""
    pose_error_position: float = 0.0
    """By so much the camera's pose is off, in a random direction [m] ..."""
    pose_error_angle: float = 0.0
    """... and turned, about a random axis [rad]."""


@dataclass(frozen=True)
class ViewConfig:
    """From where a simulated depth camera sees the table, and what is done with its image."""

    sensor: SensorConfig = field(default_factory=SensorConfig)
    azimuth: float = math.pi
    """Of the camera's place around the origin, counter-clockwise from x [rad]: the robot's side."""
    elevation: float = math.radians(45.0)
    """Of that place above the table [rad]."""
    distance: float = 0.6
    """From what the camera looks at [m]."""
    knows_table: bool = True
    """Whether the planner is told the table's height, or has to find it."""
    completes: bool = True
    """Whether the far side of what is seen is guessed."""
