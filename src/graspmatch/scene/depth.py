"""Depth images: their unit, their wrong pixels, and the points that they saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Shaped

from graspmatch.scene.camera import Camera, check_size, pixel_rays
from graspmatch.types import GraspmatchError

Array = np.ndarray

NEAREST, FARTHEST = 0.05, 20.0
"""Median depths [m] between which nobody asks whether the unit is right."""
FEWEST_PIXELS = 100
STEEP = 8.0
"""Rise over run above which a surface is seen too much from the side to be one: 83 degrees."""


@dataclass(frozen=True)
class DepthImage:
    """Distance along the camera's z axis [m] of what each pixel saw, NaN where it saw nothing."""

    depth: Float32[Array, "h w"]
    camera: Camera
    notes: tuple[str, ...] = ()
    """What was dropped or assumed, one sentence each."""

    @property
    def points(self) -> Float32[Array, "h w 3"]:
        """What each pixel saw, in the camera frame."""
        height, width = self.depth.shape
        x, y = pixel_rays(self.camera, width, height)
        points = np.empty((height, width, 3), dtype=np.float32)
        np.multiply(x, self.depth, out=points[:, :, 0])
        np.multiply(y, self.depth, out=points[:, :, 1])
        points[:, :, 2] = self.depth
        return points


def depth_image(
    depth: Shaped[Array, "h w"], camera: Camera, *, metres_per_unit: float | None = None, drop_edges: bool = True
) -> DepthImage:
    """Depth in metres, without zeros and flying pixels.

    metres_per_unit: what one step of the values is [m]; without it, integers are millimetres (as in ROS and OpenNI)
        and floats metres, or millimetres where metres are impossible.
    drop_edges: leave out pixels that hang between an object and what is behind it.
    """
    raw = np.asarray(depth)
    if raw.ndim != 2 or raw.dtype.kind not in "uif":
        raise GraspmatchError(f"The depth image has shape {raw.shape} and type {raw.dtype}; numbers (h, w) are needed.")
    check_size(camera, raw.shape[1], raw.shape[0])
    measured = _measured(raw)
    scale, notes = _unit(raw, measured, metres_per_unit)
    image = raw.astype(np.float32)
    image *= np.float32(scale)
    image[~measured] = np.nan
    if drop_edges:
        image[flying(image, camera.pixel_angle)] = np.nan
    return DepthImage(image, camera, notes)


def flying(depth: Float32[Array, "h w"], pixel_angle: float) -> Bool[Array, "h w"]:
    """Pixels between two steep steps, along the row or the column; a step into nothing counts as steep.

    Where a pixel sees an edge, sensors average what is in front and behind: the point hangs in the air. A true edge
    has a steep step on one side only. `pixel_angle` [rad] says how far apart neighbours are.
    """
    limit = np.float32(STEEP * pixel_angle)
    found = np.zeros(depth.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        for image, mark in ((depth, found), (depth.T, found.T)):
            step = np.abs(np.diff(image, axis=1))
            # Comparisons with NaN are false, so a step into nothing is not smooth.
            smooth = step <= limit * np.minimum(image[:, 1:], image[:, :-1])
            mark[:, 1:-1] |= ~(smooth[:, 1:] | smooth[:, :-1])
    return found


def _measured(raw: Array) -> Bool[Array, "h w"]:
    """Pixels that say something: not zero, not the largest integer, finite, below ten kilometres in any unit."""
    with np.errstate(invalid="ignore"):
        measured = (raw > 0) & (raw < (1e7 if raw.dtype.kind == "f" else np.iinfo(raw.dtype).max))
    count = int(np.count_nonzero(measured))
    if count < FEWEST_PIXELS:
        raise GraspmatchError(
            f"Only {count} of {raw.size} pixels of the depth image have a depth; at least {FEWEST_PIXELS} are needed."
        )
    return measured


def _unit(raw: Array, measured: Bool[Array, "h w"], given: float | None) -> tuple[float, tuple[str, ...]]:
    """Metres per step of the values, and a note where it was guessed against the custom."""
    typical = float(np.median(raw[::4, ::4][measured[::4, ::4]])) if measured[::4, ::4].any() else float(raw.max())
    custom = 0.001 if raw.dtype.kind in "ui" else 1.0
    if given is not None:
        if not (np.isfinite(given) and given > 0):
            raise GraspmatchError(f"The depth scale is {given}; it must be a positive number of metres per step.")
        if not NEAREST <= typical * given <= FARTHEST:
            raise _wrong_unit(typical, given)
        return float(given), ()
    if NEAREST <= typical * custom <= FARTHEST:
        return custom, ()
    if custom == 1.0 and NEAREST <= typical * 0.001 <= FARTHEST:
        return 0.001, (f"The depth image is taken as millimetres: its median is {typical:,.0f}.",)
    raise _wrong_unit(typical, custom)


def _wrong_unit(typical: float, scale: float) -> GraspmatchError:
    fitting = [unit for unit in (1.0, 0.001, 0.0002, 0.0001, 0.00025) if 0.2 <= typical * unit <= 5]
    hint = (
        " or ".join(f"{unit:g} ({typical * unit:.2g} m)" for unit in fitting) or "the metres that one step stands for"
    )
    return GraspmatchError(
        f"The median of the depth image is {typical * scale:.4g} m at {scale:g} m a step, which is in the wrong unit: "
        f"pass another depth scale (--depth-scale), such as {hint}."
    )
