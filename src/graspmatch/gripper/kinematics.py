"""Postures of a hand: from the driven joints to every joint, through couplings and closed linkages, to the links."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import lsq_linear

from graspmatch.errors import GraspmatchError
from graspmatch.geometry.se3 import from_parts, inverse
from graspmatch.gripper.card import Card, postures, read_card
from graspmatch.gripper.description import Description, read_description
from graspmatch.gripper.find_description import find_description
from graspmatch.gripper.toml_table import unknown
from graspmatch.types import Link

Array = np.ndarray

LIMIT_SLACK = 1e-6
"""How far a card's value may lie beyond a limit [rad or m]: files round their limits."""
PATH_STEP = 0.1
"""Longest step of a driven joint on the way to a posture, as a share of its range up to 1 rad or 1 m."""
REACH = 0.3
"""Longest move of a joint in one iteration [rad or m], so that a linkage stays on its branch."""
TIGHT = 1e-6
"""Largest residual of a coupling or loop that counts as met [rad or m]."""
CONSTRAINT_WEIGHT, DAMPING = 1e6, 1e-3
"""Beside a weight of 1 of the strongest spring: constraints first, then springs, then staying where one is."""
MOST_ITERATIONS = 100


@dataclass(frozen=True, eq=False)
class HandModel:
    """A card and the description that it belongs to, checked against each other."""

    card: Card
    description: Description
    joint_names: tuple[str, ...]
    """The d driven joints."""
    lower: Float[Array, "d"]
    """Limits of the driven joints [rad or m], infinite where there are none."""
    upper: Float[Array, "d"]
    links: tuple[Link, ...]
    stamps: tuple[int, ...]
    """When the description's files were last changed."""


def load_hand(card_path: Path | str, description_override: Path | str | None = None) -> HandModel:
    """The hand of a card, with its own description or another file of it; cached until card or description change."""
    card_path = Path(card_path).absolute()
    card = read_card(card_path)
    description = _described_by(card, description_override)
    hand = _load_hand(card_path, description, _stamp(card_path), _stamp(description))
    if _stamps(hand.description) != hand.stamps:  # a mesh or an included file is another one now
        _load_hand.cache_clear()
        hand = _load_hand(card_path, description, _stamp(card_path), _stamp(description))
    return hand


def check_card(card: Card, description: Description) -> None:
    """Raise where the card names what the description does not have, or leaves a joint's limits."""
    movable = [name for name in description.joint_names if name]
    for name in card.joints:
        _require(name, movable, "joint", "joints", card, description)
    for follower, coupling in card.couplings.items():
        free = [name for name in movable if name not in card.joints]
        _require(follower, free, "joint that is not driven", "couplings", card, description)
        leaders = [name for name in movable if name != follower]
        _require(coupling.joint, leaders, "joint", f"couplings.{follower}", card, description)
    links = [link.name for link in description.links]
    for place, names in [("palm", card.palm), *((f"finger '{f.name}'", f.links) for f in card.fingers)]:
        for name in names:
            _require(name, links, "link with geometry", place, card, description)
    named = [name for names in (card.palm, *(f.links for f in card.fingers)) for name in names]
    for name in named:
        if named.count(name) > 1:
            raise GraspmatchError(f"{card.path}: link '{name}' can belong to the palm or to one finger, not to two.")
    lower, upper = _limits(description, card.joint_names)
    shapes = [("open", card.open_joints), ("closed", card.closed_joints)]
    for posture in postures(card, card.joint_names):
        shapes += [(posture.name, posture.joints), (f"{posture.name}, closed", posture.closed)]
    for shape, values in shapes:
        for name, value, low, high in zip(card.joint_names, values, lower, upper, strict=True):
            if not low - LIMIT_SLACK <= value <= high + LIMIT_SLACK:
                limits = f"its limits are {low:.6g} to {high:.6g}"
                raise GraspmatchError(f"{card.path}: preshape '{shape}' puts joint '{name}' at {value:.6g}; {limits}.")


def solve_posture(hand: HandModel, driven: Float[Array, "d"]) -> Float[Array, "q"]:
    """All joint values (MuJoCo's qpos) when the driven joints are held.

    Followers obey the description's constraints and the card's couplings; what those leave free is where its springs
    pull it within its limits, or else stays at the description's zero.
    """
    values = np.asarray(driven, dtype=float)
    if values.shape != (len(hand.joint_names),):
        expected = f"({len(hand.joint_names)},): {', '.join(hand.joint_names)}"
        raise GraspmatchError(f"The joint values of {hand.card.name} have shape {values.shape}; expected {expected}.")
    return _posture(hand, tuple(values.tolist())).copy()


def pose_links(hand: HandModel, driven: Float[Array, "d"]) -> Float[Array, "l 4 4"]:
    """T_gripper_link of every link, in the frame of the base link, in the order of `hand.links`."""
    model = hand.description.model
    data = mujoco.MjData(model)
    data.qpos[:] = solve_posture(hand, driven)
    mujoco.mj_kinematics(model, data)
    T_world_body = from_parts(data.xmat.reshape(-1, 3, 3), data.xpos)
    return inverse(T_world_body[hand.description.base_body]) @ T_world_body[list(hand.description.link_bodies)]


def _described_by(card: Card, override: Path | str | None) -> Path:
    """The description's file; where it does not come with the card and is not found, the error says where to get it."""
    try:
        path = find_description(override or card.description)
    except GraspmatchError as error:
        raise GraspmatchError(f"{error} {_hint(card)}") from error
    if not override and card.source and not path.is_file():
        raise GraspmatchError(f"The description of {card.name} is not at {path}. {_hint(card)}")
    return path


def _hint(card: Card) -> str:
    return f"{card.name} is described by {card.source}; give that file with --description." if card.source else ""


@lru_cache(maxsize=32)
def _load_hand(card_path: Path, description_path: Path, card_stamp: int, description_stamp: int) -> HandModel:
    card = read_card(card_path)
    description = read_description(description_path, card.base_link)
    check_card(card, description)
    return assemble(card, description)


def assemble(card: Card, description: Description) -> HandModel:
    """The hand of a card and a description that fit each other."""
    lower, upper = _limits(description, card.joint_names)
    return HandModel(card, description, card.joint_names, lower, upper, description.links, _stamps(description))


def _stamps(description: Description) -> tuple[int, ...]:
    return tuple(_stamp(path) for path in description.files)


def _stamp(path: Path) -> int:
    return os.stat(path).st_mtime_ns if path.is_file() else 0


def _require(name: str, known: list[str], what: str, place: str, card: Card, description: Description) -> None:
    if name not in known:
        raise GraspmatchError(f"{card.path}: {place}: {description.path.name} has {unknown(what, name, known)}")


def _limits(description: Description, names: tuple[str, ...]) -> tuple[Float[Array, "d"], Float[Array, "d"]]:
    model = description.model
    ids = [model.joint(name).id for name in names]
    limited = model.jnt_limited[ids].astype(bool)
    return np.where(limited, model.jnt_range[ids, 0], -np.inf), np.where(limited, model.jnt_range[ids, 1], np.inf)


@dataclass(frozen=True, eq=False)
class _Linkage:
    """What follows the driven joints, as rows over the free dofs. Hinges and slides have one dof and one qpos each."""

    driven_qpos: Int[Array, "d"]
    home: Float[Array, "d"]
    """Driven joint values of the description's zero."""
    step: Float[Array, "d"]
    free_dof: Int[Array, "u"]
    free_qpos: Int[Array, "u"]
    lower: Float[Array, "u"]
    """Infinite where another joint dictates the value: files are careless about the limits of followers."""
    upper: Float[Array, "u"]
    spring: Float[Array, "u"]
    """Square root of the stiffness, over that of the strongest."""
    spring_rest: Float[Array, "u"]
    coupling_qpos: Int[Array, "c 2"]
    """Follower and the joint that it follows."""
    coupling_dof: Int[Array, "c 2"]
    coupling_law: Float[Array, "c 2"]
    """Multiplier and offset."""
    is_closed: bool
    """Some constraint closes a loop, so that a posture depends on the way to it."""


@lru_cache(maxsize=32)
def _linkage(hand: HandModel) -> _Linkage:
    model, card = hand.description.model, hand.card
    free = [model.joint(n).id for n in hand.description.joint_names if n and n not in card.joints]
    driven = [model.joint(n).id for n in hand.joint_names]
    pairs = [(model.joint(follower).id, model.joint(c.joint).id) for follower, c in card.couplings.items()]
    followed = np.array(pairs, dtype=int).reshape(-1, 2)
    by_joint = model.eq_type == mujoco.mjtEq.mjEQ_JOINT
    dictated = {*followed[:, 0], *model.eq_obj1id[by_joint], *model.eq_obj2id[by_joint], *_tied_by_tendons(model)}
    bounded = np.array([bool(model.jnt_limited[j]) and j not in dictated for j in free], dtype=bool)
    stiffness = model.jnt_stiffness[free]
    home = np.clip(model.qpos0[model.jnt_qposadr[driven]], hand.lower, hand.upper)
    span = np.where(np.isfinite(hand.upper - hand.lower), hand.upper - hand.lower, 1.0)
    return _Linkage(
        driven_qpos=model.jnt_qposadr[driven],
        home=home,
        step=PATH_STEP * np.clip(span, 1e-6, 1.0),
        free_dof=model.jnt_dofadr[free],
        free_qpos=model.jnt_qposadr[free],
        lower=np.where(bounded, model.jnt_range[free, 0], -np.inf),
        upper=np.where(bounded, model.jnt_range[free, 1], np.inf),
        spring=np.sqrt(stiffness / max(stiffness.max(initial=0.0), 1e-12)),
        spring_rest=model.qpos_spring[model.jnt_qposadr[free]],
        coupling_qpos=model.jnt_qposadr[followed],
        coupling_dof=model.jnt_dofadr[followed],
        coupling_law=np.array([(c.multiplier, c.offset) for c in card.couplings.values()]).reshape(-1, 2),
        is_closed=not bool(np.all(by_joint)),
    )


def _tied_by_tendons(model: mujoco.MjModel) -> set[int]:
    """Joints on a tendon whose length an equality gives."""
    by_tendon = model.eq_type == mujoco.mjtEq.mjEQ_TENDON
    tendons = {int(t) for t in (*model.eq_obj1id[by_tendon], *model.eq_obj2id[by_tendon]) if t >= 0}
    wraps = [w for t in tendons for w in range(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])]
    return {int(model.wrap_objid[w]) for w in wraps if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT}


@lru_cache(maxsize=8192)
def _posture(hand: HandModel, driven: tuple[float, ...]) -> Float[Array, "q"]:
    """The posture, reached on a fixed path of short steps from home, so that it depends on nothing but `driven`."""
    linkage = _linkage(hand)
    offset = np.array(driven) - linkage.home
    if not linkage.is_closed or np.all(offset == 0):
        return _settle(hand, linkage, hand.description.model.qpos0, np.array(driven))
    steps = np.abs(offset) / linkage.step
    earlier = np.maximum(np.ceil(steps - 1e-9) - 1, 0)  # the last node of the path's lattice before here
    before = linkage.home + np.sign(offset) * earlier * linkage.step
    return _settle(hand, linkage, _posture(hand, tuple(before.tolist())), np.array(driven))


def _settle(
    hand: HandModel, linkage: _Linkage, start: Float[Array, "q"], driven: Float[Array, "d"]
) -> Float[Array, "q"]:
    """Gauss-Newton on constraints, springs and damping, within the limits."""
    data = mujoco.MjData(hand.description.model)
    data.qpos[:] = start
    data.qpos[linkage.driven_qpos] = driven
    residual, jacobian = _constraints(hand, data, linkage)
    for _ in range(MOST_ITERATIONS if len(linkage.free_dof) else 0):
        step = _step(linkage, data.qpos[linkage.free_qpos], residual, jacobian[:, linkage.free_dof])
        data.qpos[linkage.free_qpos] += step
        residual, jacobian = _constraints(hand, data, linkage)
        if np.abs(step).max() < 1e-8:
            break
    worst = float(np.abs(residual).max(initial=0.0))
    if worst > TIGHT:
        model, is_open = hand.description.model, np.abs(residual) > TIGHT
        touched = np.abs(jacobian[is_open]).max(axis=0) > 0
        names = ", ".join(model.joint(j).name for j in np.unique(model.dof_jntid[touched]))
        at = ", ".join(f"{name} = {value:.6g}" for name, value in zip(hand.joint_names, driven, strict=True))
        raise GraspmatchError(
            f"{hand.card.name}: no posture of the followers fits {at}: a constraint on the joints {names} stays open "
            f"by {worst:.2g} (rad or m). Check the couplings, and that the driven joints are within their limits."
        )
    return data.qpos.copy()


def _step(
    linkage: _Linkage, q: Float[Array, "u"], residual: Float[Array, "r"], jacobian: Float[Array, "r u"]
) -> Float[Array, "u"]:
    """The least-squares move of the free joints that stays within their limits."""
    rows = [CONSTRAINT_WEIGHT * jacobian, np.diag(linkage.spring), DAMPING * np.eye(len(q))]
    goal = [-CONSTRAINT_WEIGHT * residual, linkage.spring * (linkage.spring_rest - q), np.zeros(len(q))]
    reach = REACH if linkage.is_closed else np.inf
    lower = np.clip(linkage.lower - q, -reach, reach / 2)
    upper = np.clip(linkage.upper - q, -reach / 2, reach)
    return lsq_linear(np.vstack(rows), np.concatenate(goal), (lower, upper), method="bvls").x


def _constraints(
    hand: HandModel, data: mujoco.MjData, linkage: _Linkage
) -> tuple[Float[Array, "r"], Float[Array, "r v"]]:
    """Residuals of the description's equalities and of the card's couplings, and their derivatives by all dofs."""
    model = hand.description.model
    mujoco.mj_fwdPosition(model, data)
    equality = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    jacobian = data.efc_J.reshape(-1, model.nv)[equality]
    follower, leader = data.qpos[linkage.coupling_qpos].T
    multiplier, offset = linkage.coupling_law.T
    rows = np.arange(len(multiplier))
    coupling = np.zeros((len(rows), model.nv))
    coupling[rows, linkage.coupling_dof[:, 0]] = 1.0
    coupling[rows, linkage.coupling_dof[:, 1]] = -multiplier
    residual = np.concatenate([data.efc_pos[equality], follower - multiplier * leader - offset])
    return residual, np.concatenate([jacobian, coupling])
