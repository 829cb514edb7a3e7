"""What a sensor saw of a scene: points, organised as an image or not, and where they were seen from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Float32

from graspmatch.geometry.se3 import apply
from graspmatch.kernels.blas import blas_on_one_thread
from graspmatch.scene.camera import checked_pose
from graspmatch.scene.depth import FEWEST_PIXELS, DepthImage, flying
from graspmatch.scene.plane import find_plane
from graspmatch.scene.read import CloudFile
from graspmatch.types import GraspmatchError

Array = np.ndarray

CLEARLY, NEARBY = 0.02, 0.3
"""Heights of things on a table [m], of most of them."""
SMALLEST_SCENE, LARGEST_SCENE = 0.01, 40.0
"""Sizes of a scene [m] between which nobody asks whether its unit is right."""
WIDEST_VIEW = 1.2
"""x / z and y / z of what a camera sees stay below this: 100 degrees."""


@dataclass(frozen=True)
class View:
    """Points in the frame of the sensor or of the cloud's file, called the view frame."""

    points: Float[Array, "n 3"]
    """[m], NaN where nothing was seen; row by row where they are organised."""
    shape: tuple[int, int] | None = None
    """Rows and columns of an organised view."""
    origin: Float[Array, "3"] | None = None
    """Where the camera stands [m], where that is known."""
    up: Float[Array, "3"] | None = None
    """Unit vector against gravity, where that is known."""
    T_world_view: Float[Array, "4 4"] = field(default_factory=lambda: np.eye(4))
    is_placed: bool = False
    """Whether z is up in the world; or else the world is the camera's frame."""
    pixel_angle: float | None = None
    """Angle between neighbouring pixels [rad]."""
    depth: DepthImage | None = None
    """The image that the points are of: it knows the space that was seen to be free."""
    source: str = "array"
    notes: tuple[str, ...] = ()

    @property
    def is_seen(self) -> Bool[Array, "n"]:
        """Which points are measurements."""
        return np.isfinite(self.points[:, 2])


@blas_on_one_thread()
def view_of_depth(image: DepthImage, source: str = "array") -> View:
    """What a depth image saw, in the frame of its camera."""
    camera, is_placed = image.camera, image.camera.T_world_camera is not None
    return View(
        image.points.reshape(-1, 3),
        shape=(image.depth.shape[0], image.depth.shape[1]),
        origin=np.zeros(3),
        up=camera.pose[2, :3].copy() if is_placed else None,
        T_world_view=camera.pose,
        is_placed=is_placed,
        pixel_angle=camera.pixel_angle,
        depth=image,
        source=source,
        notes=image.notes,
    )


@blas_on_one_thread()
def view_of_cloud(
    cloud: CloudFile,
    *,
    scale: float = 1.0,
    sensor_origin: Float[Array, "3"] | None = None,
    T_world_cloud: Array | None = None,
    source: str = "array",
) -> View:
    """What a cloud of a whole scene shows, in the frame of the cloud.

    Where the sensor is unknown and all points lie in front of the origin as a camera at it would see them, the camera
    is taken to be there. `T_world_cloud` says where that frame is in a world whose z is up.
    """
    points, shape = _float_points(cloud, scale, source)
    seen = np.isfinite(points @ np.ones(3, dtype=np.float32))  # reducing many short rows is slow
    if np.count_nonzero(seen) < FEWEST_PIXELS:
        raise GraspmatchError(
            f"{source} has {np.count_nonzero(seen)} usable of {len(points)} points; {FEWEST_PIXELS} are needed."
        )
    points[~seen] = np.nan
    measured = np.compress(seen, points, axis=0)  # a third of the time of points[seen]
    _check_unit(measured, source)
    origin = cloud.sensor_origin if sensor_origin is None else sensor_origin
    origin = None if origin is None else scale * np.asarray(origin, dtype=np.float64)
    from_camera = _is_before_camera(measured, is_sure=origin is not None)
    notes: tuple[str, ...] = ()
    if origin is None and from_camera:
        origin, notes = np.zeros(3), ("The camera is taken to be at the origin of the cloud.",)
    pixel_angle = None
    if shape is not None and origin is not None:
        square = np.square(seen_from(origin, points)) @ np.ones(3, dtype=np.float32)
        ranges = np.sqrt(square).reshape(shape)
        pixel_angle = _angle_between_pixels(points.reshape(*shape, 3), ranges)
        points[flying(ranges, pixel_angle).ravel()] = np.nan
    T = checked_pose(T_world_cloud) if T_world_cloud is not None else np.eye(4)
    is_placed = T_world_cloud is not None or not from_camera  # no camera's frame: z is up, as the conventions say
    return View(
        points,
        shape,
        origin,
        T[2, :3].copy() if is_placed else None,
        T,
        is_placed,
        pixel_angle,
        source=source,
        notes=notes,
    )


def with_up(view: View, up: object) -> View:
    """The view with the direction against gravity that an accelerometer says; None changes nothing."""
    if up is None:
        return view
    vector = np.asarray(up, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not np.linalg.norm(vector) > 0:
        raise GraspmatchError(f"up must be three numbers that are not all zero, not {up!r}.")
    return replace(view, up=vector / np.linalg.norm(vector))


def to_world(view: View, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Points of the view frame, in the world."""
    return apply(view.T_world_view, points.astype(np.float64))


def seen_from(origin: Float[Array, "3"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """The points with the sensor at zero; the same array where it is there anyway."""
    return points - origin.astype(points.dtype) if origin.any() else points


def _float_points(cloud: CloudFile, scale: float, source: str) -> tuple[Float32[Array, "n 3"], tuple[int, int] | None]:
    values = np.asarray(cloud.points)
    if values.ndim not in (2, 3) or values.shape[-1] != 3 or values.dtype.kind not in "uif":
        raise GraspmatchError(f"{source} has shape {values.shape}; (n, 3), or (h, w, 3) if organised, is needed.")
    shape = cloud.shape if values.ndim == 2 else (values.shape[0], values.shape[1])
    points = values.reshape(-1, 3).astype(np.float32) * np.float32(scale)
    if shape is not None:
        points[(points[:, 2] == 0) & (points[:, 0] == 0)] = np.nan  # how many drivers write that nothing was seen
    return points, shape


def _check_unit(points: Float[Array, "n 3"], source: str) -> None:
    """Refuse a scene that is larger or smaller than a room or a thing [m]."""
    low, high = np.percentile(points[:: max(len(points) // 5000, 1)], [5, 95], axis=0)
    size = float(np.max(high - low))
    if size > LARGEST_SCENE:
        raise GraspmatchError(
            f'{source} is {size:,.0f} m wide: it is probably in millimetres; pass unit="mm" (--unit mm).'
        )
    if size < SMALLEST_SCENE:
        raise GraspmatchError(f'{source} is {1000 * size:.2g} mm wide: pass its unit, unit="m" or "cm" (--unit cm).')


def _is_before_camera(points: Float[Array, "n 3"], *, is_sure: bool) -> bool:
    """Whether a camera at the origin that looks along z would see these points.

    So would it see some clouds in a frame whose z is up, but from below their table: unless it `is_sure` that the cloud
    is as the sensor gave it, what stands on the table must be on the side of the camera.
    """
    x, y, z = points[:: max(len(points) // 5000, 1)].T
    if not ((z > 0.1).all() and np.mean(np.maximum(np.abs(x), np.abs(y)) < WIDEST_VIEW * z) > 0.98):
        return False
    if is_sure:
        return True
    try:
        table = find_plane(points, origin=np.zeros(3)).plane
    except GraspmatchError:
        return True
    heights = points @ table.normal - table.offset
    return bool(np.mean((heights > CLEARLY) & (heights < NEARBY)) > np.mean((heights < -CLEARLY) & (heights > -NEARBY)))


def _angle_between_pixels(points: Float32[Array, "h w 3"], ranges: Float32[Array, "h w"]) -> float:
    """Median angle [rad] between neighbours in a row that are about equally far."""
    a, b = points[::4, 1::4], points[::4, :-1:4][:, : points[::4, 1::4].shape[1]]
    reach = ranges[::4, 1::4]
    chord = np.linalg.norm(a - b, axis=-1) / reach
    known = chord[np.isfinite(chord)]
    return float(np.median(known)) if len(known) else 0.002
