"""How fast the viewer is with 50,000 points and 200 grasps: what the server does for each move of a control.

python bench/viewer.py
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from graspmatch.apps.hand import load_hand
from graspmatch.apps.speech import Speech
from graspmatch.apps.viewer.command import page_of
from graspmatch.apps.viewer.page import Page
from graspmatch.apps.viewer.shown import shown_of
from graspmatch.config import PlannerConfig
from graspmatch.geometry.mesh import face_normals_areas, sample_surface
from graspmatch.planner.plan import plan
from graspmatch.planner.recording import Recording
from graspmatch.scene.household import OBJECTS
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet, PointCloud

POINTS, GRASPS = 50_000, 200
REPEATS = 20


def main() -> None:
    """Print a line for each thing that is measured."""
    for name in ("franka_hand", "robotiq_2f85", "barrett_bh282"):
        hand, scene = load_hand(name, None, PlannerConfig(), Speech(quiet=True)), dense_scene()
        recording, config = Recording(), PlannerConfig()
        grasps = many_grasps(plan(scene, hand.gripper, config, recording=recording))
        begin = time.perf_counter()
        shown = shown_of(hand, grasps, scene, recording, "auto")
        ready = time.perf_counter()
        with page_of(shown, config, port=8800) as page:
            print(f"{name:16s} {'contacts':15s} {1000 * (ready - begin):8.1f} ms")
            print(f"{name:16s} {'page':15s} {1000 * (time.perf_counter() - ready):8.1f} ms")
            measure(page, name)


def dense_scene() -> Scene:
    """A bottle as a cloud of so many points."""
    scene = Scene.from_mesh(OBJECTS["bottle"]().mesh)
    assert scene.mesh is not None
    area = float(face_normals_areas(scene.mesh)[1].sum())
    points, normals = sample_surface(scene.mesh, 1.2 * POINTS / area, np.random.default_rng(0))
    return replace(scene, target=PointCloud(points[:POINTS], normals[:POINTS]))


def many_grasps(grasps: GraspSet) -> GraspSet:
    """So many grasps: those that there are, again and again."""
    index = np.resize(np.arange(len(grasps)), GRASPS)
    return replace(grasps, **{k: v[index] for k, v in vars(grasps).items() if isinstance(v, np.ndarray)})


def measure(page: Page, name: str) -> None:
    """Move each control many times."""
    grasp, moment, also, iteration = (getattr(page.panel, c) for c in ("grasp", "moment", "also", "iteration"))
    steps = iter(range(10**6))
    took("next grasp", name, lambda: setattr(grasp, "value", 1 + next(steps) % GRASPS), REPEATS)
    took("next moment", name, lambda: setattr(moment, "value", (next(steps) % 100) / 100), REPEATS)
    took("200 hands", name, lambda: setattr(also, "value", GRASPS - next(steps) % 2), REPEATS)
    page.panel.particles.value = True
    took("next iteration", name, lambda: setattr(iteration, "value", next(steps) % 40), REPEATS)


def took(what: str, name: str, do: Callable[[], object], repeats: int) -> None:
    """Print the median time of a few calls."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        do()
        times.append(time.perf_counter() - begin)
    print(f"{name:16s} {what:15s} {1000 * float(np.median(times)):8.1f} ms")


if __name__ == "__main__":
    main()
