"""How sure a grasp is: its fingers close again and again, each time a little displaced, under other friction."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from graspmatch.config import GripConfig, RankingConfig
from graspmatch.geometry import se3
from graspmatch.kernels.warp_hold import LOST_MARGIN
from graspmatch.planner.avoid import Space, clear_ways
from graspmatch.planner.candidates import Candidates, Closed, Graded
from graspmatch.planner.close import contact_joints
from graspmatch.planner.hold import Touchable, hold, most_force
from graspmatch.planner.rank import rank
from graspmatch.planner.tally import Tally
from graspmatch.types import Gripper

Array = np.ndarray

WORST = -2.0
"""Margins as the fingers meet the object count no less."""
STANDING_TRIALS = 2
"""So many of the trials ask for the standing margin, which varies little."""
INEXACT = 0.25
"""Of the arrivals at a known surface, so many are inexact."""
LOSS_SCALE = 0.05
"""[m]"""
GUESS_SCALE = 0.03
"""So far from what was seen of an object, a guess of its surface is right in one of e cases [m]; half as far it mostly
is."""
CALIBRATION = (-1.325, 0.288, 4.627, -0.693, 1.343, 0.236)
"""Offset, and weights of margin, share of trials that hold, root of the loss, standing margin, and contacts."""


@dataclass(frozen=True)
class Trials:
    """Conditions under which every grasp is tried."""

    way_in: Float[Array, "m 4 4"]
    """Displacements of the hand on its way in, gripper frame ..."""
    error: Float[Array, "k 4 4"]
    """... and those under which its fingers close, ..."""
    friction: Float[Array, "k"]
    """... each with its friction."""
    clearance: float
    """That the hand must keep on a displaced way in [m]."""
    inexact: float
    """Share of arrivals that come by one of those ways in; the others come as planned."""

    def __getitem__(self, which: slice) -> Trials:
        """Some of the closings."""
        return replace(self, error=self.error[which], friction=self.friction[which])

    def __len__(self) -> int:
        return len(self.friction)


def draw_trials(config: GripConfig, seed: int, *, is_exact: bool = True) -> Trials:
    """Small errors of the pose, as of a robot's wrist: turns about the hand's base move its fingertips too. And the
    frictions in turn. The scene is exact where a mesh tells the whole surface."""
    rng = np.random.default_rng(seed)
    error = draw_errors(config.trials, config.position_error, config.angle_error, rng)
    way_in = draw_errors(config.ways_in, config.way_position_error, config.way_angle_error, rng)
    friction = np.resize(np.array(config.frictions), config.trials)
    inexact = (INEXACT if is_exact else 1.0) if config.inexact is None else config.inexact
    return Trials(way_in, error, friction, config.way_clearance, inexact)


def draw_errors(count: int, position: float, angle: float, rng: np.random.Generator) -> Float[Array, "k 4 4"]:
    """Displacements with the mean and the covariance of a normal distribution, but all of one size: both ways along the
    axes of randomly turned frames, so that few of them look in every direction (the spherical-radial rule of degree
    three, Genz and Monahan 1998)."""
    frames = [np.linalg.qr(rng.normal(size=(6, 6)))[0] for _ in range(-(-count // 12))]
    both_ways = np.stack([np.concatenate(frames), -np.concatenate(frames)], axis=1).reshape(-1, 6)
    drawn = np.sqrt(6) * both_ways[:count]
    return se3.from_parts(se3.rotation_exp(angle * drawn[:, 3:]), position * drawn[:, :3])


def foremost(
    closed: Closed,
    count: int,
    trials: Trials,
    space: Space,
    target: Touchable,
    config: GripConfig,
    tally: Tally,
) -> Closed:
    """The most promising distinct candidates: those that hold best where they are, with middling friction, the better
    the more of their arrivals are clear."""
    held = hold(closed, np.full(len(closed), middling(config)), target, space.gripper, config, space.device)
    worth = np.where(held.held, held.margin, held.margin - np.sqrt(closed.loss))  # lost: those that match best
    lasts = np.flatnonzero(worth > LOST_MARGIN)  # what is lost in any case may come by any way
    share = clear_share(closed.select(lasts), trials, space) * sure_of(held.beyond[lasts])
    worth[lasts] = share * worth[lasts] + (1 - share) * LOST_MARGIN
    order = rank(closed, worth, RankingConfig(count=count), tally, "less promising than others")
    return closed.select(order)


def grade(
    closed: Closed,
    error: Float[Array, "n"],
    loss: Float[Array, "n"],
    trials: Trials,
    space: Space,
    target: Touchable,
    config: GripConfig,
    standing: Float[Array, "n"] | None = None,
    share: Float[Array, "n"] | None = None,
) -> Graded:
    """What comes of arriving and of closing the fingers under all trials; error and loss are those of the poses as they
    are [m2]. The standing margin may be taken from grasps nearby, the share of clear ways where it is known."""
    gripper, device = space.gripper, space.device
    margin, held_share, contacts, seen_share = try_all(closed, trials, target, gripper, config, device)
    if standing is None:
        standing = standing_margin(closed, trials, target, gripper, config, device)
    return Graded(
        **vars(closed),
        error=error,
        final_loss=loss,
        clear_share=clear_share(closed, trials, space) if share is None else share,
        margin=margin,
        held_share=held_share,
        standing=standing,
        contacts=contacts,
        seen_share=seen_share,
        tries=np.full(len(closed), len(trials)),
        confidence=confidence(margin, held_share, loss, standing, contacts),
    )


def retried(
    graded: Graded, trials: Trials, target: Touchable, gripper: Gripper, config: GripConfig, device: str
) -> Graded:
    """The same grasps under other trials; what the pose alone decides stays."""
    margin, held_share, contacts, seen_share = try_all(graded, trials, target, gripper, config, device)
    tried = replace(graded, margin=margin, held_share=held_share, contacts=contacts, seen_share=seen_share)
    sure = confidence(margin, held_share, graded.final_loss, graded.standing, contacts)
    return replace(tried, tries=np.full(len(graded), len(trials)), confidence=sure)


def restood(
    graded: Graded, trials: Trials, target: Touchable, gripper: Gripper, config: GripConfig, device: str
) -> Graded:
    """The same grasps with standing margins of their own, where those of grasps nearby stood in for them."""
    standing = standing_margin(graded, trials, target, gripper, config, device)
    sure = confidence(graded.margin, graded.held_share, graded.final_loss, standing, graded.contacts)
    return replace(graded, standing=standing, confidence=sure)


def try_all(
    closed: Closed, trials: Trials, target: Touchable, gripper: Gripper, config: GripConfig, device: str
) -> tuple[Float[Array, "n"], Float[Array, "n"], Float[Array, "n"], Float[Array, "n"]]:
    """Mean margin, share of the trials in which the object is held, mean number of contacts, and how sure these are."""
    n, k = len(closed), len(trials)
    tried = hold(displaced(closed, trials.error), np.tile(trials.friction, n), target, gripper, config, device)
    margin = np.where(tried.held, tried.margin, LOST_MARGIN)
    figures = np.stack([margin, tried.held, tried.contacts, sure_of(tried.beyond)])
    return tuple(figures.reshape(len(figures), n, k).mean(axis=-1))


def sure_of(beyond: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """How sure it is that a surface is there, so far from what was seen of the object [m]."""
    return np.exp(-((beyond / GUESS_SCALE) ** 4))


def standing_margin(
    closed: Closed, trials: Trials, target: Touchable, gripper: Gripper, config: GripConfig, device: str
) -> Float[Array, "n"]:
    """The mean margin under a few trials as the fingers meet an object that does not turn, see `Graded`."""
    few = trials.error[:STANDING_TRIALS]
    friction = np.full(len(closed) * len(few), middling(config))
    met = hold(displaced(closed, few), friction, target, gripper, config, device, upright=True)
    return np.maximum(met.margin, WORST).reshape(len(closed), len(few)).mean(axis=-1) / strength(gripper)


def displaced(candidates: Candidates, errors: Float[Array, "k 4 4"]) -> Candidates:
    """Each candidate under each error in turn."""
    poses = (candidates.T_world_gripper[:, None] @ errors).reshape(-1, 4, 4)
    return Candidates(np.repeat(candidates.preshape, len(errors)), poses)


def clear_share(candidates: Candidates, trials: Trials, space: Space) -> Float[Array, "n"]:
    """Share of the arrivals of free candidates that meet nothing, as far as every so manieth point tells."""
    share = clear_ways(candidates, trials.way_in, trials.clearance, space) / len(trials.way_in)
    return 1 - trials.inexact * (1 - share)


def pooled(a: Graded, b: Graded) -> Graded:
    """The same grasps after the trials of both."""
    share = a.tries / (a.tries + b.tries)
    margin = share * a.margin + (1 - share) * b.margin
    held_share = share * a.held_share + (1 - share) * b.held_share
    contacts = share * a.contacts + (1 - share) * b.contacts
    seen_share = share * a.seen_share + (1 - share) * b.seen_share
    pool = replace(a, margin=margin, held_share=held_share, contacts=contacts, seen_share=seen_share)
    sure = confidence(margin, held_share, a.final_loss, a.standing, contacts)
    return replace(pool, tries=a.tries + b.tries, confidence=sure)


def stopped(graded: Graded, target: Touchable, gripper: Gripper, config: GripConfig, device: str) -> Graded:
    """The same with the joint values at which the fingers hold the object, where they have pushed it; of those that do
    not hold it as planned, at first contact."""
    planned = hold(graded, np.full(len(graded), middling(config)), target, gripper, config, device)
    fraction = np.where(planned.held[:, None], planned.fraction, graded.closing_fraction)
    joints = contact_joints(graded.preshape, fraction, gripper)
    return replace(graded, closing_fraction=fraction, grasp_joints=joints)


def middling(config: GripConfig) -> float:
    """The friction in the middle of those that are tried."""
    return float(np.median(config.frictions))


def strength(gripper: Gripper) -> float:
    """How hard all fingers can press together, by how hard two of one drive do."""
    fingers = len(gripper.fingers)
    return fingers * most_force(gripper) / 2


def confidence(
    margin: Float[Array, "n"],
    held_share: Float[Array, "n"],
    loss: Float[Array, "n"],
    standing: Float[Array, "n"],
    contacts: Float[Array, "n"],
) -> Float[Array, "n"]:
    """Share of grasps with these figures that hold: a logistic model, fitted by `bench/calibration.py`."""
    offset, *weights = CALIBRATION
    root_loss = np.sqrt(np.maximum(loss, 0.0)) / LOSS_SCALE
    terms = np.stack([margin, held_share, root_loss, standing, contacts], axis=-1)
    return 1 / (1 + np.exp(-(offset + terms @ np.array(weights))))
