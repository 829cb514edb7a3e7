"""The card of a hand: what a planner must know and no description file says, in TOML beside the URDF or MJCF."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

import numpy as np
from jaxtyping import Float

from graspmatch.config import SampleMethod
from graspmatch.errors import GraspmatchError
from graspmatch.gripper.find_description import has_scheme
from graspmatch.gripper.toml_table import Table, unknown

Array = np.ndarray


@dataclass(frozen=True)
class DrivenJoint:
    """One joint that a motor moves [rad or m]."""

    open: float
    closed: float | None
    """None: the joint only spreads the fingers."""


@dataclass(frozen=True)
class Coupling:
    """A follower which the description leaves free: follower = multiplier * joint + offset."""

    joint: str
    multiplier: float
    offset: float
    """[rad or m]"""


@dataclass(frozen=True)
class CardFinger:
    """One finger by the names of its links and of the driven joints that close it."""

    name: str
    links: tuple[str, ...]
    joints: tuple[str, ...]


@dataclass(frozen=True)
class CardPose:
    """A posture by name. Joints that it leaves out are open."""

    joints: dict[str, float]
    closed: dict[str, float] | None
    """Where closing from here ends; joints left out stay where they are. None: the closed values of the card."""
    tool_centre_point: tuple[float, float, float] | None
    """Where the tips of this posture meet [m]; none: the card's."""
    reach: float | None
    """Only what is so near to the tool centre point counts as inner surface [m]; none: all that is seen."""


@dataclass(frozen=True)
class PreshapeRule:
    """Which postures to bake: steps of the closing motion, at each spread, and explicit poses."""

    steps: int
    closing: tuple[float, float]
    """First and last fraction of the way from open to closed."""
    spread: dict[str, tuple[float, ...]]
    poses: dict[str, CardPose]
    fingertips: int
    """How many more postures, for each spread, hold things between the fingertips."""


@dataclass(frozen=True)
class SampleRule:
    """How the inner surface is sampled."""

    method: SampleMethod
    voxel_size: float
    """[m]"""


FINGERTIPS = 3
"""Fingertip preshapes for each spread, where a card does not say."""
SAME_POSTURE = 1e-3
"""Joint values that differ by less are those of one preshape: files of grasps round them [rad or m]."""
SAMPLE_METHODS: tuple[SampleMethod, ...] = get_args(SampleMethod)


@dataclass(frozen=True)
class Card:
    """A hand's card, checked for itself; vectors and points are in the frame of `base_link`."""

    path: Path
    name: str
    title: str
    description: str
    """Path of the URDF or MJCF file, or where else it is, as `find_description` has it."""
    source: str
    """Where to get that file, for people; empty where it comes with the card."""
    base_link: str
    approach: Float[Array, "3"]
    """Unit vector towards the object."""
    closing: Float[Array, "3"]
    """Unit vector along which the fingers close, perpendicular to `approach`."""
    tool_centre_point: Float[Array, "3"]
    """[m]"""
    finger_force: float
    """[N]"""
    self_locking: bool
    """Whether the drives hold against being pushed back, as worm gears do."""
    opening: float
    """[m]"""
    palm: tuple[str, ...]
    joints: dict[str, DrivenJoint]
    couplings: dict[str, Coupling]
    fingers: tuple[CardFinger, ...]
    preshapes: PreshapeRule
    samples: SampleRule

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The driven joints, in the order of the card."""
        return tuple(self.joints)

    @property
    def open_joints(self) -> Float[Array, "d"]:
        """Value of every driven joint of the open hand."""
        return np.array([joint.open for joint in self.joints.values()])

    @property
    def closed_joints(self) -> Float[Array, "d"]:
        """The same closed; a joint that only spreads stays at its open value."""
        return np.array([j.open if j.closed is None else j.closed for j in self.joints.values()])


@dataclass(frozen=True)
class Posture:
    """One preshape that a card asks for; values of the d driven joints [rad or m]."""

    name: str
    joints: Float[Array, "d"]
    closed: Float[Array, "d"]
    """Where its fingers end when nothing stops them; joints that only spread stay where they are."""
    tool_centre_point: Float[Array, "3"]
    """[m]"""
    reach: float
    """What is farther from the tool centre point is no inner surface [m]; infinite where all is."""
    finger_shares: Float[Array, "f"] | None = None
    """How much the tip of each finger counts, where tips are all that counts."""


def postures(card: Card, joint_names: Sequence[str]) -> list[Posture]:
    """Every preshape that the card asks for, joints in the order of `joint_names`."""
    rule = card.preshapes
    way = {name: (a, b) for name, a, b in zip(card.joints, card.open_joints, card.closed_joints, strict=True)}
    shapes: list[tuple[str, dict[str, float], CardPose | None]] = []
    for spread in itertools.product(*rule.spread.values()):
        prefix = "".join(f"spread_{value:.4g}_" for value in spread)
        for fraction in np.linspace(*rule.closing, rule.steps):
            values = {name: a + fraction * (b - a) for name, (a, b) in way.items()}
            values |= dict(zip(rule.spread, spread, strict=True))
            shapes.append((f"{prefix}close_{100 * fraction:.0f}", values, None))
    opened = {name: a for name, (a, _) in way.items()}
    shapes += [(name, opened | pose.joints, pose) for name, pose in rule.poses.items()]
    return [_posture(card, joint_names, name, values, pose) for name, values, pose in shapes]


def closed_from(card: Card, joint_names: Sequence[str], joints: Float[Array, "d"]) -> Float[Array, "d"]:
    """Where the fingers end that close from some joint values: as the preshape of these values says, else the card."""
    for posture in postures(card, joint_names):
        if np.allclose(posture.joints, joints, rtol=0, atol=SAME_POSTURE):
            return posture.closed
    return _closed_by_card(card, joint_names, joints)


def _posture(
    card: Card, joint_names: Sequence[str], name: str, values: dict[str, float], pose: CardPose | None
) -> Posture:
    joints = np.array([values[joint] for joint in joint_names])
    closed, centre, reach = _closed_by_card(card, joint_names, joints), card.tool_centre_point, np.inf
    if pose is not None:
        if pose.closed is not None:
            closed = np.array([(values | pose.closed)[joint] for joint in joint_names])
        centre = centre if pose.tool_centre_point is None else np.array(pose.tool_centre_point)
        reach = np.inf if pose.reach is None else pose.reach
    return Posture(name, joints, closed, centre, reach)


def _closed_by_card(card: Card, joint_names: Sequence[str], joints: Float[Array, "d"]) -> Float[Array, "d"]:
    ends = [card.joints[name].closed for name in joint_names]
    return np.array([value if end is None else end for value, end in zip(joints, ends, strict=True)])


def read_card(path: Path | str) -> Card:
    """The card at `path`; every mistake in it is a GraspmatchError of one line that names file and key."""
    path = Path(path).absolute()
    if not path.is_file():
        raise GraspmatchError(f"No gripper card at {path}. A card is a TOML file beside the URDF or MJCF.")
    try:
        table = Table(path, "", tomllib.loads(path.read_text(encoding="utf-8")))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise GraspmatchError(f"{path} is not valid TOML: {error}") from error
    table.only(Card.__annotations__.keys() - {"path"})
    joints = {name: _driven_joint(entry) for name, entry in table.tables("joints").items()}
    if not joints:
        raise table.error("joints", "is empty; name at least one driven joint as [joints.NAME]")
    approach, closing = _axes(table)
    name = table.string("name")
    return Card(
        path=path,
        name=name,
        title=table.string("title", name),
        description=_description(path, table.string("description")),
        source=table.string("source") if "source" in table.values else "",
        base_link=table.string("base_link"),
        approach=approach,
        closing=closing,
        tool_centre_point=np.array(table.numbers("tool_centre_point", 3)),
        finger_force=table.positive("finger_force"),
        self_locking=table.boolean("self_locking", False),
        opening=table.positive("opening"),
        palm=table.strings("palm"),
        joints=joints,
        couplings={follower: _coupling(entry) for follower, entry in table.tables("couplings", {}).items()},
        fingers=_fingers(table, joints),
        preshapes=_preshape_rule(table.table("preshapes"), joints),
        samples=_sample_rule(table.table("samples")),
    )


def _description(path: Path, reference: str) -> str:
    return reference if has_scheme(reference) else str(path.parent / reference)


def _driven_joint(entry: Table) -> DrivenJoint:
    entry.only(("open", "closed"))
    return DrivenJoint(entry.number("open"), entry.number("closed") if "closed" in entry.values else None)


def _coupling(entry: Table) -> Coupling:
    entry.only(("joint", "multiplier", "offset"))
    return Coupling(entry.string("joint"), entry.number("multiplier", 1.0), entry.number("offset", 0.0))


def _fingers(table: Table, joints: dict[str, DrivenJoint]) -> tuple[CardFinger, ...]:
    fingers = []
    for entry in table.list_of_tables("fingers"):
        entry.only(("name", "links", "joints"))
        finger = CardFinger(entry.string("name"), entry.strings("links"), entry.strings("joints"))
        closing = [name for name, joint in joints.items() if joint.closed is not None]
        for name in finger.joints:
            if name not in closing:
                raise entry.error("joints", f"has {unknown('driven joint that closes', name, closing)}")
        if not finger.links or not finger.joints:
            raise entry.error("joints" if finger.links else "links", "is empty; a finger needs links and joints")
        fingers.append(finger)
    _refuse_twice(table, "fingers", "name", [finger.name for finger in fingers])
    if not fingers:
        raise table.error("fingers", "is empty; describe each finger as [[fingers]]")
    moved = {name for finger in fingers for name in finger.joints}
    for name, joint in joints.items():
        if joint.closed is not None and name not in moved:
            raise table.error("fingers", f"has no finger that the closing joint '{name}' moves")
    return tuple(fingers)


def _preshape_rule(entry: Table, joints: dict[str, DrivenJoint]) -> PreshapeRule:
    entry.only(PreshapeRule.__annotations__.keys())
    steps, closing = entry.number("steps", 10.0), entry.numbers("closing", 2, [0.0, 0.9])
    if steps != int(steps) or steps < 0:
        raise entry.error("steps", f"is {steps:g}; it must be a whole number, 0 or more")
    if not 0 <= closing[0] <= closing[1] <= 1:
        raise entry.error("closing", f"is {list(closing)}; it must be two fractions, 0 <= first <= last <= 1")
    spread_table = entry.table("spread")
    spread = {name: spread_table.numbers(name, None) for name in spread_table.values}
    poses = {}
    for pose in entry.list_of_tables("poses"):
        poses[pose.string("name")] = _card_pose(pose)
    named = itertools.chain(spread, *(pose.joints for pose in poses.values()))
    for name in named:
        if name not in joints:
            raise entry.error("spread and poses", f"name {unknown('driven joint', name, joints)}")
    closing_joints = [name for name, joint in joints.items() if joint.closed is not None]
    for name in itertools.chain(*(pose.closed or {} for pose in poses.values())):
        if name not in closing_joints:
            raise entry.error("poses", f"close {unknown('driven joint that closes', name, closing_joints)}")
    if steps == 0 and not poses:
        raise entry.error("steps", "is 0 and there are no poses; a hand needs at least one preshape")
    fingertips = entry.number("fingertips", float(FINGERTIPS))
    if fingertips != int(fingertips) or fingertips < 0:
        raise entry.error("fingertips", f"is {fingertips:g}; it must be a whole number, 0 or more")
    return PreshapeRule(int(steps), (closing[0], closing[1]), spread, poses, int(fingertips))


def _card_pose(entry: Table) -> CardPose:
    entry.only(("name", *CardPose.__annotations__))
    joints, closed = entry.table("joints"), entry.table("closed")
    centre = entry.numbers("tool_centre_point", 3) if "tool_centre_point" in entry.values else None
    return CardPose(
        joints={name: joints.number(name) for name in joints.values},
        closed={name: closed.number(name) for name in closed.values} if "closed" in entry.values else None,
        tool_centre_point=None if centre is None else (centre[0], centre[1], centre[2]),
        reach=entry.positive("reach") if "reach" in entry.values else None,
    )


def _sample_rule(entry: Table) -> SampleRule:
    entry.only(SampleRule.__annotations__.keys())
    method = entry.string("method", SAMPLE_METHODS[0])
    if method not in SAMPLE_METHODS:
        raise entry.error("method", f"has {unknown('way of sampling', method, SAMPLE_METHODS)}")
    return SampleRule(cast(SampleMethod, method), entry.positive("voxel_size", 0.005))


def _axes(table: Table) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Unit approach, and unit closing made perpendicular to it."""
    axes = {}
    for key in ("approach", "closing"):
        axes[key] = np.array(table.numbers(key, 3))
        if np.linalg.norm(axes[key]) < 1e-9:
            raise table.error(key, "has no length; it must be a direction such as [0, 0, 1]")
        axes[key] /= np.linalg.norm(axes[key])
    across = axes["closing"] - (axes["closing"] @ axes["approach"]) * axes["approach"]
    if np.linalg.norm(across) < 1e-3:
        raise table.error("closing", "is parallel to approach; the fingers close across the approach")
    return axes["approach"], across / np.linalg.norm(across)


def _refuse_twice(table: Table, key: str, field: str, names: list[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise table.error(key, f"has the {field} '{name}' twice")
