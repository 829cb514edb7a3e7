"""Meshes as found -> closed bodies: apart where they are not connected, small holes closed, sheets given a wall."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from graspmatch.geometry.mesh import TriangleMesh, face_normals_areas, turned_outwards

Array = np.ndarray

SMALL_HOLE = 0.05
"""A hole is closed if the patch over it has at most this share of the body's surface; others belong to the object."""
WALL = 0.0015
"""Thickness of the wall behind a sheet [m], at most, and a share of its longest side."""
WALL_SHARE = 0.02


def closed_bodies(mesh: TriangleMesh) -> tuple[list[TriangleMesh], bool]:
    """The closed bodies of a mesh, faces outward; and whether any was a sheet, with an opening that was left open."""
    bodies = [close_small_holes(turned_outwards(body)) for body in connected_bodies(mesh)]
    is_sheet = [len(open_edges(body.faces)) > 0 for body in bodies]
    return [thickened(b) if sheet else b for b, sheet in zip(bodies, is_sheet, strict=True)], any(is_sheet)


def connected_bodies(mesh: TriangleMesh) -> list[TriangleMesh]:
    """The parts of the mesh that share no vertex, in the order of their first faces."""
    a, b, c = mesh.faces.T
    faces = mesh.faces[(a != b) & (b != c) & (c != a)]  # merging near vertices leaves faces that are but an edge
    label = _components(faces, len(mesh.vertices))[faces[:, 0]]
    _, first = np.unique(label, return_index=True)
    return [_compact(mesh.vertices, faces[label == label[i]]) for i in np.sort(first)]


def open_edges(faces: Int[Array, "f 3"]) -> Int[Array, "e 2"]:
    """Directed edges that no other face runs along the other way: the borders of holes."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pairs, index = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    forward = edges[:, 0] < edges[:, 1]
    surplus = np.bincount(index[forward], minlength=len(pairs)) - np.bincount(index[~forward], minlength=len(pairs))
    return np.concatenate(
        [np.repeat(pairs, np.maximum(surplus, 0), axis=0), np.repeat(pairs[:, ::-1], np.maximum(-surplus, 0), axis=0)]
    )


def close_small_holes(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh with a fan of triangles over each small hole, around the middle of its border."""
    border = open_edges(mesh.faces)
    if len(border) == 0:
        return mesh
    hole = _components(border, len(mesh.vertices))[border[:, 0]]
    total = face_normals_areas(mesh)[1].sum()
    vertices, faces = [mesh.vertices], [mesh.faces]
    for label in np.unique(hole):
        edges = border[hole == label]
        middle = mesh.vertices[np.unique(edges)].mean(axis=0)
        tip = sum(len(v) for v in vertices)
        fan = np.column_stack([edges[:, 1], edges[:, 0], np.full(len(edges), tip)])
        patch = TriangleMesh(np.concatenate([*vertices, middle[None]]), fan)
        if face_normals_areas(patch)[1].sum() <= SMALL_HOLE * total:
            vertices.append(middle[None])
            faces.append(fan)
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces))


def thickened(mesh: TriangleMesh) -> TriangleMesh:
    """A closed wall behind an open sheet: the sheet, its offset inwards turned over, and a strip along each border."""
    n = len(mesh.vertices)
    wall = min(WALL, WALL_SHARE * float(np.ptp(mesh.vertices, axis=0).max()))
    inner = mesh.vertices - wall * vertex_normals(mesh)
    a, b = open_edges(mesh.faces).T
    strip = np.concatenate([np.column_stack([b, a, a + n]), np.column_stack([b, a + n, b + n])])
    return TriangleMesh(
        np.concatenate([mesh.vertices, inner]), np.concatenate([mesh.faces, mesh.faces[:, ::-1] + n, strip])
    )


def vertex_normals(mesh: TriangleMesh) -> Float[Array, "v 3"]:
    """Unit normals at the vertices: the mean of the faces around, weighted by area; zero where there is none."""
    normals, areas = face_normals_areas(mesh)
    total = np.zeros_like(mesh.vertices)
    np.add.at(total, mesh.faces.ravel(), np.repeat(normals * areas[:, None], 3, axis=0))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


def _components(links: Int[Array, "m k"], n: int) -> Int[Array, "n"]:
    """Label of the connected component of each of n vertices, where each row of `links` is connected."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    start = np.repeat(links[:, 0], links.shape[1] - 1)
    end = links[:, 1:].ravel()
    return connected_components(coo_array((np.ones(len(start)), (start, end)), shape=(n, n)), directed=False)[1]


def _compact(vertices: Float[Array, "v 3"], faces: Int[Array, "f 3"]) -> TriangleMesh:
    """Those faces, with the vertices that they use."""
    used, index = np.unique(faces, return_inverse=True)
    return TriangleMesh(vertices[used], index.reshape(-1, 3))
