"""How faithful convex parts are to the mesh that they stand for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.mesh import TriangleMesh, concatenate, face_normals_areas, sample_surface

Array = np.ndarray

SAMPLES = 20_000
"""On the surface of the parts, and again on that of the mesh."""
SKIN = 1e-4
"""Where another part begins within this distance [m] of a part's surface, the surface is not exposed."""


@dataclass(frozen=True)
class Fidelity:
    """Distances between the parts and the mesh [m]."""

    bulge: float
    """How far the parts reach beyond the mesh: 95th percentile over their exposed surface."""
    largest_bulge: float
    gap: float
    """How far the parts stay short of the mesh: 95th percentile over the surface of the mesh."""
    largest_gap: float


def fidelity(mesh: TriangleMesh, parts: Sequence[TriangleMesh], *, is_open: bool = False) -> Fidelity:
    """Measured on samples of both surfaces. An open mesh has no inside: there, every distance from it is a bulge."""
    rng = np.random.default_rng(0)
    union = concatenate(list(parts))
    points, normals = _samples(union, rng)
    exposed = points[signed_distance(union, points + SKIN * normals) > 0]
    outside = signed_distance(mesh, exposed)
    bulge = np.abs(outside) if is_open else np.maximum(outside, 0)
    gap = np.maximum(signed_distance(union, _samples(mesh, rng)[0]), 0)
    return Fidelity(*_summary(bulge), *_summary(gap))


def signed_distance(mesh: TriangleMesh, points: Float[Array, "n 3"]) -> Float[Array, "n"]:
    """Distance to the surface of a triangle soup [m], negative inside; parts may overlap."""
    import warp as wp

    from graspmatch.kernels import warp_bake
    from graspmatch.kernels.launch import launch

    distance = wp.empty(len(points), dtype=wp.float32, device="cpu")
    device_mesh = wp.Mesh(
        wp.array(mesh.vertices, dtype=wp.vec3, device="cpu"),
        wp.array(mesh.faces.ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=True,
    )
    x = wp.array(points, dtype=wp.vec3, device="cpu")
    launch(warp_bake.mesh_distance, len(points), [device_mesh.id, x], [distance], "cpu")
    return distance.numpy().astype(np.float64)


def _samples(mesh: TriangleMesh, rng: np.random.Generator) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    return sample_surface(mesh, SAMPLES / float(face_normals_areas(mesh)[1].sum()), rng)


def _summary(distances: Float[Array, "n"]) -> tuple[float, float]:
    """95th percentile and maximum; zero where there is nothing."""
    if len(distances) == 0:
        return 0.0, 0.0
    return float(np.percentile(distances, 95)), float(distances.max())
