"""Which links of a description are the hand: its base, its palm, and the branches that may be fingers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from graspmatch.errors import GraspmatchError
from graspmatch.gripper.description import MOVING, is_below, solid_geoms
from graspmatch.gripper.toml_table import unknown

MOST_WRIST_JOINTS = 3
"""Joints in series between the file's first link and the palm, above which they are an arm's."""
LEAST_RANGE = 1e-6
"""A joint with less room to move is welded [rad or m]."""


@dataclass(frozen=True)
class Branch:
    """A finger, or a part of a linkage: all that hangs on the palm by one joint, or by several that loops join."""

    bodies: tuple[int, ...]
    joints: tuple[int, ...]
    """The hinges and slides in it, from the palm outwards."""


@dataclass(frozen=True)
class Tree:
    """The links of one hand, by their indices in the model."""

    base: int
    palm: tuple[int, ...]
    """Bodies that move with the palm, as far as they belong to the hand."""
    wrist: tuple[int, ...]
    """Joints between the base and the palm."""
    behind: tuple[int, ...]
    """Bodies between the base and the palm, which the wrist moves."""
    branches: tuple[Branch, ...]


def find_tree(model: mujoco.MjModel, path: Path, root: str | None) -> Tree:
    """The hand of a compiled description, below the link `root` if that is given.

    Raises `GraspmatchError` where there is none, or several.
    """
    top = 0 if root is None else _body(model, path, root)
    groups = rigid_groups(model)
    children = _children(model, groups, top)
    palms = _palms(model, groups, children, top)
    if not palms:
        raise GraspmatchError(_no_hand(model, path, top))
    names = [_trunk(model, groups, children, palm) for palm in palms]
    if len(palms) == 1 and root is None:
        names = _standing_apart(model, children[palms[0]]) or names
    if len(names) > 1:
        listed = ", ".join(f"'{name}'" for name in names)
        raise GraspmatchError(f"{path} has {len(names)} hands; choose one by the link it begins at, --root: {listed}.")
    return _tree(model, groups, children, palms[0], top, is_given=root is not None)


def rigid_groups(model: mujoco.MjModel) -> list[int]:
    """For each body the first body that it is welded to; joints that cannot move weld."""
    group = list(range(model.nbody))
    for body in range(1, model.nbody):
        if not moving_joints(model, body) and not _is_free(model, body):
            group[body] = group[model.body_parentid[body]]
    return group


def moving_joints(model: mujoco.MjModel, body: int) -> list[int]:
    """Hinges and slides of a body that can move."""
    first = model.body_jntadr[body]
    return [j for j in range(first, first + model.body_jntnum[body]) if can_move(model, j)]


def can_move(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint is a hinge or a slide with room between its limits."""
    low, high = model.jnt_range[joint]
    return int(model.jnt_type[joint]) in MOVING and not (model.jnt_limited[joint] and high - low < LEAST_RANGE)


def _is_free(model: mujoco.MjModel, body: int) -> bool:
    first = model.body_jntadr[body]
    return any(int(model.jnt_type[j]) not in MOVING for j in range(first, first + model.body_jntnum[body]))


def _children(model: mujoco.MjModel, groups: list[int], top: int) -> dict[int, list[int]]:
    """Groups that hang on each group by joints and carry geometry, themselves or further out."""
    solid = {groups[b] for b in range(model.nbody) if solid_geoms(model, b)}
    heads = [b for b in range(1, model.nbody) if groups[b] == b and is_below(model, b, top) and b != top]
    children: dict[int, list[int]] = {groups[top]: []} | {head: [] for head in heads}
    for head in heads:
        if any(group == head or is_below(model, group, head) for group in solid):
            children[groups[model.body_parentid[head]]].append(head)
    return children


def _palms(model: mujoco.MjModel, groups: list[int], children: dict[int, list[int]], top: int) -> list[int]:
    """The groups that carry fingers: those that branch and have no such group further out.

    What branches only a joint or two further out is a part of the same hand: a linkage, a metacarpal.
    """
    forks = [g for g in children if len(_ends(model, children[g])) >= 2]
    palms = [g for g in forks if not any(f != g and _is_outside(model, groups, f, g) for f in forks)]
    if not palms:  # one jaw that closes on a fixed one: the last joint decides
        ends = [g for g, c in children.items() if not c and _is_moved(model, g, top)]
        palms = [groups[model.body_parentid[end]] for end in ends][:1] if len(ends) == 1 else []
    return palms


def _standing_apart(model: mujoco.MjModel, heads: list[int]) -> list[str]:
    """The first links of several hands that are all welded to the world, none if they are one."""
    first: dict[int, int] = {}
    for body in _ends(model, heads):
        while model.body_parentid[body] > 0:
            body = int(model.body_parentid[body])
        first[body] = first.get(body, 0) + 1
    hands = [body for body, count in first.items() if count >= 2]
    return [model.body(body).name for body in hands] if len(hands) > 1 else []


def _ends(model: mujoco.MjModel, heads: list[int]) -> list[int]:
    """Branches that a joint moves, not those that float freely: those are hands or robots of their own."""
    return [head for head in heads if moving_joints(model, head)]


def _is_outside(model: mujoco.MjModel, groups: list[int], fork: int, group: int) -> bool:
    """Whether a fork hangs on a group by so many joints that it is a hand of its own."""
    count, body = 0, fork
    while body != group:
        if body <= 0 or not is_below(model, body, group):
            return False
        count += 1 if groups[body] == body else 0
        body = int(model.body_parentid[body])
    return count > MOST_WRIST_JOINTS - 1


def _is_moved(model: mujoco.MjModel, group: int, top: int) -> bool:
    return group != top and bool(moving_joints(model, group))


def _tree(
    model: mujoco.MjModel, groups: list[int], children: dict[int, list[int]], palm: int, top: int, *, is_given: bool
) -> Tree:
    """The hand around a palm."""
    way = [palm]  # heads of the groups from the palm back to the file's first link
    while moving_joints(model, way[-1]) and way[-1] != top:
        way.append(groups[model.body_parentid[way[-1]]])
    base = top if is_given else _first_solid(model, way[-1])
    wrist = [j for group in way[:-1] for j in moving_joints(model, group)]
    if not is_given and len(wrist) > MOST_WRIST_JOINTS:
        base, wrist, way = _trunk_body(model, groups, children, palm), [], [palm]
    hand = [b for b in range(model.nbody) if is_below(model, b, base)]
    return Tree(
        base=base,
        palm=tuple(b for b in hand if groups[b] == palm),
        wrist=tuple(reversed(wrist)),
        behind=tuple(b for b in hand if groups[b] in way[1:]),
        branches=_branches(model, groups, [h for h in children[palm] if moving_joints(model, h)]),
    )


def _first_solid(model: mujoco.MjModel, group: int) -> int:
    """The file's first link, not the world that it stands in unless it has geometry of its own."""
    if group != 0 or solid_geoms(model, 0):
        return group
    inner = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0]
    return inner[0] if len(inner) == 1 else 0


def _trunk_body(model: mujoco.MjModel, groups: list[int], children: dict[int, list[int]], palm: int) -> int:
    """The link that carries all fingers itself: of what is welded to an arm's last link, the hand begins there."""
    body = int(model.body_parentid[children[palm][0]])
    while not all(is_below(model, child, body) for child in children[palm]):
        body = int(model.body_parentid[body])
    return body


def _trunk(model: mujoco.MjModel, groups: list[int], children: dict[int, list[int]], palm: int) -> str:
    return model.body(_trunk_body(model, groups, children, palm)).name


def _branches(model: mujoco.MjModel, groups: list[int], heads: list[int]) -> tuple[Branch, ...]:
    """What hangs on each head; heads whose parts a loop joins are one."""
    owner = {b: next((h for h in heads if is_below(model, b, h)), -1) for b in range(model.nbody)}
    joined = {head: head for head in heads}
    for a, b in _loops(model):
        one, other = owner[a], owner[b]
        if one >= 0 and other >= 0:
            keep, drop = sorted((joined[one], joined[other]))
            joined = {head: keep if to == drop else to for head, to in joined.items()}
    found = []
    for first in sorted(set(joined.values())):
        bodies = [b for b, head in owner.items() if head >= 0 and joined[head] == first]
        joints = [j for b in bodies for j in moving_joints(model, b)]
        found.append(Branch(tuple(bodies), tuple(joints)))
    return tuple(found)


def _loops(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Pairs of bodies that an equality ties to each other in space."""
    ties = np.isin(model.eq_type, (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)))
    pairs = []
    for e in np.flatnonzero(ties):
        ids = (int(model.eq_obj1id[e]), int(model.eq_obj2id[e]))
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            ids = (int(model.site_bodyid[ids[0]]), int(model.site_bodyid[ids[1]]))
        pairs.append(ids)
    return pairs


def _body(model: mujoco.MjModel, path: Path, name: str) -> int:
    names = [model.body(i).name for i in range(model.nbody)]
    if name not in names:
        raise GraspmatchError(f"{path} has {unknown('root link', name, names)}")
    return names.index(name)


def _no_hand(model: mujoco.MjModel, path: Path, top: int) -> str:
    joints = [j for j in range(model.njnt) if is_below(model, int(model.jnt_bodyid[j]), top)]
    stiff = [model.joint(j).name for j in joints if int(model.jnt_type[j]) in MOVING and not can_move(model, j)]
    if stiff:
        return f"{path}: no finger can move: the limits of {', '.join(stiff)} leave no room. Give lower and upper."
    if not joints:
        return f"{path} has no joint that moves, so no fingers; is it the whole hand, with its joints?"
    return f"{path}: no link carries fingers, which are links with geometry that move by hinges or slides."
