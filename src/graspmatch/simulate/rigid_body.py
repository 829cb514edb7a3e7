"""An object as physics sees it: convex parts, mass, centre of mass and inertia, in the frame of its mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from graspmatch.errors import GraspmatchError
from graspmatch.geometry.mesh import TriangleMesh, concatenate

Array = np.ndarray

DENSITY = 300.0
"""[kg/m3]: household objects are hollow."""
LIGHTEST, HEAVIEST = 0.05, 0.5
"""[kg]"""


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A rigid object of one density."""

    name: str
    mesh: TriangleMesh
    """What cameras see and pictures show."""
    parts: tuple[TriangleMesh, ...]
    """What touches: convex, closed."""
    bulge: float
    """How far the parts reach beyond the mesh at 95 % of their surface [m]."""
    mass: float
    """[kg]"""
    centre_of_mass: Float[Array, "3"]
    """[m]"""
    inertia: Float[Array, "3 3"]
    """About the centre of mass [kg m2]."""


def rigid_body(
    name: str, mesh: TriangleMesh, parts: tuple[TriangleMesh, ...], *, bulge: float, mass: float | None = None
) -> RigidBody:
    """The object with a given mass [kg], or else of 300 kg/m3 but at least 50 g and at most 500 g.

    Volume and inertia are those of the mesh where it is closed, else of the convex parts.
    """
    import trimesh

    closed = trimesh.Trimesh(mesh.vertices, mesh.faces)
    if not (closed.is_watertight and closed.is_winding_consistent and closed.volume > 0):
        union = concatenate(list(parts))  # a decomposition's parts hardly overlap
        closed = trimesh.Trimesh(union.vertices, union.faces, process=False)
    volume = float(closed.volume)
    if not volume > 0:
        raise GraspmatchError(f"{name} has no volume: its mesh is flat or empty.")
    if mass is not None and not 0 < mass < np.inf:
        raise GraspmatchError(f"The mass of {name} is {mass} kg; it must be positive.")
    mass = float(np.clip(volume * DENSITY, LIGHTEST, HEAVIEST)) if mass is None else float(mass)
    return RigidBody(
        name=name,
        mesh=mesh,
        parts=parts,
        bulge=bulge,
        mass=mass,
        centre_of_mass=np.asarray(closed.center_mass, dtype=float),
        inertia=np.asarray(closed.moment_inertia, dtype=float) * mass / volume,
    )
