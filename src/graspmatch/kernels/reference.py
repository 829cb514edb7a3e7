"""The paper's equations in NumPy, float64, one particle at a time, written to be read: the definition of right.
And what contacts can hold (Ferrari and Canny 1992), by three independent methods.

theta is (t, q): t the position of the origin of the samples [m], q the unit quaternion wxyz. Samples s are in the frame
that theta poses, targets r in the object frame. Gradients are half those of the losses, as the paper writes them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls
from scipy.spatial import ConvexHull

from graspmatch.geometry import se3

Array = np.ndarray


def pairs(moved: Float[Array, "m 3"], target: Float[Array, "n 3"]) -> Float[Array, "m 3"]:
    """Eq. (1): for each moved sample s' the nearest target point."""
    distance = np.linalg.norm(moved[:, None] - target[None], axis=-1)
    return target[np.argmin(distance, axis=1)]


def matching_loss(moved: Float[Array, "m 3"], paired: Float[Array, "m 3"]) -> float:
    """Eq. (14): mean squared distance of the pairs [m2]."""
    return float(np.mean(np.sum((moved - paired) ** 2, axis=-1)))


def com_loss(
    t: Float[Array, "3"], q: Float[Array, "4"], tool_centre_point: Float[Array, "3"], com: Float[Array, "3"]
) -> float:
    """Eq. (15): squared distance of tool centre point and centre of mass [m2]."""
    return float(np.sum((se3.matrix_from_quaternion(q) @ tool_centre_point + t - com) ** 2))


def rotation_derivative(q: Float[Array, "4"]) -> Float[Array, "4 3 3"]:
    """dR/dq for each component of a quaternion, R homogeneous of degree two in q (paper, ref. c341)."""
    w, x, y, z = q
    return 2 * np.array(
        [
            [[w, -z, y], [z, w, -x], [-y, x, w]],
            [[x, y, z], [y, -x, -w], [z, w, -x]],
            [[-y, x, w], [x, y, z], [-w, z, -y]],
            [[-z, -w, x], [w, -z, y], [x, y, z]],
        ]
    )


def homogeneous_rotation(q: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """R(q) without the constraint |q| = 1, the function that `rotation_derivative` differentiates."""
    w, x, y, z = q
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def matching_gradients(
    t: Float[Array, "3"], q: Float[Array, "4"], samples: Float[Array, "m 3"], paired: Float[Array, "m 3"]
) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
    """Eqs. (4) and (5): mean gradients by t and by q."""
    residual = samples @ se3.matrix_from_quaternion(q).T + t - paired
    by_q = np.einsum("ni,kij,nj->k", residual, rotation_derivative(q), samples) / len(samples)
    return residual.mean(axis=0), by_q


def grasp_gradients(
    t: Float[Array, "3"],
    q: Float[Array, "4"],
    samples: Float[Array, "m 3"],
    paired: Float[Array, "m 3"],
    tool_centre_point: Float[Array, "3"],
    com: Float[Array, "3"],
    com_weight: float,
) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
    """Eqs. (16) and (17), the centre-of-mass pair weighted: 1/m as printed, 1 for the gradient of the loss (13)."""
    by_t, by_q = matching_gradients(t, q, samples, paired)
    com_by_t, com_by_q = matching_gradients(t, q, tool_centre_point[None], com[None])
    return by_t + com_weight * com_by_t, by_q + com_weight * com_by_q


def tangent(q: Float[Array, "4"], by_q: Float[Array, "4"]) -> Float[Array, "3"]:
    """A gradient by q as one by the rotation vector w of q <- exp(w) q, object frame."""
    w, x, y, z = q
    dq_dw = 0.5 * np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])
    return dq_dw.T @ by_q


def colliding_points(
    t: Float[Array, "3"], q: Float[Array, "4"], scene: Float[Array, "n 3"], distance
) -> tuple[Float[Array, "c 3"], Float[Array, "c 3"]]:
    """Eq. (12): the scene by the inverse transform in the hand's frame; its points inside the hand, in both frames.

    `distance` is the hand's signed distance as a function of points, negative inside.
    """
    in_hand = (scene - t) @ se3.matrix_from_quaternion(q)
    inside = distance(in_hand) < 0
    return scene[inside], in_hand[inside]


def translation_kernel(a: Float[Array, "3"], b: Float[Array, "3"], h: float) -> float:
    """Eq. (9)."""
    return float(np.exp(-np.sum((a - b) ** 2) / h))


def rotation_kernel(a: Float[Array, "4"], b: Float[Array, "4"]) -> float:
    """Eq. (10)."""
    return float(abs(a @ b))


def bandwidth(positions: Float[Array, "k 3"]) -> float:
    """h of eq. (9): the mean squared distance of the particles over log(K + 1)."""
    apart = positions[:, None] - positions[None]
    return max(float(np.mean(np.sum(apart**2, axis=-1)) / np.log(len(positions) + 1)), 1e-8)


def kernel_slope(a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "3"]:
    """Gradient of (10) along the sphere by a, as the rotation vector that it turns b by when it is carried there."""
    conjugate = a * np.array([1, -1, -1, -1])
    w, *v = se3.quaternion_multiply(b, conjugate)
    return 0.5 * np.sign(w) * np.array(v)


def prior_slopes(
    t: Float[Array, "3"],
    q: Float[Array, "4"],
    seed_t: Float[Array, "3"],
    seed_q: Float[Array, "4"],
    precision: float,
    concentration: float,
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Gradients of the negative log priors of eq. (8), by t and by the rotation vector: a Gaussian around the seed's
    position, precision / 2 |t - seed|^2, and a von Mises around its rotation, -concentration cos(angle)."""
    w, *v = se3.quaternion_multiply(q, seed_q * np.array([1, -1, -1, -1]))
    return precision * (t - seed_t), concentration * 2 * w * np.array(v)


def stein_directions(
    positions: Float[Array, "k 3"],
    rotations: Float[Array, "k 4"],
    drift_position: Float[Array, "k 3"],
    drift_rotation: Float[Array, "k 3"],
    gamma: float,
    repulsion: float,
    inverse_position: float,
    inverse_rotation: Float[Array, "k 3 3"],
    n: int,
) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"]]:
    """Eq. (8) times A/N, over the kernel's mass: the step of each particle's position and rotation vector.

    `drift` is A (N g + gradient of the negative log prior) / N of each particle; `inverse` are the blocks of A.
    """
    h = bandwidth(positions)
    moves, spins = np.zeros_like(drift_position), np.zeros_like(drift_rotation)
    for i in range(len(positions)):
        k_t = np.array([translation_kernel(p, positions[i], h) for p in positions])
        k = k_t * np.array([rotation_kernel(q, rotations[i]) for q in rotations])
        away_t = np.sum(2 / h * k[:, None] * (positions[i] - positions), axis=0)
        away_w = np.sum(k_t[:, None] * [kernel_slope(q, rotations[i]) for q in rotations], axis=0)
        moves[i] = (-gamma * k @ drift_position + repulsion * inverse_position * away_t / n) / k.sum()
        spins[i] = (-gamma * k @ drift_rotation + repulsion * inverse_rotation[i] @ away_w / n) / k.sum()
    return moves, spins


def align(samples: Float[Array, "n 3"], paired: Float[Array, "n 3"], weights: Float[Array, "n"]) -> Float[Array, "4 4"]:
    """Eq. (2) in closed form: the rigid transform of least weighted squares, by SVD (Arun et al. 1987)."""
    w = weights / weights.sum()
    source, goal = w @ samples, w @ paired
    U, _, Vt = np.linalg.svd((w[:, None] * (paired - goal)).T @ (samples - source))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    return se3.from_parts(R, goal - R @ source)


@dataclass(frozen=True)
class Grip:
    """Contacts of one grasp. Forces are in units of one finger's force, torques and lengths are divided by a length.

    Contact c belongs to what touches, `toucher[c]`: a finger, the palm or the table. What presses, `presser` of that,
    is the palm, the table, or a drive with all of its fingers: it shares out a force from `least` to `most` among its
    contacts. A contact with the normal force N adds a force t across its normal and a torque m about it, as far as
    |t|^2 / friction^2 + m^2 / torsion^2 <= N^2.
    """

    toucher: Int[Array, "c"]
    arm: Float[Array, "c 3"]
    """From the centre of mass."""
    push: Float[Array, "c 3"]
    """Unit vectors against the object's normals."""
    presser: Int[Array, "g"]
    least: Float[Array, "p"]
    most: Float[Array, "p"]
    friction: float
    torsion: float
    load: Float[Array, "3"]
    """Force at the centre of mass."""

    @property
    def pressers(self) -> Int[Array, "c"]:
        """What presses at each contact."""
        return self.presser[self.toucher]


def contact_wrenches(grip: Grip, d: Float[Array, "k 6"]) -> Float[Array, "k c 6"]:
    """Of each contact with unit normal force, the wrench that goes farthest along each d: the section of the friction
    cone is an ellipsoid around the wrench of the normal force."""
    across = np.cross(grip.push, np.eye(3)[np.argmin(np.abs(grip.push), axis=-1)])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    force = np.stack([across, np.cross(grip.push, across)], axis=1) * grip.friction
    slides = np.concatenate([force, np.cross(grip.arm[:, None], force)], axis=-1)
    twist = np.concatenate([np.zeros_like(grip.push), grip.torsion * grip.push], axis=-1)
    axes = np.concatenate([slides, twist[:, None]], axis=1)
    along = np.einsum("cai,ki->kca", axes, d)
    along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12)
    centre = np.concatenate([grip.push, np.cross(grip.arm, grip.push)], axis=-1)
    return centre + np.einsum("cai,kca->kci", axes, along)


def farthest_wrenches(grip: Grip, d: Float[Array, "k 6"]) -> Float[Array, "k 6"]:
    """Of all wrenches on the object, the load included, one that goes farthest along each d."""
    wrenches = contact_wrenches(grip, d)
    gain = np.einsum("kci,ki->kc", wrenches, d)
    total = np.tile(np.concatenate([grip.load, np.zeros(3)]), (len(d), 1))
    for p in np.unique(grip.pressers):
        own = np.flatnonzero(grip.pressers == p)
        best = own[np.argmax(gain[:, own], axis=-1), None]
        force = np.where(np.take_along_axis(gain, best, axis=1) > 0, grip.most[p], grip.least[p])
        total += force * np.take_along_axis(wrenches, best[..., None], axis=1)[:, 0]
    return total


def wrench_margin(grip: Grip, rng: np.random.Generator, directions: int = 4000, steps: int = 300) -> float:
    """Smallest wrench that is not resisted; below zero, the smallest that is missing for balance: the least support of
    the set of wrenches over all unit vectors, by trying many and going down from the best. An upper bound."""
    d = np.concatenate([np.eye(6), -np.eye(6), rng.normal(size=(directions, 6))])
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    support = np.sum(farthest_wrenches(grip, d) * d, axis=-1)
    least, d = float(support.min()), d[np.argsort(support)[:50]]
    for step in 0.3 * 0.98 ** np.arange(steps):
        wrench = farthest_wrenches(grip, d)
        support = np.sum(wrench * d, axis=-1, keepdims=True)
        least = min(least, float(support.min()))
        slope = wrench - support * d
        d = d - step * slope / (1 + np.linalg.norm(slope, axis=-1, keepdims=True))
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
    return least


def missing_wrench(grip: Grip, tolerance: float = 1e-6) -> float:
    """Length of the shortest wrench that the contacts and the load can add up to: zero in balance, else -margin.

    By non-negative least squares over wrenches that contacts can exert; one that leads nearer is added to them until
    the support along the remainder proves that there is none.
    """
    load, pressers = np.concatenate([grip.load, np.zeros(3)]), np.unique(grip.pressers)
    columns, owner = np.zeros((0, 6)), np.zeros(0, dtype=int)
    d = np.concatenate([np.eye(6), -np.eye(6)])
    stiff = 1e4  # weight of the rule that what each presser exerts is a mean of its wrenches
    for _ in range(1000):
        wrenches = contact_wrenches(grip, d)
        scaled = [wrenches * force[grip.pressers][:, None] for force in (grip.least, grip.most)]
        columns = np.concatenate([columns, *(w.reshape(-1, 6) for w in scaled)])
        owner = np.concatenate([owner, *[np.tile(grip.pressers, len(d))] * 2])
        is_own = stiff * (owner == pressers[:, None])
        share, _ = nnls(np.concatenate([columns.T, is_own]), np.concatenate([-load, np.full(len(pressers), stiff)]))
        remainder = share @ columns + load
        length = float(np.linalg.norm(remainder))
        if length < tolerance:
            return 0.0
        d = -remainder[None] / length
        if length + farthest_wrenches(grip, d)[0] @ d[0] < tolerance:
            return length
        columns, owner = columns[share > 0], owner[share > 0]
    raise ArithmeticError(f"no proof after 1000 wrenches; {length} remain")


def margin_bounds(grip: Grip, gap: float, rounds: int = 60) -> tuple[float, float]:
    """Two numbers no farther apart than `gap` with the margin between them, where it is above zero.

    The polytope of some wrenches that the grasp can exert is inside the set of all: the distance of its nearest facet
    is a lower bound, the support of the set along that facet's normal an upper one. The nearest facets are moved out
    until they meet.
    """
    d = np.concatenate([np.eye(6), -np.eye(6), np.random.default_rng(0).normal(size=(20, 6))])
    wrenches = farthest_wrenches(grip, d)
    lower, upper = -np.inf, np.inf
    for _ in range(rounds):
        facets = ConvexHull(wrenches, qhull_options="QJ Pp").equations  # joggled: symmetric grasps have flat corners
        nearest = facets[np.argsort(-facets[:, -1])[:10]]
        more = farthest_wrenches(grip, nearest[:, :6])
        lower = float(-nearest[0, -1])
        upper = min(upper, float(np.sum(more * nearest[:, :6], axis=-1).min()))
        if upper - lower < gap:
            return lower, upper
        wrenches = np.concatenate([wrenches, more])
    raise ArithmeticError(f"the margin is between {lower} and {upper}; no nearer after {rounds} rounds")
