"""How far guessed surfaces can be trusted: how many grasps hold, by how far from what was seen their fingers touch.

    python bench/guesses.py --output bench/results

Objects that the planner was not measured on stand alone or lie in piles, and are seen once each by the simulated camera
with all its errors. Several grasps of each plan are lifted, not only the best. Objects that no hand of this width can
hold do not count.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from graspmatch.apps.bench.glimpse import glimpse_of, scene_of, scenes_of
from graspmatch.apps.bench.machine import machine, usable_cores
from graspmatch.apps.bench.objects import ObjectSource, folder_sources
from graspmatch.apps.bench.piles import at_which
from graspmatch.apps.bench.processes import in_processes
from graspmatch.apps.bench.trials import random_place, stage
from graspmatch.config import LiftConfig, PlannerConfig, ViewConfig
from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import write_atomically
from graspmatch.geometry.cloud import narrowest_width
from graspmatch.geometry.mesh import transformed
from graspmatch.gripper.kinematics import load_hand
from graspmatch.gripper.load import load_gripper
from graspmatch.gripper.zoo import card_path
from graspmatch.planner.advice import is_too_wide
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.grade import displaced, draw_trials, sure_of
from graspmatch.planner.hold import hold, touchable
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.simulate.judge import try_grasp
from graspmatch.simulate.pile import drop, try_in_pile
from graspmatch.types import GraspSet, Gripper
from setting import PAPER_OBJECTS, RESULTS

Array = np.ndarray

SETS = tuple(PAPER_OBJECTS.with_name(name) for name in ("contactdb", "ycb"))
RANKS = (0, 1, 2, 4, 7, 11)
"""Those of a plan that are tried."""
LEAST_SCORE = 0.1
"""Grasps that the planner itself has given up on say nothing of what it thinks is there."""
BORDERS = (0.0, 0.008, 0.016, 0.024, 0.035, 1.0)
"""Of the rows, how far from what was seen the fingers touch [m]."""


@dataclass(frozen=True)
class Work:
    """What one process does at once: views of one object alone, or of one pile of several."""

    sources: tuple[ObjectSource, ...]
    hand: str
    views: int


@dataclass(frozen=True)
class Tried:
    """n grasps of objects that stand alone, or lie in a pile."""

    in_pile: Bool[Array, "n"]
    beyond: Float[Array, "n"]
    """How far from what was seen a finger touches, the mean over the planner's trials [m]."""
    score: Float[Array, "n"]
    """Of the planner, without what it takes off for that."""
    held: Bool[Array, "n"]


def tried(work: Work) -> Tried:
    """The grasps of one object or pile."""
    return _tried_in_pile(work) if len(work.sources) > 1 else _tried_alone(work)


def _tried_alone(work: Work) -> Tried:
    config = LiftConfig()
    source = work.sources[0]
    settled, world, gripper = stage(source, work.hand, None, config)
    if settled.topples or is_too_wide(narrowest_width(settled.target.mesh.vertices), gripper):
        return joined([])
    found = []
    for trial in range(work.views):
        rng = np.random.default_rng([zlib.crc32(source.name.encode()), trial])
        T = random_place(rng) @ settled.T_world_object
        mesh = transformed(settled.target.mesh, T)
        try:
            scene = scene_of(glimpse_of([mesh], T, ViewConfig(), rng))
        except GraspmatchError:  # nothing that could be told from the table
            continue
        grasps = plan(scene, gripper, PlannerConfig(seed=trial))
        ranks = [rank for rank in RANKS if rank < len(grasps)]
        held = [try_grasp(world, grasps, rank, T, config).held for rank in ranks]
        found.append(_figures(scene, gripper, grasps, ranks, held, in_pile=False))
    return joined(found)


def _tried_in_pile(work: Work) -> Tried:
    config, seed = LiftConfig(), zlib.crc32(" ".join(source.name for source in work.sources).encode())
    rng = np.random.default_rng(seed)
    try:
        pile = drop([source.load(mass=config.mass) for source in work.sources], config, rng)
        meshes = [transformed(body.mesh, T) for body, T in zip(pile.objects, pile.T_world_object, strict=True)]
        scenes = scenes_of(glimpse_of(meshes, pile.T_world_object[0], ViewConfig(distance=0.7), rng))
    except GraspmatchError:  # it never comes to rest, or nothing of it is in the image
        return joined([])
    hand, gripper = load_hand(card_path(work.hand), None), load_gripper(work.hand)
    found = []
    for scene in scenes:
        grasps = plan(scene, gripper, PlannerConfig(seed=seed))
        ranks, held = [], []
        for rank in (rank for rank in RANKS if rank < len(grasps)):
            index = at_which(grasps, gripper, meshes, rank)
            if is_too_wide(narrowest_width(pile.objects[index].mesh.vertices), gripper):
                continue
            way = grasps.T_world_pregrasp[rank], grasps.T_world_gripper[rank], grasps.pregrasp_joints[rank]
            ranks.append(rank)
            held.append(try_in_pile(pile, index, hand, *way, config)[0].held)
        found.append(_figures(scene, gripper, grasps, ranks, held, in_pile=True))
    return joined(found)


def _figures(
    scene: Scene, gripper: Gripper, grasps: GraspSet, ranks: Sequence[int], held: Sequence[bool], *, in_pile: bool
) -> Tried:
    config, n = PlannerConfig().grip, len(ranks)
    if not n:
        return joined([])
    candidates = Candidates(grasps.preshape[ranks], grasps.T_world_gripper[ranks])
    trials = draw_trials(config, 0, is_exact=False)
    target = touchable(scene, config.points, "cpu")
    every = displaced(candidates, trials.error)
    beyond = hold(every, np.tile(trials.friction, n), target, gripper, config, "cpu").beyond.reshape(n, -1)
    score = grasps.score[ranks] / np.maximum(sure_of(beyond).mean(axis=1), 1e-3)
    return Tried(np.full(n, in_pile), beyond.mean(axis=1), np.minimum(score, 1.0), np.array(held))


def joined(parts: Sequence[Tried]) -> Tried:
    """One after the other."""
    none = Tried(np.zeros(0, dtype=bool), np.zeros(0), np.zeros(0), np.zeros(0, dtype=bool))
    return Tried(**{name: np.concatenate([getattr(part, name) for part in (none, *parts)]) for name in vars(none)})


def table(found: Tried) -> str:
    """Rows by distance, for objects alone and in piles."""
    lines = [
        "| fingers touch beyond what was seen | alone: held | score without that | in piles: held | score without that "
        "| counts as right |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for low, high in pairwise(BORDERS):
        inside = (found.beyond >= low) & (found.beyond < high) & (found.score >= LEAST_SCORE)
        name = f"{1000 * low:.0f} to {1000 * high:.0f} mm" if high < 1 else f"more than {1000 * low:.0f} mm"
        cells = [cell for in_pile in (False, True) for cell in _cells(found, inside & (found.in_pile == in_pile))]
        sure = f"{100 * sure_of(found.beyond[inside]).mean():.0f} %" if inside.any() else "-"
        lines.append(f"| {' | '.join([name, *cells, sure])} |")
    return "\n".join(lines)


def _cells(found: Tried, which: Bool[Array, "n"]) -> list[str]:
    if not which.any():
        return ["-", "-"]
    held = found.held[which]
    return [f"{100 * held.mean():.0f} % ({held.sum()}/{len(held)})", f"{found.score[which].mean():.2f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gripper", default="franka_hand")
    parser.add_argument("--objects", type=Path, nargs="+", default=SETS)
    parser.add_argument("--views", type=int, default=4, help="of each object alone")
    parser.add_argument("--piles", type=int, default=40)
    parser.add_argument("--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    sources = [source for folder in arguments.objects for source in folder_sources(folder)]
    rng = np.random.default_rng(0)
    drawn = [rng.choice(len(sources), 5, replace=False) for _ in range(arguments.piles)]
    works = [Work((source,), arguments.gripper, arguments.views) for source in sources]
    works += [Work(tuple(sources[int(i)] for i in indices), arguments.gripper, 1) for indices in drawn]
    found = joined(list(in_processes(tried, works, processes=usable_cores())))
    where = ", ".join(f"{name} {value}" for name, value in machine().items())
    title = f"# Grasps on guessed surfaces: {arguments.gripper}"
    about = (
        f"{len(found.held)} grasps of {len(sources)} objects ({', '.join(path.name for path in arguments.objects)}), "
        f"{arguments.views} views of each alone and {arguments.piles} piles of five, as far as they come to rest; "
        f"grasps with a score of {LEAST_SCORE} or more. {where}."
    )
    text = f"{title}\n\n{table(found)}\n\n{about}\n"
    path = arguments.output / f"guesses-{arguments.gripper}.md"
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"))
    print(text)
    print(f"Wrote {path}")


if __name__ == "__main__":
    main()
