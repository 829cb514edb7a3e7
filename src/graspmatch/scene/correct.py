"""Depth that lies: scale and tilt of a whole image, recovered from a table whose true place is known.

Cheap cameras err by a few percent of the depth, and by more on one side of the image than on the other. The model: the
true depth of a pixel is the measured one times a factor that is linear over the image, a + b x + c y, where x and y are
those of its ray (x, y, 1). What the table says about the factor holds for all that stands on it. A camera whose pose is
off by a degree sees the table lean just so; `levelled` gives the pose its share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.se3 import rotation_exp
from graspmatch.scene.camera import pixel_rays
from graspmatch.scene.depth import DepthImage
from graspmatch.scene.plane import find_plane
from graspmatch.types import GraspmatchError, Plane

Array = np.ndarray

SAMPLE = 30_000
"""So many pixels stand for all."""
REACH = 0.03
"""Points so near to the measured plane [m] may be of the table; a tilt of the depth bends the plane a little."""
LIKELY_SCALE = (0.8, 1.25)
LIKELY_TILT = 0.35
"""Larger errors are not those of a camera, but of what was said to be known."""
POSE_SHARE = 0.5
"""Whether the depth is tilted or the camera's pose is turned, no table tells, and half a degree of either is common.
With half for each, nothing is far wrong; a degree of the pose, put on the depth, moves what is 0.6 m away by 15 mm."""
LIKELY_LEAN = np.radians(4.0)
"""What leans by more is no error of calibration."""
VERTICAL = np.array([0.0, 0.0, 1.0])
LEAST_AGREEMENT = 0.01
"""How well the table must fit after the correction: median error of its points [m]."""


@dataclass(frozen=True)
class DepthCorrection:
    """The true depth is the measured one times `scale * (1 + tilt . (x, y))`."""

    scale: float
    tilt: Float[Array, "2"]
    """Per unit of x / z (to the right) and y / z (down)."""
    error_before: float
    """Median distance of the table's points from where the table is [m]; NaN where only its direction is known."""
    error_after: float

    def describe(self) -> str:
        """One sentence."""
        before = "" if np.isnan(self.error_before) else f" (the table was {1000 * self.error_before:.0f} mm off)"
        right, down = 100 * self.tilt
        tilted = f"tilted by {right:+.1f} % to the right and {down:+.1f} % down"
        return f"The depth was scaled by {self.scale:.3f} and {tilted}{before}."


def correct_depth(
    image: DepthImage, *, up_camera: Float[Array, "3"] | None = None, camera_height: float | None = None
) -> tuple[DepthImage, DepthCorrection]:
    """The image with the table where it is known to be.

    up_camera: the table's unit normal in the camera frame, from the camera's pose or an accelerometer: it gives the
        tilt.
    camera_height: distance of the camera from the table's plane [m]. It gives the scale.
    """
    if up_camera is None and camera_height is None:
        raise GraspmatchError(
            "To correct the depth, the table's direction (up_camera), camera_height or both are needed."
        )
    if camera_height is not None and not camera_height > 0:
        raise GraspmatchError(
            f"The camera is {-1000 * camera_height:.0f} mm below the table: is its pose the inverse of T_world_camera?"
        )
    rays, depth = _sample(image)
    measured = find_plane((rays * depth[:, None]).astype(np.float32), origin=np.zeros(3), up=up_camera).plane
    on_table = np.abs(depth * (rays @ measured.normal) - measured.offset) < REACH
    rays, depth = rays[on_table], depth[on_table]
    factor = _factor(rays, depth, measured, up_camera, camera_height)
    _check(factor, camera_height)
    normal = measured.normal if up_camera is None else up_camera
    correction = _described(factor, rays, depth, normal, camera_height)
    if correction.error_after > LEAST_AGREEMENT:
        raise GraspmatchError(
            f"After scaling and tilting the depth, the table is still {1000 * correction.error_after:.0f} mm off: is "
            " the camera's pose right, and is the largest plane in view the table?"
        )
    return _applied(image, factor, correction), correction


def levelled(image: DepthImage, share: float = POSE_SHARE) -> DepthImage:
    """The camera turned, where it stands, by a share of the angle by which the table that it sees is not level.

    The rest is left to `correct_depth`. The image's camera must have a pose.
    """
    T = image.camera.pose
    rays, depth = _sample(image)
    table = find_plane((rays * depth[:, None]).astype(np.float32), origin=np.zeros(3), up=T[2, :3]).plane
    axis = np.cross(T[:3, :3] @ table.normal, VERTICAL)
    sine = float(np.linalg.norm(axis))
    lean = float(np.arcsin(min(sine, 1.0)))
    if not 0 < lean < LIKELY_LEAN:
        return image
    turned = T.copy()
    turned[:3, :3] = rotation_exp(share * lean / sine * axis) @ T[:3, :3]
    note = (
        f"The table leans by {np.degrees(lean):.1f} degrees as it was seen; the camera was turned by a share of that."
    )
    return replace(image, camera=image.camera.placed(turned), notes=(*image.notes, note))


def _sample(image: DepthImage) -> tuple[Float[Array, "n 3"], Float[Array, "n"]]:
    """Rays with z = 1 and depths [m] of pixels all over the image."""
    height, width = image.depth.shape
    x, y = pixel_rays(image.camera, width, height)
    step = max(int(np.sqrt(image.depth.size / SAMPLE)), 1)
    grid = (slice(step // 2, None, step), slice(step // 2, None, step))
    depth = image.depth[grid].ravel().astype(np.float64)
    rays = np.column_stack([x[grid].ravel(), y[grid].ravel(), np.ones(len(depth))]).astype(np.float64)
    seen = np.isfinite(rays.sum(axis=1) * depth)
    return rays[seen], depth[seen]


def _factor(
    rays: Float[Array, "n 3"],
    depth: Float[Array, "n"],
    measured: Plane,
    up: Float[Array, "3"] | None,
    camera_height: float | None,
) -> Float[Array, "3"]:
    """a, b, c of the factor a + b x + c y."""
    if up is None:
        assert camera_height is not None
        return np.array([camera_height / -measured.offset, 0.0, 0.0])
    fall = -depth * (rays @ up)  # how far below the camera each point was measured
    x, y = rays[:, 0], rays[:, 1]
    if camera_height is not None:  # fall * (a + b x + c y) = camera_height
        columns = np.column_stack([fall, fall * x, fall * y])
        return _solved(columns, np.full(len(fall), camera_height))
    # fall * (1 + b x + c y) = the unknown height: the scale stays as it is in the middle of the image
    columns = np.column_stack([fall * x, fall * y, -np.ones(len(fall))])
    b, c, _ = _solved(columns, -fall)
    return np.array([1.0, b, c])


def _solved(columns: Float[Array, "n 3"], right: Float[Array, "n"]) -> Float[Array, "3"]:
    """Least squares without the rows that fit badly: feet of objects, edges."""
    keep = np.ones(len(right), dtype=bool)
    solution = np.zeros(3)
    for _ in range(4):
        solution = np.linalg.lstsq(columns[keep], right[keep], rcond=None)[0]
        off = np.abs(columns @ solution - right)
        keep = off <= max(3 * 1.4826 * float(np.median(off[keep])), 1e-5)
    return solution


def _check(factor: Float[Array, "3"], camera_height: float | None) -> None:
    scale, tilt = factor[0], factor[1:] / factor[0]
    if not LIKELY_SCALE[0] < scale < LIKELY_SCALE[1]:
        away = (
            ""
            if camera_height is None
            else f" {1000 * camera_height / scale:.0f} mm from the camera, not {1000 * camera_height:.0f}"
        )
        raise GraspmatchError(
            f"The table was measured{away}, a factor of {scale:.2f}, which is no error of a camera: check the depth "
            "scale (--depth-scale), the table's height and the camera's pose."
        )
    if np.abs(tilt).max() > LIKELY_TILT:
        raise GraspmatchError(
            f"To make the table level, the depth would have to be tilted by {100 * np.abs(tilt).max():.0f} % from the "
            "middle of the image to its side, which is no error of a camera: check the camera's pose."
        )


def _described(
    factor: Float[Array, "3"],
    rays: Float[Array, "n 3"],
    depth: Float[Array, "n"],
    normal: Float[Array, "3"],
    camera_height: float | None,
) -> DepthCorrection:
    before = -depth * (rays @ normal)
    after = before * (factor[0] + rays[:, :2] @ factor[1:])
    error_before = np.nan if camera_height is None else float(np.median(np.abs(before - camera_height)))
    error_after = float(np.median(np.abs(after - (np.median(after) if camera_height is None else camera_height))))
    return DepthCorrection(float(factor[0]), factor[1:] / factor[0], error_before, error_after)


def _applied(image: DepthImage, factor: Float[Array, "3"], correction: DepthCorrection) -> DepthImage:
    height, width = image.depth.shape
    x, y = pixel_rays(image.camera, width, height)
    a, b, c = factor.astype(np.float32)
    return replace(image, depth=image.depth * (a + b * x + c * y), notes=(*image.notes, correction.describe()))
