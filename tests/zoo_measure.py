"""How far a built-in hand is from the real hand's own file: frames, and distances between seen surfaces.

Both files are compiled by MuJoCo (MJCF or URDF) at the same joint values; all surfaces are in the base link's frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh
from jaxtyping import Bool, Float

from graspmatch.geometry.mesh import TriangleMesh, concatenate, sample_surface, transformed
from graspmatch.geometry.se3 import inverse

SHARED_GRIPPERS = Path(__file__).parents[1] / ".." / "shared" / "data" / "grippers"
ZOO = Path(__file__).parents[1] / "src" / "graspmatch" / "gripper" / "zoo"

NEAR = 1e-4
"""A ray that ends this near the sample [m] has seen it."""


@dataclass(frozen=True)
class PosedHand:
    """A hand at fixed joint values."""

    surface: TriangleMesh
    """All geoms, visual and collision, in the frame of the base link."""
    T_base_link: dict[str, Float[np.ndarray, "4 4"]]
    joints: dict[str, float]
    """Every joint, passive ones too."""
    T_base_joint: dict[str, Float[np.ndarray, "4 4"]]
    """Frame at each joint's anchor whose z axis is the joint axis (x and y: any)."""
    ranges: dict[str, tuple[float, float]]


def pose_hand(description: Path, base_link: str, joint_values: dict[str, float]) -> PosedHand:
    """The hand with the given joints held; joints left out follow the file's couplings and loop closures."""
    model = compiled(description)
    data = mujoco.MjData(model)
    solve_couplings(model, data, joint_values)
    T_base_world = inverse(body_frame(data, model.body(base_link).id))
    meshes = [transformed(geom_mesh(model, g), T_base_world @ geom_frame(data, g)) for g in range(model.ngeom)]
    joints = [model.joint(j) for j in range(model.njnt)]
    return PosedHand(
        surface=concatenate(meshes),
        T_base_link={model.body(b).name: T_base_world @ body_frame(data, b) for b in range(1, model.nbody)},
        joints={joint.name: float(data.qpos[joint.qposadr[0]]) for joint in joints},
        T_base_joint={joint.name: T_base_world @ joint_frame(data, joint.id) for joint in joints},
        ranges={joint.name: (float(joint.range[0]), float(joint.range[1])) for joint in joints},
    )


def inner_surface_deviation(
    from_hand: PosedHand, to_hand: PosedHand, view_points: Float[np.ndarray, "v 3"], *, density: float = 2e5
) -> Float[np.ndarray, "n"]:
    """Distance [m] to `to_hand` of the points of `from_hand` that can be seen from any of the view points.

    View points (base frame) lie in the grasp, between the fingers and before the palm. The points are spread evenly
    over the surface, `density` per square metre. Swap the hands for the reverse direction.
    """
    return distance_to(to_hand.surface, seen_points(from_hand.surface, view_points, density=density))


def outer_surface_deviation(
    from_hand: PosedHand, to_hand: PosedHand, *, density: float = 5e4
) -> Float[np.ndarray, "n"]:
    """The same for all that can be seen from around the hand."""
    vertices = from_hand.surface.vertices
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    around = centre + 3 * np.ptp(vertices, axis=0).max() * trimesh.creation.icosphere(subdivisions=1).vertices
    return distance_to(to_hand.surface, seen_points(from_hand.surface, around, density=density))


def view_grid(low: list[float], high: list[float], counts: list[int]) -> Float[np.ndarray, "v 3"]:
    """View points spread evenly over a box."""
    axes = [
        np.linspace(a, b, n) if n > 1 else np.array([(a + b) / 2]) for a, b, n in zip(low, high, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def seen_points(
    surface: TriangleMesh, view_points: Float[np.ndarray, "v 3"], *, density: float
) -> Float[np.ndarray, "n 3"]:
    """Samples of the surface that face one of the view points with nothing between.

    A view point inside the solid sees nothing, because there every surface shows its back.
    """
    points, normals = sample_surface(surface, density, np.random.default_rng(0))
    seen = np.zeros(len(points), dtype=bool)
    for view in view_points:
        index = np.flatnonzero(~seen & (((view - points) * normals).sum(axis=1) > 0))
        seen[index] = reaches(surface, view, points[index])
    if not seen.any():
        raise ValueError("No surface is seen: put the view points in free space that faces the hand.")
    return points[seen]


def reaches(
    surface: TriangleMesh, view: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n"]:
    """Is the way from the view point to each point free?"""
    import warp as wp

    distance = np.linalg.norm(points - view, axis=1)
    directions = (points - view) / np.maximum(distance, 1e-9)[:, None]
    hit = wp.zeros(len(points), dtype=wp.float32, device="cpu")
    inputs = [warp_mesh(surface).id, wp.vec3(*view), warp_vectors(directions), hit]
    wp.launch(measuring_kernels()[0], dim=len(points), inputs=inputs, device="cpu")
    return hit.numpy() > distance - NEAR


def distance_to(surface: TriangleMesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Distance [m] of each point to the nearest triangle."""
    import warp as wp

    found = wp.zeros(len(points), dtype=wp.float32, device="cpu")
    inputs = [warp_mesh(surface).id, warp_vectors(points), found]
    wp.launch(measuring_kernels()[1], dim=len(points), inputs=inputs, device="cpu")
    return found.numpy().astype(float)


@cache
def compiled(description: Path) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(description))
    spec.compiler.discardvisual = False
    spec.compiler.fusestatic = False
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return spec.compile()


def solve_couplings(model: mujoco.MjModel, data: mujoco.MjData, joint_values: dict[str, float]) -> None:
    """Gauss-Newton on the equality constraints (couplings, closed loops) over the joints that are not given."""
    known = {model.joint(j).name for j in range(model.njnt)}
    if unknown := set(joint_values) - known:
        raise ValueError(f"No joint named {sorted(unknown)}. Known: {sorted(known)}.")
    for name, value in joint_values.items():
        data.joint(name).qpos = value
    free = [model.joint(j).dofadr[0] for j in range(model.njnt) if model.joint(j).name not in joint_values]
    for _ in range(100):
        mujoco.mj_fwdPosition(model, data)
        rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        residual = data.efc_pos[rows]
        if not rows.any() or np.abs(residual).max() < 1e-9:
            return
        jacobian = data.efc_J.reshape(-1, model.nv)[rows][:, free]
        step = np.zeros(model.nv)
        step[free] = np.linalg.lstsq(jacobian, -residual, rcond=None)[0]
        mujoco.mj_integratePos(model, data.qpos, np.clip(step, -0.1, 0.1), 1.0)
    raise ValueError(
        f"The couplings of the hand cannot be met at {joint_values} (off by {np.abs(residual).max():.2g})."
    )


def body_frame(data: mujoco.MjData, body: int) -> Float[np.ndarray, "4 4"]:
    return frame(data.xmat[body].reshape(3, 3), data.xpos[body])


def geom_frame(data: mujoco.MjData, geom: int) -> Float[np.ndarray, "4 4"]:
    return frame(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom])


def joint_frame(data: mujoco.MjData, joint: int) -> Float[np.ndarray, "4 4"]:
    T_world_joint = np.asarray(trimesh.geometry.align_vectors([0, 0, 1], data.xaxis[joint]))
    return frame(T_world_joint[:3, :3], data.xanchor[joint])


def frame(rotation: Float[np.ndarray, "3 3"], position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def geom_mesh(model: mujoco.MjModel, geom: int) -> TriangleMesh:
    """The triangles of a geom in its own frame: those of the file for a mesh, a fine triangulation of a primitive."""
    kinds = mujoco.mjtGeom
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == kinds.mjGEOM_MESH:
        mesh = model.mesh(model.geom_dataid[geom])
        vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
        return TriangleMesh(vertices.astype(float), model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]].astype(int))
    if kind == kinds.mjGEOM_BOX:
        solid = trimesh.creation.box(extents=2 * size)
    elif kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
        solid = trimesh.creation.icosphere(subdivisions=3)
        solid.apply_scale(size if kind == kinds.mjGEOM_ELLIPSOID else size[0])
    elif kind == kinds.mjGEOM_CYLINDER:
        solid = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=48)
    elif kind == kinds.mjGEOM_CAPSULE:
        solid = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=[32, 32])
        solid.apply_translation(-solid.bounds.mean(axis=0))
    else:
        raise ValueError(f"Geom {geom} is no mesh, box, sphere, ellipsoid, cylinder or capsule.")
    return TriangleMesh(np.array(solid.vertices), np.array(solid.faces))


_WARP_MESHES: dict[int, tuple[TriangleMesh, Any]] = {}


def warp_mesh(surface: TriangleMesh) -> Any:
    """The surface as a bounding volume hierarchy; built once for each surface object."""
    import warp as wp

    if id(surface) not in _WARP_MESHES:
        faces = wp.array(surface.faces.reshape(-1).astype(np.int32), dtype=wp.int32, device="cpu")
        _WARP_MESHES[id(surface)] = (surface, wp.Mesh(warp_vectors(surface.vertices), faces))
    return _WARP_MESHES[id(surface)][1]


def warp_vectors(vectors: Float[np.ndarray, "n 3"]) -> Any:
    import warp as wp

    return wp.array(np.ascontiguousarray(vectors, dtype=np.float32), dtype=wp.vec3, device="cpu")


@cache
def measuring_kernels() -> tuple[Any, Any]:
    """Where rays hit, and how far the nearest triangle is."""
    import warp as wp

    @wp.kernel(module="unique")
    def cast(mesh: wp.uint64, view: wp.vec3, directions: wp.array[wp.vec3], hit: wp.array[wp.float32]):
        i = wp.tid()
        query = wp.mesh_query_ray(mesh, view, directions[i], 10.0)
        hit[i] = wp.where(query.result, query.t, 10.0)

    @wp.kernel(module="unique")
    def nearest(mesh: wp.uint64, points: wp.array[wp.vec3], found: wp.array[wp.float32]):
        i = wp.tid()
        query = wp.mesh_query_point_no_sign(mesh, points[i], 10.0)
        closest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        found[i] = wp.length(points[i] - closest)

    return cast, nearest


FRAME_TOLERANCE = 1e-4
"""Of frames, axes and limits, in metres and radians."""


def assert_same_names(ours: PosedHand, theirs: PosedHand) -> None:
    """Links and joints have the same names, joints the same ranges."""
    assert ours.T_base_link.keys() == theirs.T_base_link.keys()
    assert ours.ranges.keys() == theirs.ranges.keys()
    for name, limits in theirs.ranges.items():
        assert np.allclose(ours.ranges[name], limits, atol=FRAME_TOLERANCE), name


def assert_same_frames(ours: PosedHand, theirs: PosedHand) -> None:
    """Links are in the same places, joints have the same axes, anchors and values."""
    for name, T in theirs.T_base_link.items():
        np.testing.assert_allclose(ours.T_base_link[name], T, atol=FRAME_TOLERANCE, err_msg=name)
    for name, T in theirs.T_base_joint.items():
        np.testing.assert_allclose(ours.T_base_joint[name][:, 2:], T[:, 2:], atol=FRAME_TOLERANCE, err_msg=name)
    assert ours.joints.keys() == theirs.joints.keys()
    for name, value in theirs.joints.items():
        assert abs(ours.joints[name] - value) < FRAME_TOLERANCE, name


def assert_inner_surfaces_agree(ours: PosedHand, theirs: PosedHand, view_points: Float[np.ndarray, "v 3"]) -> None:
    """95 % of each hand's inner surface lies within 5 mm of the other's."""
    for one, other in ((ours, theirs), (theirs, ours)):
        assert np.mean(inner_surface_deviation(one, other, view_points, density=5e4) < 0.005) >= 0.95


def assert_outsides_agree(ours: PosedHand, theirs: PosedHand) -> None:
    """90 % of each hand's surface lies within 8 mm of the other's."""
    for one, other in ((ours, theirs), (theirs, ours)):
        assert np.mean(outer_surface_deviation(one, other) < 0.008) >= 0.9
