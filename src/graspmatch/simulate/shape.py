"""The true shape of a hand's links: MuJoCo takes the convex hull of each mesh, which fills the hollow of a palm."""

from __future__ import annotations

import mujoco
from scipy.spatial import ConvexHull, QhullError

from graspmatch.geometry.mesh import TriangleMesh, face_normals_areas
from graspmatch.gripper.description import Description, geom_mesh
from graspmatch.simulate.convex import convex_parts

PREFIX = "hand/"
"""Of all names that come from the description."""
FULLEST = 5e-4
"""A hull that stands off its mesh by no more than this on average is taken for it [m]."""


def give_true_shapes(spec: mujoco.MjSpec, base: mujoco.MjsBody, description: Description) -> None:
    """Put convex parts in the place of every colliding mesh of the hand that is hollow.

    The first time a description is used, its parts are computed, which can take a minute; then they are cached.
    """
    model = description.model
    for body in base.find_all("body"):
        own = model.body(body.name.removeprefix(PREFIX))
        first, count = int(model.body_geomadr[own.id]), int(model.body_geomnum[own.id])
        for geom, index in zip(list(body.geoms), range(first, first + count), strict=True):
            if not geom.contype or geom.type != mujoco.mjtGeom.mjGEOM_MESH:
                continue
            mesh = geom_mesh(model, index)
            if is_full(mesh):
                continue
            for i, part in enumerate(convex_parts(mesh).parts):
                shape = spec.add_mesh(name=f"{PREFIX}part_{index}_{i}")
                shape.uservert, shape.userface = part.vertices.ravel(), part.faces.ravel()
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_MESH,
                    meshname=shape.name,
                    contype=geom.contype,
                    conaffinity=geom.conaffinity,
                    mass=0,
                )
            geom.contype = geom.conaffinity = 0


def is_full(mesh: TriangleMesh) -> bool:
    """Whether the hull of a mesh is its shape, or it is too flat to have one."""
    try:
        hull = ConvexHull(mesh.vertices)
    except QhullError:
        return True
    import trimesh

    volume = float(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume)
    return hull.volume - abs(volume) <= FULLEST * float(face_normals_areas(mesh)[1].sum())
