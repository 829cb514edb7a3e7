"""The best grasps opened for room, then moved a little, as long as they get surer and stay free: hands get centred,
contacts flush."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

from graspmatch.config import PlannerConfig
from graspmatch.geometry import se3
from graspmatch.planner.avoid import Space, point_clearance, table_clearance_of_way, wider_preshapes
from graspmatch.planner.candidates import Candidates, Closed, Free, Graded
from graspmatch.planner.close import contact_joints, meet_object
from graspmatch.planner.grade import Trials, clear_share, draw_trials, grade, pooled, restood, retried
from graspmatch.planner.hold import Touchable, touchable
from graspmatch.planner.match import Problem, measure
from graspmatch.planner.path import Reach, Way, is_executable, way_of
from graspmatch.planner.tally import Tally
from graspmatch.scene.scene import Scene
from graspmatch.types import Gripper

Array = np.ndarray
C = TypeVar("C", bound=Candidates)

HARDLY_SURER = 0.99
"""A search ends where one of its grasps is as sure as this: no step makes it much surer."""
CLEAR_ENOUGH = 0.99
"""Share of the wanted clearance that counts as it."""


@dataclass(frozen=True)
class Judge:
    """All that is needed to judge a pose: the hand, and what was made of the scene."""

    gripper: Gripper
    space: Space
    problem: Problem
    target: Touchable
    way: Way
    trials: Trials
    config: PlannerConfig
    device: str

    def grade(
        self,
        closed: Closed,
        trials: slice,
        standing: Float[Array, "n"] | None = None,
        share: Float[Array, "n"] | None = None,
    ) -> Graded:
        """Loss of grasps, and how sure they are after some of the trials."""
        error, loss = measure(Candidates(closed.matched_preshape, closed.T_world_gripper), self.problem)
        some, config = self.trials[trials], self.config.grip
        return grade(closed, error, loss, some, self.space, self.target, config, standing, share)

    def retried(self, graded: Graded, trials: slice) -> Graded:
        """How sure the same grasps are after some of the trials."""
        return retried(graded, self.trials[trials], self.target, self.gripper, self.config.grip, self.device)

    def restood(self, graded: Graded) -> Graded:
        """The same grasps with standing margins of their own."""
        return restood(graded, self.trials, self.target, self.gripper, self.config.grip, self.device)

    @property
    def first(self) -> slice:
        """The trials of all candidates."""
        return slice(self.config.grip.first_trials)


def judge_of(
    scene: Scene,
    gripper: Gripper,
    space: Space,
    problem: Problem,
    config: PlannerConfig,
    device: str,
    reach: Reach | None = None,
) -> Judge:
    """What judging needs, made once for a plan."""
    target = touchable(scene, config.grip.points, device)
    way = way_of(scene, space, config, reach)
    trials = draw_trials(config.grip, config.seed, is_exact=scene.mesh is not None)
    return Judge(gripper, space, problem, target, way, trials, config, device)


def roomiest(closed: Closed, judge: Judge) -> tuple[Closed, Float[Array, "n"]]:
    """Each candidate in the preshape, its own or a wider one, in which the hand most often meets nothing on its
    way, and how often that is."""
    tried, origin = opened(closed, judge)
    own, share = (clear_share(some, judge.trials, judge.space) for some in (closed, tried))
    better = np.flatnonzero(share > own[origin])
    found, index = closing_on(*free_of(tried.select(better), better, judge), judge)
    owner = np.concatenate([np.arange(len(closed)), origin[index]])
    both = np.concatenate([own, share[index]])
    best = best_of_each(both, owner, 1)
    return joined(closed, found).select(best), both[best]


def refine(graded: Graded, judge: Judge) -> Graded:
    """Confirm the surest; where none of them is sure enough, search around them and confirm those that then lead."""
    config = judge.config.refining
    graded = confirm(graded, judge)
    best = np.argsort(-graded.sureness, kind="stable")[: config.count]
    if not len(best) or not config.rounds or graded.sureness[best[0]] >= config.enough:
        return graded
    return confirm(search(graded, best, judge), judge)


def search(graded: Graded, best: Int[Array, "k"], judge: Judge) -> Graded:
    """All candidates, some replaced by the surest of their neighbours that are free and close on the object.

    Coordinate search: a step both ways along and about each axis of the hand through its tool centre point; steps are
    halved where none of them helps. Every pose is judged under the same trials; one trial tells which need all.
    """
    config = judge.config.refining
    few, others = slice(config.trials), slice(config.trials, None)
    current, scale = judge.retried(graded.select(best), few), np.ones(len(best))
    has_moved = np.zeros(len(best), dtype=bool)
    for _ in range(config.rounds):
        if current.sureness.max() >= HARDLY_SURER:
            break
        tried, origin = neighbours(current, scale, judge)
        tried, origin = free_of(tried, origin, judge)
        share = clear_share(tried, judge.trials, judge.space)
        may_help = np.flatnonzero(share > current.sureness[origin])  # none is surer than that
        closed, index = closing_on(tried.select(may_help), may_help, judge)
        origin = origin[index]
        found = judge.grade(closed, slice(1), current.standing[origin], share[index])
        contend = best_of_each(found.sureness, origin, config.contenders)
        found, origin = found.select(contend), origin[contend]
        if config.trials > 1:
            found = pooled(found, judge.retried(found, slice(1, config.trials)))
        current, improved = surest(current, found, origin)
        scale = np.where(improved, scale, scale / 2)
        has_moved |= improved
    moved = np.flatnonzero(has_moved)
    if not len(moved):
        return graded
    final = judge.restood(current.select(moved))
    if config.trials < judge.config.grip.trials:
        final = pooled(final, judge.retried(final, others))
    refined, _ = surest(graded.select(best[moved]), final, np.arange(len(moved)))
    return put(graded, best[moved], refined)


def confirm(graded: Graded, judge: Judge) -> Graded:
    """All candidates, those that lead after all trials: the surest after a few are often the luckiest, too.

    Those that come to lead as others fall behind are tried as often, until the leaders are the same.
    """
    config = judge.config.grip
    others = slice(config.first_trials, config.trials)
    while True:
        leaders = np.argsort(-graded.sureness, kind="stable")[: config.leaders]
        todo = np.sort(leaders[graded.tries[leaders] < config.trials])
        if not len(todo):
            break
        chosen = graded.select(todo)
        graded = put(graded, todo, pooled(chosen, judge.retried(chosen, others)))
    return graded


def neighbours(graded: Graded, scale: Float[Array, "n"], judge: Judge) -> tuple[Graded, Int[Array, "m"]]:
    """Twelve poses around each candidate, and which candidate each is of."""
    n, config = len(graded), judge.config.refining
    signs = np.concatenate([np.eye(6), -np.eye(6)])
    origin = np.repeat(np.arange(n), len(signs))
    steps = np.tile(signs, (n, 1)) * scale[origin, None]
    turn = se3.rotation_exp(config.angle * steps[:, 3:])
    move = se3.about(judge.gripper.tool_centre_point, se3.from_parts(turn, config.step * steps[:, :3]))
    tried = graded.select(origin)
    return replace(tried, T_world_gripper=tried.T_world_gripper @ move), origin


def opened(closed: Closed, judge: Judge) -> tuple[Closed, Int[Array, "m"]]:
    """Each candidate in every wider preshape in turn, and which candidate each is of."""
    wider = wider_preshapes(judge.gripper)
    preshape, origin = closed.preshape, np.arange(len(closed))
    preshapes, origins = [preshape[:0]], [origin[:0]]
    while judge.config.collision.may_open and len(origin):
        preshape = wider[preshape]
        preshape, origin = preshape[preshape >= 0], origin[preshape >= 0]
        preshapes.append(preshape)
        origins.append(origin)
    every = np.concatenate(origins)
    return replace(closed.select(every), preshape=np.concatenate(preshapes)), every


def free_of(tried: Closed, origin: Int[Array, "m"], judge: Judge) -> tuple[Free, Int[Array, "k"]]:
    """Those whose hand and way in keep their clearance, and that can go all of their way."""
    table = table_clearance_of_way(tried, judge.space)
    above = np.flatnonzero(table > CLEAR_ENOUGH * judge.config.collision.clearance)
    tried, origin, table = tried.select(above), origin[above], table[above]
    clearance = np.minimum(point_clearance(tried, judge.space), table)
    is_free = clearance > CLEAR_ENOUGH * judge.config.collision.clearance
    is_free[is_free] = is_executable(tried.select(is_free), judge.way)
    free = replace(tried, clearance=clearance).select(is_free)
    return Free(**{entry.name: getattr(free, entry.name) for entry in fields(Free)}), origin[is_free]


def closing_on(tried: Free, origin: Int[Array, "m"], judge: Judge) -> tuple[Closed, Int[Array, "k"]]:
    """Those whose fingers meet the object."""
    keep, fraction = meet_object(tried, judge.space, judge.config.closing, Tally(len(tried)))
    tried, fraction = tried.select(keep), fraction[keep]
    joints = contact_joints(tried.preshape, fraction, judge.gripper)
    return Closed(**vars(tried), closing_fraction=fraction, grasp_joints=joints), origin[keep]


def surest(current: Graded, found: Graded, origin: Int[Array, "m"]) -> tuple[Graded, Array]:
    """For each candidate the surest of itself and its neighbours, and whether that is a neighbour."""
    both = joined(current, found)
    first = best_of_each(both.sureness, np.concatenate([np.arange(len(current)), origin]), 1)
    return both.select(first), first >= len(current)


def best_of_each(worth: Float[Array, "n"], owner: Int[Array, "n"], count: int) -> Int[Array, "k"]:
    """Indices of so many of the best of each owner, in the owners' order; of equals the first."""
    order = np.lexsort((-worth, owner))  # stable
    owner = owner[order]
    return order[np.arange(len(owner)) - np.searchsorted(owner, owner) < count]


def put(graded: Graded, index: Int[Array, "k"], by: Graded) -> Graded:
    """The candidates, those of an index replaced."""
    order = np.arange(len(graded))
    order[index] = len(graded) + np.arange(len(index))
    return joined(graded, by).select(order)


def joined(a: C, b: C) -> C:
    """Both, one after the other."""
    both = {entry.name: (getattr(a, entry.name), getattr(b, entry.name)) for entry in fields(a)}
    return type(a)(**{name: np.concatenate(pair) for name, pair in both.items()})
