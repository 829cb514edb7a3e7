"""A pinhole camera with a lens: where it stands, and the ray of each of its pixels."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32

from graspmatch.geometry.se3 import is_rigid
from graspmatch.types import GraspmatchError

Array = np.ndarray

MOST_COEFFICIENTS = 8
"""k1 k2 p1 p2 k3 k4 k5 k6: the rational model; plumb_bob is its first five."""
UNDISTORTED = 1e-4
"""How exactly a ray must come back through the lens, in units of the focal length: 0.06 pixels at 600."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics, lens and pose. Camera frame: x right, y down, z forward; pixel (0, 0) is the centre of the first."""

    K: Float[Array, "3 3"]
    """Focal lengths and principal point [pixels]."""
    T_world_camera: Float[Array, "4 4"] | None = None
    """Where the camera stands, in a world whose z is up; none: the world frame is the camera's."""
    distortion: Float[Array, "k"] = field(default_factory=lambda: np.zeros(0))
    """Coefficients of the lens as ROS and OpenCV order them: k1 k2 p1 p2 [k3 [k4 k5 k6]]."""
    size: tuple[int, int] | None = None
    """Width and height of the images that the intrinsics are for [pixels], where that is known."""

    @property
    def pixel_angle(self) -> float:
        """Angle between neighbouring pixels in the middle of the image [rad]."""
        return float(2 / (self.K[0, 0] + self.K[1, 1]))

    @property
    def pose(self) -> Float[Array, "4 4"]:
        """`T_world_camera`, the identity where there is none."""
        return np.eye(4) if self.T_world_camera is None else self.T_world_camera

    def placed(self, T_world_camera: Float[Array, "4 4"]) -> Camera:
        """The same camera, standing elsewhere."""
        return replace(self, T_world_camera=checked_pose(T_world_camera))


def camera(
    intrinsics: Camera | Array,
    T_world_camera: Array | None = None,
    *,
    distortion: Array | tuple[float, ...] = (),
    size: tuple[int, int] | None = None,
) -> Camera:
    """A camera of a matrix (3, 3) or of four numbers fx, fy, cx, cy [pixels], checked."""
    if isinstance(intrinsics, Camera):
        return intrinsics if T_world_camera is None else intrinsics.placed(T_world_camera)
    made = Camera(checked_intrinsics(intrinsics), distortion=checked_lens(distortion), size=size)
    return made if T_world_camera is None else made.placed(T_world_camera)


def checked_intrinsics(values: object) -> Float[Array, "3 3"]:
    """The camera matrix of nine numbers, or of fx, fy, cx, cy."""
    try:
        K = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise GraspmatchError(
            f"The intrinsics must be numbers: a 3x3 matrix or fx, fy, cx, cy, not {values!r}."
        ) from error
    if K.size == 4:
        fx, fy, cx, cy = K.ravel()
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if K.size != 9:
        raise GraspmatchError(f"The intrinsics have shape {K.shape}; a 3x3 matrix or fx, fy, cx, cy is needed.")
    K = K.reshape(3, 3)
    if not np.isfinite(K).all() or K[0, 0] <= 1 or K[1, 1] <= 1:
        raise GraspmatchError(
            f"The focal lengths are {K[0, 0]:.4g} and {K[1, 1]:.4g}; they are needed in pixels, some hundreds "
            "(an uncalibrated ROS camera sends zeros)."
        )
    if np.abs(K[2] - [0, 0, 1]).max() > 1e-6 or abs(K[1, 0]) > 1e-6:
        raise GraspmatchError("The camera matrix must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]]; is it transposed?")
    return K


def checked_lens(values: object) -> Float[Array, "k"]:
    """Coefficients of the lens, none if all are zero."""
    coefficients = np.asarray(values, dtype=np.float64).ravel()
    if len(coefficients) not in (0, 4, 5, 8) and np.any(coefficients[MOST_COEFFICIENTS:]):
        raise GraspmatchError(
            f"The lens has {len(coefficients)} distortion coefficients; known are 4 or 5 (plumb_bob: k1 k2 p1 p2 k3) "
            "and 8 (rational_polynomial: k1 k2 p1 p2 k3 k4 k5 k6)."
        )
    if not np.isfinite(coefficients).all():
        raise GraspmatchError("The distortion coefficients of the lens must be finite numbers.")
    return coefficients[:MOST_COEFFICIENTS] if coefficients.any() else np.zeros(0)


def checked_pose(T: object) -> Float[Array, "4 4"]:
    """A rigid transform."""
    matrix = np.asarray(T, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise GraspmatchError(f"The camera pose has shape {matrix.shape}; T_world_camera (4, 4) is needed.")
    if not is_rigid(matrix[None], tolerance=1e-3)[0]:
        raise GraspmatchError(
            "The camera pose is no rigid transform: its upper left 3x3 must be a rotation, its last row 0 0 0 1."
        )
    return matrix


def check_size(of: Camera, width: int, height: int) -> None:
    """Refuse an image that the intrinsics are not for."""
    if of.size is not None and of.size != (width, height):
        raise GraspmatchError(
            f"The intrinsics are for images of {of.size[0]} x {of.size[1]} pixels, the depth image has "
            f"{width} x {height}: give those of the depth stream."
        )
    cx, cy = of.K[0, 2], of.K[1, 2]
    if not (0 < cx < width and 0 < cy < height):
        raise GraspmatchError(
            f"The principal point ({cx:.0f}, {cy:.0f}) lies outside the depth image of {width} x {height} pixels: "
            "the intrinsics are of another image."
        )


def pixel_rays(of: Camera, width: int, height: int) -> tuple[Float32[Array, "h w"], Float32[Array, "h w"]]:
    """x / z and y / z of what each pixel sees, the lens undone; NaN where the lens model does not reach."""
    return _rays(of.K.tobytes(), of.distortion.tobytes(), width, height)


def distorted(
    x: Float[Array, "*b"], y: Float[Array, "*b"], distortion: Float[Array, "k"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Where the lens puts the ray (x, y, 1), as x and y before the camera matrix (the rational model of OpenCV)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(distortion, (0, MOST_COEFFICIENTS - len(distortion)))
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@lru_cache(maxsize=8)
def _rays(K_bytes: bytes, lens: bytes, width: int, height: int) -> tuple[Array, Array]:
    """Kept, since a stream of images has one camera."""
    K, distortion = np.frombuffer(K_bytes).reshape(3, 3), np.frombuffer(lens)
    seen_y = (np.arange(height)[:, None] - K[1, 2]) / K[1, 1]
    seen_x = (np.arange(width)[None] - K[0, 2] - K[0, 1] * seen_y) / K[0, 0]
    seen_x, seen_y = np.broadcast_arrays(seen_x, seen_y)
    x, y = (seen_x, seen_y) if len(distortion) == 0 else _undistorted(seen_x, seen_y, distortion)
    rays = x.astype(np.float32), y.astype(np.float32)
    for ray in rays:
        ray.flags.writeable = False
    return rays


def _undistorted(seen_x: Array, seen_y: Array, distortion: Array) -> tuple[Array, Array]:
    """The rays that the lens puts there, by Newton's method with the Jacobian of finite differences."""
    x, y, h = seen_x.copy(), seen_y.copy(), 1e-6
    with np.errstate(all="ignore"):  # what runs away becomes NaN below
        for _ in range(8):
            at_x, at_y = distorted(x, y, distortion)
            xx, yx = ((d - a) / h for d, a in zip(distorted(x + h, y, distortion), (at_x, at_y), strict=True))
            xy, yy = ((d - a) / h for d, a in zip(distorted(x, y + h, distortion), (at_x, at_y), strict=True))
            off_x, off_y, det = seen_x - at_x, seen_y - at_y, xx * yy - xy * yx
            x, y = x + (yy * off_x - xy * off_y) / det, y + (xx * off_y - yx * off_x) / det
        at_x, at_y = distorted(x, y, distortion)
        wrong = ~(np.hypot(at_x - seen_x, at_y - seen_y) < UNDISTORTED)
    return np.where(wrong, np.nan, x), np.where(wrong, np.nan, y)
