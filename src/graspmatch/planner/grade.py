"""How sure a grasp is: its fingers close again and again, each time a little displaced, under other friction."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from graspmatch.config import GripConfig, RankingConfig
from graspmatch.geometry import se3
from graspmatch.kernels.warp_hold import LOST_MARGIN
from graspmatch.planner.avoid import Space, point_clearance, table_clearance
from graspmatch.planner.candidates import Candidates, Closed, Graded
from graspmatch.planner.close import contact_joints
from graspmatch.planner.hold import Touchable, hold, most_force
from graspmatch.planner.rank import rank
from graspmatch.planner.tally import Tally
from graspmatch.types import Gripper

Array = np.ndarray

WORST = -2.0
"""Margins as the fingers meet the object count no less."""
LOSS_SCALE = 0.05
"""[m]"""
CALIBRATION = (2.36, 1.77, 2.12, -0.97, 1.18)
"""Offset, and weights of margin, share of trials that hold, root of the loss, and standing margin."""


@dataclass(frozen=True)
class Trials:
    """Conditions under which every grasp is tried."""

    error: Float[Array, "k 4 4"]
    """Displacements of the hand, gripper frame."""
    friction: Float[Array, "k"]

    def __getitem__(self, which: slice) -> Trials:
        """Some of them."""
        return Trials(self.error[which], self.friction[which])

    def __len__(self) -> int:
        return len(self.friction)


def draw_trials(gripper: Gripper, config: GripConfig, seed: int) -> Trials:
    """Small errors of the pose about the tool centre point, and the frictions in turn."""
    rng = np.random.default_rng(seed)
    turn = se3.rotation_exp(config.angle_error * rng.normal(size=(config.trials, 3)))
    error = se3.from_parts(turn, config.position_error * rng.normal(size=(config.trials, 3)))
    friction = np.resize(np.array(config.frictions), config.trials)
    return Trials(se3.about(gripper.tool_centre_point, error), friction)


def foremost(
    closed: Closed, count: int, target: Touchable, gripper: Gripper, config: GripConfig, device: str, tally: Tally
) -> Closed:
    """The most promising distinct candidates: those that hold best where they are, with middling friction."""
    held = hold(closed, np.full(len(closed), middling(config)), target, gripper, config, device)
    worth = np.where(held.held, held.margin, held.margin - np.sqrt(closed.loss))  # lost: those that match best
    order = rank(closed, worth, RankingConfig(count=count), tally, "less promising than others")
    return closed.select(order)


def grade(
    closed: Closed,
    error: Float[Array, "n"],
    loss: Float[Array, "n"],
    trials: Trials,
    space: Space,
    target: Touchable,
    gripper: Gripper,
    config: GripConfig,
    device: str,
) -> Graded:
    """What comes of closing the fingers under all trials; error and loss are those of the poses as they are [m2]. A
    displaced hand that meets anything on its way in holds nothing."""
    n, k = len(closed), len(trials)
    displaced = Candidates(
        np.repeat(closed.preshape, k), (closed.T_world_gripper[:, None] @ trials.error).reshape(-1, 4, 4)
    )
    tried = hold(displaced, np.tile(trials.friction, n), target, gripper, config, device)
    held = tried.held & (np.minimum(point_clearance(displaced, space), table_clearance(displaced, space)) > 0)
    margin = np.where(held, tried.margin, LOST_MARGIN).reshape(n, k).mean(axis=-1)
    held_share = held.reshape(n, k).mean(axis=-1)
    met = hold(displaced, np.full(n * k, middling(config)), target, gripper, config, device, upright=True)
    standing = np.maximum(met.margin, WORST).reshape(n, k).mean(axis=-1) / strength(gripper)
    return Graded(
        **vars(closed),
        error=error,
        final_loss=loss,
        margin=margin,
        held_share=held_share,
        standing=standing,
        tries=np.full(n, k),
        confidence=confidence(margin, held_share, loss, standing),
    )


def pooled(a: Graded, b: Graded) -> Graded:
    """The same grasps after the trials of both."""
    share = a.tries / (a.tries + b.tries)
    margin = share * a.margin + (1 - share) * b.margin
    held_share = share * a.held_share + (1 - share) * b.held_share
    standing = share * a.standing + (1 - share) * b.standing
    sure = confidence(margin, held_share, a.final_loss, standing)
    tries = a.tries + b.tries
    return replace(a, margin=margin, held_share=held_share, standing=standing, tries=tries, confidence=sure)


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
    margin: Float[Array, "n"], held_share: Float[Array, "n"], loss: Float[Array, "n"], standing: Float[Array, "n"]
) -> Float[Array, "n"]:
    """Share of grasps with these figures that hold: a logistic model, fitted by `bench/calibration.py`."""
    offset, *weights = CALIBRATION
    root_loss = np.sqrt(np.maximum(loss, 0.0)) / LOSS_SCALE
    terms = np.stack([margin, held_share, root_loss, standing], axis=-1)
    return 1 / (1 + np.exp(-(offset + terms @ np.array(weights))))
