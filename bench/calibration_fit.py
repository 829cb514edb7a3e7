"""A logistic model of which grasps hold: fitted, cross-validated by object, and compared with what happened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import rankdata

from calibration_data import Lifted
from graspmatch.apps.bench.summary import wilson
from graspmatch.errors import GraspmatchError
from graspmatch.planner.grade import CALIBRATION, LOSS_SCALE

Array = np.ndarray

TERMS: dict[str, Callable[[Lifted], Array]] = {
    "margin": lambda lifted: lifted.margin,
    "held share": lambda lifted: lifted.held_share,
    "standing margin": lambda lifted: lifted.standing,
    "root loss": lambda lifted: np.sqrt(np.maximum(lifted.loss, 0.0)) / LOSS_SCALE,
    "clear share": lambda lifted: lifted.clear_share,
    "contacts": lambda lifted: lifted.contacts,
    "margin as planned": lambda lifted: lifted.planned_margin,
    "pushed": lambda lifted: 100 * lifted.pushed,
    "slipped": lambda lifted: 100 * lifted.slipped,
    "clearance": lambda lifted: 1000 * lifted.clearance,
    "moment arm": lambda lifted: lifted.moment_arm,
}
"""Figures of a grasp that say something of whether it holds: loss as the planner scales it, push and slip in
centimetres, clearance in millimetres, forces in those of a finger."""
MODEL = ("margin", "held share", "root loss", "standing margin", "contacts")
"""Those that the planner ranks by, in the order of its constants."""
OTHERS = tuple(name for name in TERMS if name not in MODEL)

FOLDS = 6
RIDGE = 1e-4
"""Keeps weights finite where a term parts all grasps that held from all that did not."""
SMALLEST = 1e-9
"""Least probability that the likelihood is told of."""


@dataclass(frozen=True)
class Model:
    """Confidence as a logistic function of some terms."""

    terms: tuple[str, ...]
    offset: float
    weights: tuple[float, ...]

    def confidence(self, lifted: Lifted) -> Float[Array, "n"]:
        """Share of such grasps that hold."""
        return expit(self.offset + _columns(lifted, self.terms) @ np.array(self.weights))

    @property
    def constants(self) -> tuple[float, ...]:
        """Offset and weights as the planner writes them."""
        return tuple(round(float(value), 3) for value in (self.offset, *self.weights))


def planner_model() -> Model:
    """The model that the planner ranks by now."""
    offset, *weights = CALIBRATION
    return Model(MODEL, offset, tuple(weights))


def fit(lifted: Lifted, terms: tuple[str, ...] = MODEL) -> Model:
    """The model under which what happened is most likely; each object of each hand weighs the same."""
    if lifted.held.all() or not lifted.held.any():
        raise GraspmatchError("A fit needs grasps that held and grasps that did not; add objects.")
    columns = _columns(lifted, terms)
    mean, scale = columns.mean(axis=0), columns.std(axis=0)
    scale[scale == 0] = 1.0
    standard = np.column_stack([np.ones(len(lifted)), (columns - mean) / scale])
    held, weight = lifted.held.astype(float), equal_weights(lifted.group) / len(lifted)

    def loss(parameters: Array) -> tuple[float, Array]:
        logit, slopes = standard @ parameters, np.r_[0.0, parameters[1:]]
        likelihood = np.sum(weight * (np.logaddexp(0, logit) - held * logit))
        return likelihood + RIDGE * slopes @ slopes, standard.T @ (weight * (expit(logit) - held)) + 2 * RIDGE * slopes

    parameters = minimize(loss, np.zeros(1 + len(terms)), jac=True).x
    weights = parameters[1:] / scale
    return Model(terms, float(parameters[0] - weights @ mean), tuple(float(value) for value in weights))


def cross_validated(lifted: Lifted, terms: tuple[str, ...] = MODEL) -> Float[Array, "n"]:
    """Confidence of each grasp by a model fitted without its object, whatever the hand."""
    fold, result = folds(lifted.object), np.empty(len(lifted))
    for number in np.unique(fold):
        inside = fold == number
        result[inside] = fit(lifted.select(~inside), terms).confidence(lifted.select(inside))
    return result


def folds(objects: Shaped[Array, "n"]) -> Int[Array, "n"]:
    """Number of the fold of each grasp: all grasps of an object are in one."""
    names, inverse = np.unique(objects, return_inverse=True)
    if len(names) < 2:
        raise GraspmatchError(f"Cross-validation by object needs two objects or more, not {len(names)}.")
    return inverse % FOLDS


def equal_weights(group: Int[Array, "n"]) -> Float[Array, "n"]:
    """Weights of mean one that add up to the same in every group."""
    weight = 1 / np.bincount(group)[group]
    return weight / weight.mean()


@dataclass(frozen=True)
class Skill:
    """How well confidences foretell what happened."""

    log_loss: float
    """Negative log likelihood of a grasp, each object of each hand weighing the same."""
    auc: float
    """Share of pairs, one that held and one that did not, that are in the right order."""
    auc_within: float
    """The same for pairs of one hand and object: the mean over those that have any."""
    first_held: int
    """Objects of each hand whose first grasp by confidence held ..."""
    feasible: int
    """... of so many with any grasp that held."""


def skill(confidence: Float[Array, "n"], lifted: Lifted) -> Skill:
    """Confidences against verdicts."""
    groups = [lifted.group == number for number in np.unique(lifted.group)]
    within = [auc(confidence[group], lifted.held[group]) for group in groups]
    return Skill(
        log_loss=float(np.mean(log_losses(confidence, lifted))),
        auc=auc(confidence, lifted.held),
        auc_within=float(np.mean([value for value in within if not np.isnan(value)] or [np.nan])),
        first_held=int(lifted.held[firsts(confidence, lifted.group)].sum()),
        feasible=sum(bool(lifted.held[group].any()) for group in groups),
    )


def log_losses(confidence: Float[Array, "n"], lifted: Lifted) -> Float[Array, "groups"]:
    """Mean negative log likelihood of the grasps of each hand and object."""
    likelihood = np.where(lifted.held, confidence, 1 - confidence)
    return np.bincount(lifted.group, -np.log(np.maximum(likelihood, SMALLEST))) / np.bincount(lifted.group)


def firsts(confidence: Float[Array, "n"], group: Int[Array, "n"]) -> Int[Array, "groups"]:
    """Index of the grasp of each group that comes first by confidence."""
    order = np.lexsort((-confidence, group))
    return order[np.unique(group[order], return_index=True)[1]]


def auc(score: Float[Array, "n"], held: Bool[Array, "n"]) -> float:
    """Area under the curve of hits against false alarms; NaN where all or none held."""
    good, bad = int(held.sum()), int((~held).sum())
    if not good or not bad:
        return float("nan")
    return float((rankdata(score)[held].sum() - good * (good + 1) / 2) / (good * bad))


@dataclass(frozen=True)
class Bin:
    """The grasps of like confidence."""

    low: float
    high: float
    count: int
    confidence: float
    """Mean."""
    held: int
    interval: tuple[float, float]
    """95 % interval of the share that holds (Wilson 1927), as if grasps of one object were independent."""

    @property
    def share(self) -> float:
        """That held."""
        return self.held / self.count


def reliability(confidence: Float[Array, "n"], held: Bool[Array, "n"], bins: int = 10) -> list[Bin]:
    """Bins of equal width from 0 to 1 that have any grasp; a border belongs to the bin above it, 1 to the last."""
    edges = np.linspace(0, 1, bins + 1)
    index = np.clip(np.searchsorted(edges, confidence, side="right") - 1, 0, bins - 1)
    return [
        Bin(
            low=float(edges[number]),
            high=float(edges[number + 1]),
            count=int(inside.sum()),
            confidence=float(confidence[inside].mean()),
            held=int(held[inside].sum()),
            interval=wilson(int(held[inside].sum()), int(inside.sum())),
        )
        for number in range(bins)
        if (inside := index == number).any()
    ]


def calibration_error(bins: list[Bin]) -> float:
    """Mean distance of the confidence from the share that held, over all grasps."""
    return sum(entry.count * abs(entry.confidence - entry.share) for entry in bins) / sum(b.count for b in bins)


def _columns(lifted: Lifted, terms: tuple[str, ...]) -> Float[Array, "n terms"]:
    return np.column_stack([np.zeros((len(lifted), 0)), *(TERMS[name](lifted) for name in terms)])
