"""What each guess of the far side gives: error of the centre of mass, and where the guessed surface is.

Objects stand where they settle, at random turns, and are seen once each by the simulated camera with all its errors.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from scipy.spatial import KDTree

from graspmatch.apps.bench.glimpse import glimpse_of, scene_of
from graspmatch.apps.bench.machine import machine
from graspmatch.apps.bench.objects import ObjectSource, folder_sources
from graspmatch.apps.bench.trials import random_place
from graspmatch.config import ViewConfig
from graspmatch.geometry.mesh import sample_surface, transformed
from graspmatch.geometry.se3 import apply
from graspmatch.scene.captured import HAND_REACH
from graspmatch.scene.complete import GUESSES, Guess, far_side
from graspmatch.scene.scene import Scene
from graspmatch.scene.sight import sight_lines
from graspmatch.simulate.settle import settle

Array = np.ndarray

OBJECTS = Path(__file__).parents[1] / ".." / "shared" / "data" / "objects"
DENSITY = 2e5
"""Samples of the true surface, per square metre."""
CLOSE = 0.006
"""Guesses so near to the true surface are good, and true surface so near to a point is known [m]."""
FOOT = 0.006
"""Nobody asks for what is lower above the table [m]."""


@dataclass(frozen=True)
class Seen:
    """One view, and the truth."""

    scene: Scene
    surface: Float[Array, "n 3"]
    centre: Float[Array, "3"]


@dataclass(frozen=True)
class Quality:
    """What some guesses come to."""

    centre_error: float
    """[m]"""
    good: float
    """Share of the guessed points that are near the true surface."""
    known: float
    """Share of the hidden surface that has a point near it."""


def views_of(source: ObjectSource, count: int, view: ViewConfig) -> list[Seen]:
    """Views of one object at random turns; none of one that does not stand."""
    rest = settle(source.load(), 0.6)
    if rest.topples:
        return []
    found = []
    for trial in range(count):
        rng = np.random.default_rng([zlib.crc32(source.name.encode()), trial])
        T = random_place(rng) @ rest.T_world_object
        mesh = transformed(rest.target.mesh, T)
        scene = scene_of(glimpse_of([mesh], T, view, rng))
        surface = sample_surface(mesh, DENSITY, rng)[0]
        found.append(Seen(scene, surface[surface[:, 2] > FOOT], apply(T, rest.target.centre_of_mass[None])[0]))
    return found


def quality(seen: Seen, guesses: Sequence[Guess]) -> Quality:
    """Of the far side by some of the guesses; without any, of what was seen."""
    scene = seen.scene
    assert scene.view is not None
    assert scene.table is not None
    lines = sight_lines(scene.view, scene.target.points, 2 * HAND_REACH)
    assert lines is not None
    found = far_side(scene.target, scene.table, lines, guesses=guesses) if guesses else None
    centre = scene.centre_of_mass if found is None else found.centre_of_mass
    guessed = np.zeros((0, 3)) if found is None else found.guessed.points
    hidden = seen.surface[KDTree(scene.target.points).query(seen.surface)[0] > CLOSE]
    points = np.concatenate([scene.target.points, guessed])
    return Quality(
        centre_error=float(np.linalg.norm(centre - seen.centre)),
        good=float(np.mean(KDTree(seen.surface).query(guessed)[0] < CLOSE)) if len(guessed) else float("nan"),
        known=float(np.mean(KDTree(points).query(hidden)[0] < CLOSE)) if len(hidden) else float("nan"),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=Path, nargs="+", default=[OBJECTS / "paper"])
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--elevation", type=float, default=45.0, help="of the camera [degrees]")
    arguments = parser.parse_args()
    view = ViewConfig(elevation=float(np.radians(arguments.elevation)), completes=False)
    sources = [source for folder in arguments.objects for source in folder_sources(folder)]
    seen = [each for source in sources for each in views_of(source, arguments.views, view)]

    table = Table(title=f"Far sides guessed from {len(seen)} views of {len(sources)} objects")
    for column in ("guesses", "centre of mass: median mm", "90 % mm", "good guesses", "hidden surface known"):
        table.add_column(column, justify="left" if column == "guesses" else "right")
    for count in range(len(GUESSES) + 1):
        found = [quality(each, GUESSES[:count]) for each in seen]
        errors = 1000 * np.array([each.centre_error for each in found])
        good, known = (
            np.nanmean([getattr(each, name) for each in found]) if count else 0.0 for name in ("good", "known")
        )
        name = f"+ {GUESSES[count - 1]}" if count else "none: what was seen"
        shares = [f"{100 * share:.0f} %" if count else "-" for share in (good, known)]
        table.add_row(name, f"{np.median(errors):.1f}", f"{np.percentile(errors, 90):.1f}", *shares)
    console = Console(width=120)
    console.print(table)
    console.print(f"{arguments.elevation:.0f} degrees above the table, {machine()}.")


if __name__ == "__main__":
    main()
