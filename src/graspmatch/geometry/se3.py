"""Rigid transforms: `T_a_b` (4,4) maps b-coordinates to a-coordinates; quaternions are unit, wxyz; axes broadcast."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

Array = np.ndarray


def from_parts(rotation: Float[Array, "*#b 3 3"], translation: Float[Array, "*#b 3"]) -> Float[Array, "*b 4 4"]:
    """Homogeneous transform of a rotation matrix and a translation [m]."""
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    T = np.zeros((*batch, 4, 4))
    T[..., :3, :3] = rotation
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def apply(T_a_b: Float[Array, "*#b 4 4"], points_b: Float[Array, "*#b n 3"]) -> Float[Array, "*b n 3"]:
    """Points of frame b, expressed in frame a."""
    return points_b @ np.swapaxes(T_a_b[..., :3, :3], -1, -2) + T_a_b[..., None, :3, 3]


def inverse(T_a_b: Float[Array, "*b 4 4"]) -> Float[Array, "*b 4 4"]:
    """`T_b_a`, by transposing the rotation."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return from_parts(R_b_a, -(R_b_a @ T_a_b[..., :3, 3, None])[..., 0])


def is_rigid(T_a_b: Float[Array, "*b 4 4"], tolerance: float = 1e-4) -> Bool[Array, "*b"]:
    """Whether each matrix is finite, its rotation orthonormal and right-handed, and its last row that of a pose."""
    R = T_a_b[..., :3, :3]
    finite = np.all(np.isfinite(T_a_b), axis=(-2, -1))
    with np.errstate(invalid="ignore", over="ignore"):
        skewed = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(-2, -1), initial=0)
        last_row = np.abs(T_a_b[..., 3, :] - [0, 0, 0, 1]).max(axis=-1, initial=0)
    upright = np.linalg.det(np.where(finite[..., None, None], R, np.eye(3))) > 0
    return finite & (skewed < tolerance) & (last_row < tolerance) & upright


def translation(offset: Float[Array, "*b 3"]) -> Float[Array, "*b 4 4"]:
    """Pure translation [m]."""
    return from_parts(np.eye(3), np.asarray(offset, dtype=float))


def about(point: Float[Array, "3"], T: Float[Array, "*b 4 4"]) -> Float[Array, "*b 4 4"]:
    """The motions T with their axes through a point in place of the origin."""
    return translation(point) @ T @ translation(-point)


def matrix_from_quaternion(wxyz: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = np.moveaxis(np.asarray(wxyz, dtype=float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(rotation: Float[Array, "*b 3 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion with w >= 0, by the largest of the four components (Shepperd 1978)."""
    m = np.asarray(rotation, dtype=float)
    trace = np.trace(m, axis1=-2, axis2=-1)
    diagonal = np.diagonal(m, axis1=-2, axis2=-1)
    squares = np.concatenate([trace[..., None], diagonal], axis=-1)  # 4 q_i^2 - 1, up to a common term
    # Column i holds 4 q_i q: choose the largest, so that nothing is divided by a small number.
    skew = np.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], axis=-1)
    outer = np.empty((*m.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1 + trace
    outer[..., 0, 1:] = outer[..., 1:, 0] = skew
    outer[..., 1:, 1:] = m + np.swapaxes(m, -1, -2)
    for i in range(3):
        outer[..., 1 + i, 1 + i] = 1 + 2 * diagonal[..., i] - trace
    column = np.take_along_axis(outer, np.argmax(squares, axis=-1)[..., None, None], axis=-1)[..., 0]
    q = column / np.linalg.norm(column, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def quaternion_multiply(a: Float[Array, "*b 4"], b: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """Hamilton product: the rotation b, then the rotation a."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = aw * bw - np.sum(av * bv, axis=-1, keepdims=True)
    return np.concatenate([w, aw * bv + bw * av + np.cross(av, bv)], axis=-1)


def quaternion_exp(rotation_vector: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion of a rotation vector [rad]."""
    angle = np.linalg.norm(rotation_vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * rotation_vector], axis=-1)


def rotation_exp(rotation_vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrix of a rotation vector [rad]."""
    return matrix_from_quaternion(quaternion_exp(rotation_vector))


def random_quaternions(n: int, rng: np.random.Generator) -> Float[Array, "n 4"]:
    """Uniform rotations (normalised Gaussians on the 3-sphere)."""
    q = rng.normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def rotation_facing(axis_z: Float[Array, "*b 3"], axis_x_hint: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Rotation whose z column is `axis_z` and whose x column is the hint, made perpendicular to it."""
    z = axis_z / np.linalg.norm(axis_z, axis=-1, keepdims=True)
    x = axis_x_hint - np.sum(axis_x_hint * z, axis=-1, keepdims=True) * z
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)
