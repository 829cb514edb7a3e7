"""Triangle meshes as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class TriangleMesh:
    """A triangle soup: watertight or not, one part or many."""

    vertices: Float[np.ndarray, "v 3"]
    """Vertex positions [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex indices, counter-clockwise seen from outside."""


def concatenate(meshes: list[TriangleMesh]) -> TriangleMesh:
    """All triangles in one soup; an empty list gives an empty mesh."""
    if not meshes:
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = [m.faces + offset for m, offset in zip(meshes, offsets, strict=True)]
    return TriangleMesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces))


def transformed(mesh: TriangleMesh, T_a_b: Float[np.ndarray, "4 4"]) -> TriangleMesh:
    """The mesh of frame b, expressed in frame a."""
    return TriangleMesh(mesh.vertices @ T_a_b[:3, :3].T + T_a_b[:3, 3], mesh.faces)


def turned_outwards(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh, its faces turned over where it encloses a negative volume: some exporters write them inside out."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - mesh.vertices.mean(axis=0), 1, 0)
    volume = np.sum(a * np.cross(b, c))
    return TriangleMesh(mesh.vertices, mesh.faces[:, ::-1]) if volume < 0 else mesh


def face_normals_areas(mesh: TriangleMesh) -> tuple[Float[np.ndarray, "f 3"], Float[np.ndarray, "f"]]:
    """Unit normals (zero where degenerate) and areas [m2] of the triangles."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    cross = np.cross(b - a, c - a)
    norm = np.linalg.norm(cross, axis=-1)
    return cross / np.maximum(norm, 1e-300)[:, None], norm / 2


def sample_surface(
    mesh: TriangleMesh, density: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points spread evenly over the surface, `density` per square metre, and their outward normals.

    Low-discrepancy along the accumulated area, so that few points already cover every triangle.
    """
    normals, areas = face_normals_areas(mesh)
    cumulative = np.cumsum(areas)
    n = max(int(np.ceil(cumulative[-1] * density)), 1)
    index = np.searchsorted(cumulative, (np.arange(n) + rng.random(n)) / n * cumulative[-1])
    index = np.minimum(index, len(areas) - 1)
    u, v = rng.random((2, n, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[index]], 1, 0)
    return a + u * (b - a) + v * (c - a), normals[index]
