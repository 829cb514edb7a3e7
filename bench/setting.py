"""What benchmarks share: the objects, and where results go."""

from __future__ import annotations

from pathlib import Path

from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import mug

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "bench" / "results"
PAPER_OBJECTS = ROOT / ".." / "shared" / "data" / "objects" / "paper"


def scenes(folder: Path = PAPER_OBJECTS, most: int | None = None) -> dict[str, Scene]:
    """Every object of a folder of NAME/mesh.stl, or the first few; a mug made by code where there is no such folder."""
    files = sorted(folder.glob("*/mesh.stl"))[:most]
    if not files:
        return {"mug": Scene.from_mesh(mug())}
    return {file.parent.name: Scene.from_mesh(file) for file in files}
