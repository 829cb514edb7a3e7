"""CoACD in a process of its own: it prints, it aborts its process where it fails, and it brings its own OpenMP.

Run as `python -m graspmatch.simulate.coacd_process FOLDER`; it reads `mesh.npz` and `settings.json` of the folder
and writes `parts.npz`: the vertices of all hulls, and how many belong to each.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np


def main(folder: Path) -> None:
    """Decompose the mesh of the folder."""
    import coacd

    with np.load(folder / "mesh.npz") as mesh:
        vertices, faces = mesh["vertices"], mesh["faces"]
    settings = json.loads((folder / "settings.json").read_text())
    coacd.set_log_level("off")
    parts = [vertices for vertices, _ in coacd.run_coacd(coacd.Mesh(vertices, faces), **settings)]
    np.savez(folder / "parts.npz", vertices=np.concatenate(parts), sizes=np.array([len(part) for part in parts]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
