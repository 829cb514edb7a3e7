"""Several objects on one table: grasps for each, and in which order to pick them.

What stands on another goes first; then comes what is grasped most surely, and of equals what has most room around it.
What cannot be grasped while its neighbours stand there is planned for again without those that were picked before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from graspmatch.config import PlannerConfig
from graspmatch.geometry.thin import thinned
from graspmatch.planner.many import plan_many
from graspmatch.planner.path import Reach
from graspmatch.planner.plan import plan
from graspmatch.scene.scene import Scene
from graspmatch.scene.stacked import stands_on
from graspmatch.types import GraspSet, Gripper, PointCloud

Array = np.ndarray

ALIKE = 0.1
"""Grasps whose confidence is in the same step of this count as equally sure."""
POINTS = 1000
"""Objects are compared by about so many points each."""
PICKED = 0.004
"""Obstacle points nearer to a picked object than this are gone with it [m]."""


@dataclass(frozen=True)
class Pick:
    """One object in the order of picking."""

    number: int
    scene: Scene
    """Without the objects that were picked before, where it was planned for again."""
    grasps: GraspSet
    """Best first; of length zero where it cannot be grasped."""
    room: float
    """Distance to the nearest other thing [m], infinite where there is none."""
    reason: str
    """Why it comes here, as text."""


@dataclass
class _Table:
    """What stands there still, as it is picked one by one."""

    scenes: dict[int, Scene]
    found: dict[int, GraspSet]
    clouds: dict[int, Float[Array, "_ 3"]]
    above: dict[int, set[int]]
    """What stands on each."""
    left: list[int]
    picks: list[Pick]
    tried: dict[int, int]
    """For how many picked objects each was last planned."""


def plan_all(
    scenes: Mapping[int, Scene], gripper: Gripper, config: PlannerConfig | None = None, *, reach: Reach | None = None
) -> tuple[Pick, ...]:
    """Grasps for every object of one view, by its number, in the order in which they should be picked.

    Objects without any grasp are at the end, with an empty set that explains itself.
    """
    config = config or PlannerConfig()
    found = dict(zip(scenes, plan_many(list(scenes.values()), gripper, config, reach=reach), strict=True))
    clouds = {number: thinned(scene.seen_points, POINTS) for number, scene in scenes.items()}
    above = {number: _standing_on(number, scenes[number], clouds) for number in scenes}
    table = _Table(dict(scenes), found, clouds, above, list(scenes), [], dict.fromkeys(scenes, 0))
    while table.left:
        able = [number for number in table.left if len(table.found[number]) and not _load(number, table)]
        if able:
            _pick(able, table)
            continue
        again = [n for n in table.left if table.tried[n] < len(table.picks) and not _load(n, table)]
        if not again:
            break
        for number in again:
            _clear(number, table)
            table.found[number] = plan(table.scenes[number], gripper, config, reach=reach)
    return (*table.picks, *(_leftover(number, table) for number in table.left))


def _pick(able: list[int], table: _Table) -> None:
    """The next of those that can be picked: the surest, then the freest."""
    room = {number: _room(number, table) for number in able}
    steps = {number: int(float(table.found[number].score[0]) / ALIKE) for number in able}
    number = min(able, key=lambda n: (-steps[n], -room[n], n))
    grasps = table.found[number]
    reasons = [f"confidence {grasps.score[0]:.2f}"]
    on = [other for other in table.left if number in table.above[other]]
    if on:
        reasons.insert(0, f"stands on {_listed(on)}")
    rivals = [n for n in able if n != number]
    if rivals and steps[number] > max(steps[n] for n in rivals):
        reasons.insert(0, "surest of those that can be picked")
    elif rivals and room[number] > max(room[n] for n in rivals):
        reasons.insert(0, "as sure as others, with more room around it")
    if table.tried[number]:
        gone = _listed([pick.number for pick in table.picks[: table.tried[number]]])
        reasons.append(f"planned without {gone}")
    reasons.append(f"{1000 * room[number]:.0f} mm to the next thing" if np.isfinite(room[number]) else "stands alone")
    table.picks.append(Pick(number, table.scenes[number], grasps, room[number], ", ".join(reasons)))
    table.left.remove(number)


def _clear(number: int, table: _Table) -> None:
    """Take what was picked out of the way of an object."""
    from scipy.spatial import KDTree

    scene = table.scenes[number]
    for pick in table.picks[table.tried[number] :]:
        points = scene.obstacles.points
        if len(points):
            stays = KDTree(pick.scene.target.points).query(points, distance_upper_bound=PICKED)[0] >= PICKED
            hidden = None if scene.is_hidden is None else scene.is_hidden[stays]
            scene = replace(scene, obstacles=PointCloud(points[stays]), is_hidden=hidden)
    table.scenes[number], table.tried[number] = scene, len(table.picks)


def _leftover(number: int, table: _Table) -> Pick:
    """An object that stays where it is, and why."""
    load = _load(number, table)
    reason = f"under {_listed(sorted(load))}, which cannot be picked" if load else "no grasp was found"
    return Pick(number, table.scenes[number], table.found[number], _room(number, table), reason)


def _standing_on(number: int, scene: Scene, clouds: Mapping[int, Float[Array, "_ 3"]]) -> set[int]:
    """The objects that stand on this one."""
    if scene.table is None:
        return set()
    own = clouds[number]
    return {other for other, cloud in clouds.items() if other != number and stands_on(cloud, own, scene.table)}


def _load(number: int, table: _Table) -> set[int]:
    """What stands on it still."""
    return table.above[number] & set(table.left)


def _room(number: int, table: _Table) -> float:
    """Distance to what is nearest of all that stands there still [m]."""
    from scipy.spatial import KDTree

    others = [table.clouds[n] for n in table.left if n != number]
    if not others:
        return np.inf
    return float(KDTree(np.concatenate(others)).query(table.clouds[number])[0].min())


def _listed(numbers: list[int]) -> str:
    return " and ".join(str(number) for number in numbers)
