"""A mesh -> convex parts, by CoACD (approximate convex decomposition, Wei et al. 2022) where a hull does not do."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.cloud import farthest_along
from graspmatch.geometry.mesh import TriangleMesh, face_normals_areas
from graspmatch.geometry.sphere import fibonacci_directions
from graspmatch.simulate import mend
from graspmatch.simulate.fidelity import fidelity
from graspmatch.types import GraspmatchError

Array = np.ndarray

TOLERANCE = 0.001
"""A hull that bulges no farther than this [m] stands for its body; parts that leave a larger gap are refused."""
CONCAVITY = 0.003
"""What CoACD may leave concave [m], at most, and as a share of the body's longest side."""
CONCAVITY_SHARE = 0.05
MOST_PARTS = 40
"""Of one object; CoACD merges what is more, at the price of a larger bulge."""
FEWEST_PARTS = 4
"""What each body that is not convex may have."""
SPECK = 0.001
"""A body with a smaller share of the whole surface is dropped: scans have hundreds of them, floating around."""
SMALLEST_VOLUME = 1e-12
"""[m3] Slivers below this weigh nothing and have no normal that a physics engine could trust."""
DIRECTIONS = 4000
"""In which the corners of a hull are looked for where it has too many: of a ball of 10 cm it is 0.03 mm short."""


@dataclass(frozen=True)
class CoacdSettings:
    """CoACD's own options, with a search a fifth as long as its default: as good on scans, in half the time."""

    threshold: float
    """Concavity, in units of half the longest side."""
    max_convex_hull: int
    preprocess_mode: Literal["on", "off"] = "off"
    """Remeshing mends anything, but inflates the mesh by half a voxel and takes four times as long."""
    preprocess_resolution: int = 50
    resolution: int = 1000
    mcts_nodes: int = 10
    mcts_iterations: int = 30
    mcts_max_depth: int = 3
    seed: int = 1


def recipe() -> str:
    """All that decides about the parts beside the mesh, for the key of a cache."""
    knobs = (TOLERANCE, CONCAVITY, CONCAVITY_SHARE, MOST_PARTS, FEWEST_PARTS, SPECK, SMALLEST_VOLUME, DIRECTIONS)
    return f"coacd {version('coacd')} {CoacdSettings(0, 0)} {knobs} {(mend.SMALL_HOLE, mend.WALL, mend.WALL_SHARE)}"


def decompose(bodies: list[TriangleMesh]) -> tuple[TriangleMesh, ...]:
    """Convex parts of closed bodies; a body that is nearly convex becomes its hull."""
    areas = np.array([float(face_normals_areas(body)[1].sum()) for body in bodies])
    shares = areas / areas.sum()
    parts = [
        part
        for body, share in zip(bodies, shares, strict=True)
        if share > SPECK
        for part in _body_parts(body, max(round(MOST_PARTS * share), FEWEST_PARTS))
    ]
    if not parts:
        raise GraspmatchError("The mesh has no volume, so it cannot be simulated: it is flat, or a line.")
    return tuple(parts)


def convex_hull(points: Float[Array, "n 3"]) -> TriangleMesh | None:
    """The closed hull of points, faces outward; None if they have no volume.

    Finely divided flat faces have points that lie in a row, between which Qhull leaves slivers and so no closed hull;
    then that of the points that go farthest along many directions, none of which is within a face, stands for it.
    """
    return _closed_hull(points) or _closed_hull(points[farthest_along(fibonacci_directions(DIRECTIONS), points)])


def _closed_hull(points: Float[Array, "n 3"]) -> TriangleMesh | None:
    """As Qhull finds it; None if it is flat or not closed."""
    import trimesh
    from scipy.spatial import QhullError

    try:
        hull = trimesh.convex.convex_hull(points)
    except (QhullError, ValueError):  # flat, too few, or not finite
        return None
    if not hull.is_watertight or not hull.volume > SMALLEST_VOLUME:
        return None
    return TriangleMesh(np.array(hull.vertices, dtype=np.float64), np.array(hull.faces, dtype=np.int64))


def settings_for(body: TriangleMesh, most_parts: int) -> CoacdSettings:
    """The concavity that a body of its size may keep."""
    longest = float(np.ptp(body.vertices, axis=0).max())
    concavity = min(CONCAVITY, CONCAVITY_SHARE * longest)
    return CoacdSettings(threshold=concavity / (longest / 2), max_convex_hull=most_parts)


def _body_parts(body: TriangleMesh, most_parts: int) -> list[TriangleMesh]:
    """The hull where it does, else CoACD's parts: of the mesh as it is, or remeshed where that leaves gaps."""
    hull = convex_hull(body.vertices)
    if hull is None:
        return []
    if fidelity(body, [hull]).largest_bulge <= TOLERANCE:
        return [hull]
    settings = settings_for(body, most_parts)
    parts = run_coacd(body, settings)
    if not parts or fidelity(body, parts).largest_gap > TOLERANCE:
        parts = run_coacd(body, replace(settings, preprocess_mode="on")) or parts
    if not parts:
        raise GraspmatchError(
            "CoACD could not decompose the mesh into convex parts. Repair the mesh, or put its convex parts as "
            "STL files into a folder 'convex' beside it."
        )
    return parts


def run_coacd(body: TriangleMesh, settings: CoacdSettings) -> list[TriangleMesh]:
    """The hulls that CoACD finds, in its order; none where it fails."""
    with tempfile.TemporaryDirectory(prefix="graspmatch-") as name:
        folder = Path(name)
        np.savez(folder / "mesh.npz", vertices=body.vertices, faces=body.faces.astype(np.int32))
        (folder / "settings.json").write_text(json.dumps(asdict(settings)))
        command = [sys.executable, "-P", "-m", "graspmatch.simulate.coacd_process", name]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        subprocess.run(command, env=environment, capture_output=True)
        if not (folder / "parts.npz").is_file():
            return []
        with np.load(folder / "parts.npz") as file:
            parts = np.split(file["vertices"], np.cumsum(file["sizes"])[:-1])
    hulls = [convex_hull(part) for part in parts]
    return [hull for hull in hulls if hull is not None]
