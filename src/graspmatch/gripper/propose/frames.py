"""Where a hand grasps: its approach, its closing axis, its tool centre point and its opening."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from graspmatch.errors import GraspmatchError
from graspmatch.geometry.mesh import concatenate, transformed
from graspmatch.geometry.sphere import fibonacci_directions
from graspmatch.gripper.propose.posing import Mechanism
from graspmatch.gripper.samples import RayCaster

Array = np.ndarray

RAYS = 3000
"""Directions in which the palm is looked for."""
LEAST_PALM = 0.002
"""Share of all directions in which the palm must be seen to say where it looks."""
SNAP = np.cos(np.radians(20))
"""An axis that is so near to one of the base frame's is that one."""
SHARPNESS = 4
"""With which directions near a normal count."""
INNERMOST = 0.002
"""Depth of the layer of a finger that meets the other side first [m]."""
CENTRED = 0.04
"""Of the opening: a tool centre point that is so near to an axis of the frame is on it."""
WAY_BACK = 20
"""Steps in which a tool centre point is moved until the palm is behind it."""


@dataclass(frozen=True)
class Frames:
    """In the frame of the base link."""

    approach: Float[Array, "3"]
    closing: Float[Array, "3"]
    tool_centre_point: Float[Array, "3"]
    """[m]"""
    opening: float
    """[m]"""
    reasons: dict[str, str] = field(default_factory=dict)


def find_approach(
    mechanism: Mechanism, postures: list[Float[Array, "d"]], sides: tuple[list[int], list[int]]
) -> tuple[Float[Array, "3"], str]:
    """The way the palm looks, seen from between the fingertips of the first posture from which it is seen."""
    for posture in postures:
        T = mechanism.pose(posture)
        caster, owner = _caster(mechanism, T)
        directions = fibonacci_directions(RAYS)
        centre = middle_of_tips(mechanism, T, sides)
        _, face = caster.cast(np.tile(centre, (RAYS, 1)), directions)
        palm = (face >= 0) & np.isin(owner[np.maximum(face, 0)], mechanism.palm_links)
        if palm.mean() >= LEAST_PALM:
            looks = caster.normals[face[palm]]
            return _snapped(_most_common(looks)), "the way the palm looks, seen from between the fingertips"
    way = middle_of_tips(mechanism, mechanism.pose(postures[0]), sides) - mechanism.palm_centre
    return _snapped(way), "from the palm's centre to the middle of the fingertips"


def find_frames(
    mechanism: Mechanism,
    postures: list[Float[Array, "d"]],
    sides: tuple[list[int], list[int]],
    approach: Float[Array, "3"],
    why: str,
) -> Frames:
    """Axes and tool centre point of a hand whose `postures` go from open until the two sides of fingers meet."""
    closing = find_closing(mechanism, postures, sides, approach)
    gaps = [_gap(mechanism, posture, sides, closing) for posture in postures]
    tips = [_tip_gap(mechanism, posture, sides, closing) for posture in postures]
    met = next((i for i, (gap, _) in enumerate(gaps) if gap <= INNERMOST), int(np.argmin([gap for gap, _ in gaps])))
    opening = max(max(tips), 1e-3)
    centre = _on_axes(gaps[met][1], approach, CENTRED * opening)
    centre = _behind_which_is_palm(mechanism, postures, centre, approach)
    reasons = {
        "approach": why,
        "closing": "the way the two sides of fingers come together",
        "tool_centre_point": f"where they are nearest, {max(1000 * gaps[met][0], 0):.0f} mm apart",
        "opening": "between the innermost points of the two sides' tips, open",
    }
    return Frames(approach, closing, centre, opening, reasons)


def find_sides(
    mechanism: Mechanism, opened: Float[Array, "d"], met: Float[Array, "d"], approach: Float[Array, "3"]
) -> tuple[list[int], list[int]]:
    """The two groups of fingers whose tips close against each other most, across the approach."""
    motion = mechanism.tip_positions(mechanism.pose(met)) - mechanism.tip_positions(mechanism.pose(opened))
    motion -= np.outer(motion @ approach, approach)
    count = len(motion)
    if count == 1:
        return [0], []
    best, value = ([0], list(range(1, count))), -1.0
    for code in range(1, 2 ** (count - 1)):
        one = [f for f in range(count) if code >> f & 1]
        other = [f for f in range(count) if f not in one]
        against = float(np.linalg.norm(motion[one].mean(axis=0) - motion[other].mean(axis=0)))
        if against > value + 1e-6:
            best, value = (one, other), against
    return best


def find_closing(
    mechanism: Mechanism, postures: list[Float[Array, "d"]], sides: tuple[list[int], list[int]], approach: Array
) -> Float[Array, "3"]:
    """Along which the two sides come together, across the approach; its largest component is positive."""
    first, last = (mechanism.tip_positions(mechanism.pose(postures[i])) for i in (0, -1))
    if sides[1]:
        way = (last - first)[sides[0]].mean(axis=0) - (last - first)[sides[1]].mean(axis=0)
    else:
        way = (last - first)[sides[0]].mean(axis=0)
    across = way - (way @ approach) * approach
    if np.linalg.norm(across) < 1e-6:
        across = np.eye(3)[np.argmin(np.abs(approach))]
    closing = _snapped(across)
    closing = closing - (closing @ approach) * approach
    closing /= np.linalg.norm(closing)
    return closing * np.sign(closing[np.argmax(np.abs(closing))]) + 0.0


def middle_of_tips(
    mechanism: Mechanism, T_base_link: Float[Array, "l 4 4"], sides: tuple[list[int], list[int]]
) -> Float[Array, "3"]:
    """Half way between the two sides [m]; with one side, between it and the palm."""
    tips = mechanism.tip_positions(T_base_link)
    if not sides[1]:
        return (tips[0] + mechanism.palm_centre) / 2
    return (tips[sides[0]].mean(axis=0) + tips[sides[1]].mean(axis=0)) / 2


def palm_is_behind(
    mechanism: Mechanism, postures: list[Float[Array, "d"]], point: Float[Array, "3"], approach: Float[Array, "3"]
) -> bool:
    """Whether a ray from a point against the approach meets the hand in every posture."""
    for posture in postures:
        caster, _ = _caster(mechanism, mechanism.pose(posture))
        reach, _ = caster.cast(point[None], -approach[None])
        if reach[0] < 0:
            return False
    return True


def _caster(mechanism: Mechanism, T_base_link: Float[Array, "l 4 4"]) -> tuple[RayCaster, Array]:
    """The posed hand for rays, and the link of each face."""
    links = mechanism.hand.links
    meshes = [transformed(link.collision, T) for link, T in zip(links, T_base_link, strict=True)]
    return RayCaster(concatenate(meshes)), np.repeat(np.arange(len(links)), [len(mesh.faces) for mesh in meshes])


def side_gap(
    mechanism: Mechanism, posture: Float[Array, "d"], sides: tuple[list[int], list[int]], closing: Float[Array, "3"]
) -> float:
    """Width between the two sides along the closing axis [m]."""
    return _gap(mechanism, posture, sides, closing)[0]


def _gap(
    mechanism: Mechanism, posture: Float[Array, "d"], sides: tuple[list[int], list[int]], closing: Float[Array, "3"]
) -> tuple[float, Float[Array, "3"]]:
    """Width between the two sides along the closing axis [m], and the middle of their innermost points."""
    T = mechanism.pose(posture)
    tips = mechanism.tip_positions(T)
    if not sides[1]:
        return _gap_to_palm(mechanism, T, closing)
    sign = np.sign((tips[sides[1]].mean(axis=0) - tips[sides[0]].mean(axis=0)) @ closing) or 1.0
    inner = [[], []]
    reach = []
    for side, towards in ((0, sign), (1, -sign)):
        points = [mechanism.holding_points(f, T) for f in sides[side]]
        depth = [towards * p @ closing for p in points]
        inner[side] = [p[d > d.max() - INNERMOST].mean(axis=0) for p, d in zip(points, depth, strict=True)]
        reach.append(max(d.max() for d in depth))
    centre = (np.mean(inner[0], axis=0) + np.mean(inner[1], axis=0)) / 2
    return -float(reach[0] + reach[1]), centre


def _tip_gap(
    mechanism: Mechanism, posture: Float[Array, "d"], sides: tuple[list[int], list[int]], closing: Float[Array, "3"]
) -> float:
    """Width between the very tips of the two sides along the closing axis [m]."""
    T = mechanism.pose(posture)
    if not sides[1]:
        return _gap_to_palm(mechanism, T, closing)[0]
    points = mechanism.tip_points(T)
    one, other = (np.concatenate([points[f] for f in side]) @ closing for side in sides)
    return float(max(other.min() - one.max(), one.min() - other.max()))


def _gap_to_palm(
    mechanism: Mechanism, T_base_link: Float[Array, "l 4 4"], closing: Float[Array, "3"]
) -> tuple[float, Float[Array, "3"]]:
    """Of a single jaw: from the inside of its tip along the closing axis to the fixed one, and the middle [m]."""
    tip, links = mechanism.tip_points(T_base_link)[0], mechanism.hand.links
    palm = [transformed(links[i].collision, T_base_link[i]) for i in mechanism.palm_links]
    ways = np.stack([closing, -closing])
    starts = np.stack([tip.mean(axis=0) + (np.max((tip - tip.mean(axis=0)) @ way)) * way for way in ways])
    reach, _ = RayCaster(concatenate(palm)).cast(starts, ways)
    reach = np.where(reach < 0, np.inf, reach)
    side = int(np.argmin(reach))
    if not np.isfinite(reach[side]):
        return 0.0, tip.mean(axis=0)
    return float(reach[side]), starts[side] + reach[side] / 2 * ways[side]


def _on_axes(point: Float[Array, "3"], approach: Float[Array, "3"], slack: float) -> Float[Array, "3"]:
    """The point, its small components across the approach left out: hands are built about their axes."""
    is_across = np.abs(approach) < 0.5
    return np.where(is_across & (np.abs(point) < slack), 0.0, point)


def _behind_which_is_palm(
    mechanism: Mechanism, postures: list[Float[Array, "d"]], point: Float[Array, "3"], approach: Float[Array, "3"]
) -> Float[Array, "3"]:
    """The point, moved across the approach towards the palm's centre until the palm is behind it."""
    back = mechanism.palm_centre - point
    back -= (back @ approach) * approach
    few = [postures[0], postures[len(postures) // 2]]
    for share in np.linspace(0, 1, WAY_BACK):
        moved = point + share * back
        if palm_is_behind(mechanism, few, moved, approach):
            return np.round(moved, 4) + 0.0
    raise GraspmatchError(
        f"{mechanism.description.path}: no palm is found behind the fingertips, so the approach cannot be told. Is the "
        "palm's geometry missing? Give the link that carries it with --root, or write the card by hand."
    )


def _most_common(normals: Float[Array, "n 3"]) -> Float[Array, "3"]:
    """The direction about which most normals lie: a palm is flat or hollow, with bevels and screws that are not."""
    tried = np.concatenate([np.eye(3), -np.eye(3), fibonacci_directions(RAYS)])
    return tried[np.argmax(np.sum(np.maximum(tried @ normals.T, 0.0) ** SHARPNESS, axis=1))]


def _snapped(axis: Float[Array, "3"]) -> Float[Array, "3"]:
    """Unit vector, along an axis of the frame where it is near to one."""
    unit = axis / np.linalg.norm(axis)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) < SNAP:
        return np.round(unit, 3) / np.linalg.norm(np.round(unit, 3))
    return np.sign(unit[k]) * np.eye(3)[k] + 0.0
