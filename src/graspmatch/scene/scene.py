"""What there is to grasp: one object, what stands around it and what it stands on, in the frame of the input."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Bool, Float

from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.kernels.blas import blas_on_one_thread
from graspmatch.scene import surface
from graspmatch.scene.camera import Camera
from graspmatch.scene.captured import free_scene
from graspmatch.scene.depth import DepthImage
from graspmatch.scene.depth_view import Correct, depth_view, plane_in_view
from graspmatch.scene.read import CloudFile, read_cloud, read_mesh, read_object, triangles
from graspmatch.scene.stacked import is_stood_on
from graspmatch.scene.target import targets_in_turn
from graspmatch.scene.view import View, view_of_cloud, with_up
from graspmatch.types import GraspmatchError, Plane, PointCloud

if TYPE_CHECKING:
    import trimesh

Array = np.ndarray
PathLike = str | os.PathLike[str]
Unit = Literal["auto", "m", "cm", "mm"]
Table = Literal["auto"] | float | int | Plane | None

METRES = {"auto": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
SMALLEST, LARGEST = 0.003, 3.0
"""Sizes of an object [m] between which nobody asks whether its unit is right."""


@dataclass(frozen=True)
class Scene:
    """One object as a clean, dense cloud, and all that a hand must not hit. The world frame is that of the input."""

    target: PointCloud
    """R: the surface of the object, a point every 2.5 mm, closer on small objects, with outward normals."""
    obstacles: PointCloud
    """Other things that must not be hit, with what they may have where nobody saw; of length zero if there are none."""
    table: Plane | None
    """Support plane, its normal up."""
    centre_of_mass: Float[Array, "3"]
    """Centroid of the volume [m] where the mesh is watertight or the far side is guessed, of the surface otherwise."""
    source: str
    """Name of the file, or `array`."""
    sensor_origin: Float[Array, "3"] | None = None
    """Where the object was seen from [m]."""
    mesh: TriangleMesh | None = None
    """The object's mesh [m], where the scene was made from one."""
    notes: tuple[str, ...] = ()
    """What was dropped, turned or assumed, one sentence each."""
    view: View | None = None
    """What the sensor saw, where the scene was cut from it: it knows the space that is free and what is hidden."""
    doubtful: Float[Array, "k 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """Places beside the target that nobody saw [m]: where it may be, if it is larger than was guessed."""
    cut: float = 0.0
    """Share of the target's outline in the image where something nearer hides what may follow, 0 to 1."""
    is_guessed: Bool[Array, "n"] | None = None
    """Which points of the target nobody saw: its far side as it is likely to be; None where all are measured."""
    is_hidden: Bool[Array, "m"] | None = None
    """Likewise which of the obstacles."""

    @classmethod
    @blas_on_one_thread()
    def read(
        cls,
        path: PathLike,
        *,
        table: Table = "auto",
        unit: Unit = "auto",
        obstacles: PathLike | PointCloud | Array | None = None,
        sensor_origin: Sequence[float] | Array | None = None,
    ) -> Scene:
        """The scene of any file that `from_mesh` or `from_cloud` can read; files with faces are meshes."""
        content = read_object(path)
        name = Path(path).name
        if isinstance(content, TriangleMesh):
            return _mesh_scene(content, name, table, unit, obstacles)
        return _cloud_scene(content, name, table, unit, obstacles, sensor_origin)

    @property
    def seen_points(self) -> Float[Array, "m 3"]:
        """The target's points, less those that are a guess [m]."""
        return self.target.points if self.is_guessed is None else self.target.points[~self.is_guessed]

    @cached_property
    def beyond(self) -> Float[Array, "n"]:
        """How far each point of the target is from those that were seen [m]."""
        beyond = np.zeros(len(self.target.points))
        if self.is_guessed is not None:
            from scipy.spatial import KDTree

            tree = KDTree(self.seen_points, balanced_tree=False)  # quicker than a balanced one for points far from all
            beyond[self.is_guessed] = tree.query(self.target.points[self.is_guessed], workers=-1)[0]
        return beyond

    @cached_property
    def is_loaded(self) -> bool:
        """Whether something that was seen stands on the target."""
        if self.table is None:
            return False
        others = self.obstacles.points if self.is_hidden is None else self.obstacles.points[~self.is_hidden]
        return is_stood_on(self.target.points, others, self.table)

    @classmethod
    @blas_on_one_thread()
    def from_mesh(
        cls,
        mesh: PathLike | TriangleMesh | trimesh.Trimesh | trimesh.Scene,
        *,
        table: Table = "auto",
        unit: Unit = "auto",
        obstacles: PathLike | PointCloud | Array | None = None,
    ) -> Scene:
        """The scene of a mesh: a file (STL, OBJ, PLY, GLB, GLTF, OFF, DAE) or an object.

        table: `auto` is the horizontal plane under the lowest point, a number is the height of that plane in `unit`,
            a `Plane` is taken as it is [m], None means that there is none.
        unit: of all lengths given; `auto` is metres, and asks where the size of the object makes that unlikely.
        obstacles: a cloud, file or array (m, 3), that must not be hit, in the same frame and unit.
        """
        if isinstance(mesh, (str, os.PathLike)):
            return _mesh_scene(read_mesh(mesh), Path(mesh).name, table, unit, obstacles)
        if isinstance(mesh, TriangleMesh):
            return _mesh_scene(mesh, "array", table, unit, obstacles)
        if not (hasattr(mesh, "faces") or hasattr(mesh, "dump")):
            kinds = "a path, a TriangleMesh or a trimesh object"
            raise GraspmatchError(f"A mesh is needed ({kinds}), not {type(mesh).__name__}.")
        return _mesh_scene(triangles(mesh), "array", table, unit, obstacles)

    @classmethod
    @blas_on_one_thread()
    def from_cloud(
        cls,
        cloud: PathLike | PointCloud | Array,
        *,
        normals: Array | None = None,
        obstacles: PathLike | PointCloud | Array | None = None,
        table: Table = "auto",
        sensor_origin: Sequence[float] | Array | None = None,
        unit: Unit = "auto",
    ) -> Scene:
        """The scene of a point cloud of one object: a file (PLY, PCD, XYZ, TXT, NPY, NPZ, OBJ) or an array (n, 3).

        An NPZ file has its cloud under `points`, `xyz`, `pts` or `object_points`, and may have `normals` and
        `obstacles`. What is given here goes before what the file has. `table`, `unit` and `obstacles` are as for
        `from_mesh`; with `auto` there is no table if the sensor is below the object, for then z is not up.
        normals: (n, 3), outward; without them they are estimated, towards `sensor_origin` where it is known.
        """
        content, name = _as_cloud(cloud)
        if normals is not None:
            content = replace(content, normals=normals)
        return _cloud_scene(content, name, table, unit, obstacles, sensor_origin)

    @classmethod
    @blas_on_one_thread()
    def from_depth(
        cls,
        depth: PathLike | Array | DepthImage,
        camera: PathLike | Array | Camera | None = None,
        *,
        object: int | None = None,
        at: Sequence[float] | None = None,
        mask: PathLike | Array | None = None,
        table: Table = "auto",
        metres_per_unit: float | None = None,
        correct: Correct = "auto",
        up: Sequence[float] | Array | None = None,
        complete: bool = True,
    ) -> Scene:
        """The scene of one object in a depth image (h, w) of a table with things on it.

        camera: intrinsics (3, 3) or their file, or a `Camera`, whose pose makes the world; without a pose the world is
            the camera's frame. An NPZ file of the depth may hold them as `K`.
        object, at, mask: its number, a pixel (column, row) of it, or its pixels (h, w); without any, it is that of
            which most is seen, of those on which nothing stands. A mask may mark several objects by their values, which
            are their numbers.
        table: `auto` finds it; its height in the world needs the camera's pose.
        metres_per_unit: what one step of the depth is [m]; without it, integers are millimetres and floats metres.
        correct: `auto` makes the table come out where it is, if its height is given: half of what it leans is put on
            the camera's pose, the rest on the depth, which is scaled and tilted; `depth` believes the pose; `tilt` only
            makes the table level, which needs the camera's pose or `up`; `off` believes pose and depth.
        up: against gravity, in the camera frame, where that is known and the camera's pose is not.
        complete: guess the far side of the object, where there is a table and the camera's place is known.
        """
        view, plane = depth_view(depth, camera, table, metres_per_unit=metres_per_unit, correct=correct, up=up)
        targets = targets_in_turn(view, plane, number=object, at=at, mask=mask)
        return free_scene(cls, view, targets, with_table=table is not None, complete=complete)

    @classmethod
    @blas_on_one_thread()
    def from_view(
        cls,
        view: View | PathLike | PointCloud | Array,
        *,
        object: int | None = None,
        at: Sequence[float] | None = None,
        mask: PathLike | Array | None = None,
        table: Table = "auto",
        unit: Unit = "auto",
        T_world_cloud: Array | None = None,
        sensor_origin: Sequence[float] | Array | None = None,
        up: Sequence[float] | Array | None = None,
        complete: bool = True,
    ) -> Scene:
        """The scene of one object in a cloud of a table with things on it: a file, an array or a `View`.

        `object`, `at`, `mask`, `table`, `up` and `complete` are as for `from_depth`; where the cloud has no rows, `at`
        is x, y [m] in its frame, and there can be no mask. An organised array is (h, w, 3). `T_world_cloud` is the pose
        of a cloud that is in its camera's frame.
        """
        if not isinstance(view, View):
            view = cloud_view(view, unit, T_world_cloud, sensor_origin)
        view = with_up(view, up)
        plane = plane_in_view(view, table, _metres(unit))
        targets = targets_in_turn(view, plane, number=object, at=at, mask=mask)
        return free_scene(cls, view, targets, with_table=table is not None, complete=complete)


def _mesh_scene(mesh: TriangleMesh, name: str, table: Table, unit: Unit, obstacles: object) -> Scene:
    scale = _metres(unit)
    mesh, areas, notes = surface.clean_mesh(TriangleMesh(np.asarray(mesh.vertices) * scale, mesh.faces), name)
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    _check_size(np.ptp(corners, axis=0), name, unit)
    if Path(name).suffix.lower() in (".glb", ".gltf"):
        notes += ("The z axis of the file is taken as up; many glTF files have y up and must be turned first.",)
    target, spacing = surface.mesh_surface(mesh, areas)
    return Scene(
        target=target,
        obstacles=_obstacle_cloud(obstacles, scale, spacing),
        table=_support_plane(table, corners, scale, None),
        centre_of_mass=surface.mesh_centre(mesh, areas),
        source=name,
        mesh=mesh,
        notes=notes,
    )


def _cloud_scene(
    content: CloudFile, name: str, table: Table, unit: Unit, obstacles: object, sensor_origin: object
) -> Scene:
    scale = _metres(unit)
    sensor = content.sensor_origin if sensor_origin is None else sensor_origin
    sensor = None if sensor is None else scale * _vector(sensor, "sensor_origin")
    points, normals, notes = surface.usable_points(content.points, content.normals, scale, name)
    _check_size(surface.typical_extent(points), name, unit, is_cloud=True)
    target, kept, spacing, more = surface.cloud_surface(points, normals, sensor)
    plane = _support_plane(table, kept, scale, sensor)
    if table == "auto" and plane is None:
        more += ("The sensor is below the object, so z is not up here: no table is assumed.",)
    return Scene(
        target=target,
        obstacles=_obstacle_cloud(content.obstacles if obstacles is None else obstacles, scale, spacing),
        table=plane,
        centre_of_mass=target.points.mean(axis=0),
        source=name,
        sensor_origin=sensor,
        notes=notes + more,
    )


def cloud_view(cloud: object, unit: Unit, T_world_cloud: Array | None, sensor_origin: object) -> View:
    """The view of a cloud of a whole scene: a file or an array."""
    if isinstance(cloud, np.ndarray) and cloud.ndim == 3:
        content, name = CloudFile(cloud), "array"
    else:
        content, name = _as_cloud(cloud)
    origin = None if sensor_origin is None else _vector(sensor_origin, "sensor_origin")
    return view_of_cloud(content, scale=_metres(unit), sensor_origin=origin, T_world_cloud=T_world_cloud, source=name)


def _as_cloud(cloud: object, name: str = "array") -> tuple[CloudFile, str]:
    """The cloud of a path, a PointCloud or an array; and the name of the file, or else the given one."""
    if isinstance(cloud, (str, os.PathLike)):
        return read_cloud(cloud), Path(cloud).name
    if isinstance(cloud, PointCloud):
        return CloudFile(cloud.points, cloud.normals), name
    return CloudFile(surface.as_rows(cloud, name)), name


def _obstacle_cloud(obstacles: object, scale: float, spacing: float) -> PointCloud:
    if obstacles is None:
        return PointCloud(np.zeros((0, 3)))
    content, name = _as_cloud(obstacles, "the obstacle cloud")
    points = surface.as_rows(content.points, name) * scale
    if len(points) and not np.isfinite(points).all(axis=1).any():
        raise GraspmatchError(f"{name} has {len(points)} obstacle points, and none of them is finite.")
    return PointCloud(surface.thin_obstacles(points, spacing))


def _metres(unit: str) -> float:
    if unit not in METRES:
        raise GraspmatchError(f"Unknown unit {unit!r}. Known: {', '.join(METRES)}.")
    return METRES[unit]


def _check_size(extent: Float[Array, "3"], name: str, unit: Unit, *, is_cloud: bool = False) -> None:
    """With the unit unsaid, ask for it where the size of the object [m] is not that of a thing to grasp."""
    size = float(extent.max())
    if unit != "auto" or SMALLEST <= size <= LARGEST:
        return
    measured = f"{name} is {size:,.4g} m {'tall' if int(np.argmax(extent)) == 2 else 'long'}"
    if size < SMALLEST:
        raise GraspmatchError(f'{measured}, which no hand can grasp: pass its unit, unit="cm" or "m" (--unit m).')
    if is_cloud and size < 10 * LARGEST:
        raise GraspmatchError(
            f'{measured}: cut it to one object if it is a whole scene, or pass its unit, unit="mm" or "cm" (--unit mm).'
        )
    if size < 1000 * LARGEST:
        raise GraspmatchError(f'{measured}: it is probably in millimetres; pass unit="mm" (--unit mm).')
    raise GraspmatchError(f"{measured}: scale it to metres, centimetres or millimetres and pass that unit.")


def _support_plane(
    table: Table, points: Float[Array, "n 3"], scale: float, sensor: Float[Array, "3"] | None
) -> Plane | None:
    """The table under the points of the object [m]; a table that the object would be sunk in is refused."""
    if table is None:
        return None
    if isinstance(table, str):
        if table != "auto":
            raise GraspmatchError(f"Unknown table {table!r}. Known: auto, the height of the table, a Plane, None.")
        lowest = float(points[:, 2].min())
        below = sensor is not None and sensor[2] < lowest
        return None if below else Plane(np.array([0.0, 0.0, 1.0]), lowest)
    if isinstance(table, Plane):
        normal = _vector(table.normal, "the table's normal")
        length = float(np.linalg.norm(normal))
        if length == 0 or not np.isfinite(table.offset):
            raise GraspmatchError("The table needs a normal that is not zero and an offset that is a number.")
        plane = Plane(normal / length, float(table.offset) / length)
    elif isinstance(table, (int, float, np.integer, np.floating)) and np.isfinite(table):
        plane = Plane(np.array([0.0, 0.0, 1.0]), float(table) * scale)
    else:
        raise GraspmatchError(f"The table is {table!r}. Possible: auto, the height of the table, a Plane, None.")
    _check_table(plane, points)
    return plane


def _check_table(plane: Plane, points: Float[Array, "n 3"]) -> None:
    heights = points @ plane.normal - plane.offset
    sunk, top = -float(heights.min()), float(heights.max())
    lower = "lower it, or pass table='auto' (under the lowest point) or None (no table)"
    if top <= 0:
        raise GraspmatchError(f"The table is {-top * 1000:.0f} mm above the top of the object: {lower}.")
    if sunk > min(0.01, max((top + sunk) / 5, 0.003)):
        raise GraspmatchError(f"The object reaches {sunk * 1000:.0f} mm below the table: {lower}.")


def _vector(value: object, name: str) -> Float[Array, "3"]:
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise GraspmatchError(f"{name} must be three numbers, not {value!r}.") from error
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise GraspmatchError(f"{name} must be three finite numbers, not {value!r}.")
    return vector
