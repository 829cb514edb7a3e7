"""Twelve things of a household made by code, in metres, each at rest on z = 0: a benchmark set without a download."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.se3 import from_parts, rotation_facing
from graspmatch.scene.shapes import Solid, convex, extruded, joined, moved, mug_solid, revolved, swept

Array = np.ndarray

X, Y, Z = np.eye(3)
BULGE = 0.0016
"""How far the convex parts of an object reach beyond its mesh, at most [m]."""
FINE = 96
"""Segments around things that are wide."""


def bottle() -> Solid:
    """A half-litre bottle with its cap on, 65 mm wide and 206 mm high."""
    share = np.linspace(0, 1, 10)[1:-1]
    shoulder = np.stack([13.5 + 19 * (1 + np.cos(np.pi * share)) / 2, 112 + 62 * share], axis=-1)
    foot = [(0, 0), (27, 0), (30.5, 1.5), (32.5, 6), (32.5, 112)]
    neck = [(13.5, 174), (13.5, 182), (15, 182.5), (15, 204), (13, 206), (0, 206)]
    return revolved(_millimetres([*foot, *shoulder, *neck]))


def bowl() -> Solid:
    """A bowl, 150 mm wide and 60 mm high."""
    angle = np.linspace(0, 1.45, 15)
    curve = np.stack([32 + 41 * np.sin(angle), 2 + 64 * (1 - np.cos(angle))], axis=-1)
    return revolved(_shell(_millimetres([(0, 2), *curve]), wall=0.004), FINE)


def box() -> Solid:
    """A packet of tea, 62 x 95 x 135 mm, upright."""
    return convex(_millimetres(list(product((-31, 31), (-47.5, 47.5), (0, 135)))))


def can() -> Solid:
    """A drinks can, 66 mm wide and 122 mm high."""
    foot = [(0, 0), (24, 0), (26, 1), (33, 9), (33, 110)]
    return revolved(_millimetres([*foot, (27.5, 119), (27.5, 121), (26.5, 122), (0, 122)]))


def spray_bottle() -> Solid:
    """A bottle with a spray head whose nozzle points to +x, 76 mm wide and 251 mm high."""
    share = np.linspace(0, 1, 8)[1:-1]
    shoulder = np.stack([14 + 24 * (1 + np.cos(np.pi * share)) / 2, 128 + 46 * share], axis=-1)
    foot = [(0, 0), (34, 0), (38, 4), (38, 128)]
    collar = [(14, 174), (14, 178), (17, 179), (17, 197), (0, 197)]
    body = revolved(_millimetres([*foot, *shoulder, *collar]))
    neck_and_trigger = [(-13, 195), (13, 195), (15, 214), (23, 216), (27, 198), (35, 178), (42, 175), (38, 196)]
    nozzle_and_back = [(35, 219), (38, 222), (58, 224), (58, 241), (22, 251), (-26, 250), (-38, 236), (-18, 222)]
    head = extruded(_millimetres([*neck_and_trigger, *nozzle_and_back]), 0.022)
    return joined([body, moved(head, _frame(-Y, X, (0.0, 0.011, 0.0)))])


def hammer() -> Solid:
    """A joiner's hammer, 288 mm long, on its side: the handle along +x, the head along y, both on the table."""
    from_end = np.array([0, 4, 30, 110, 180, 225, 268]) / 1000
    radius = np.array([10, 13, 12.5, 10.5, 9, 9, 9]) / 1000
    # Each circle stands on the table, so that the handle lies along its whole length.
    path = np.stack([0.275 - from_end, np.zeros(len(radius)), radius], axis=-1)
    handle = swept(path, np.tile(-X, (len(radius), 1)), radius, axis=Z)
    cheeks = _tapered([(-14, 26, 24), (14, 26, 24)])
    peen = _tapered([(13, 26, 22), (52, 26, 5)])
    neck_and_face = [(0, 0), (9, 0), (9, 18), (13, 20), (13, 36), (11.5, 38), (0, 38)]
    face = moved(revolved(_millimetres(neck_and_face)), _frame(-Y, X, (0.0, -0.013, 0.013)))
    return joined([handle, cheeks, peen, face])


def plate() -> Solid:
    """A dinner plate, 240 mm wide and 22 mm high."""
    share = np.linspace(0, 1, 12)
    flank = np.stack([74 + 28 * share, 2 + 15 * (1 - np.cos(np.pi * share)) / 2], axis=-1)
    return revolved(_shell(_millimetres([(0, 2), *flank, (110, 18.2), (118, 20)]), wall=0.004), FINE)


def banana() -> Solid:
    """A banana on its side, 34 mm thick and 185 mm along its curve, the stem at one end."""
    share = np.linspace(0, 1.13, 40)
    body = np.maximum(1 - np.abs(2 * share - 1) ** 2.6, 0) ** 0.55
    radius = np.maximum(0.017 * body, np.interp(share, [0, 0.04, 0.8, 1.1, 1.13], [0.0035, 0.004, 0.004, 0.005, 0.006]))
    angle = np.radians(-50 + 100 * share)
    none = np.zeros(len(share))
    # Each circle stands on the table, as its soft skin does.
    path = np.stack([0.095 * np.cos(angle) - 0.08, 0.095 * np.sin(angle), radius], axis=-1)
    return swept(path, np.stack([-np.sin(angle), np.cos(angle), none], axis=-1), radius, axis=Z)


def ball() -> Solid:
    """A ball, 60 mm wide, with a flat of 6 mm under it, so that it stays where it is."""
    radius, flat = 0.03, 0.003
    angle = np.linspace(-np.arccos(flat / radius), np.pi / 2, 33)
    arc = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    arc[-1, 0] = 0
    return revolved(np.concatenate([[[0.0, arc[0, 1]]], arc]) - [0.0, arc[0, 1]])


def card() -> Solid:
    """A thick card with round corners, 86 x 54 x 3 mm, flat."""
    quarter = np.linspace(0, np.pi / 2, 5)
    corners = [((40, 24), 0), ((-40, 24), 1), ((-40, -24), 2), ((40, -24), 3)]
    arcs = [np.array(centre) + 3 * _circle(quarter + turn * np.pi / 2) for centre, turn in corners]
    return extruded(_millimetres(np.concatenate(arcs)), 0.003)


def letter() -> Solid:
    """A block letter P, 65 x 100 mm and 25 mm thick, on its back."""
    half = np.linspace(-np.pi / 2, np.pi / 2, 17)
    bow = np.array([36, 71]) + 29 * _circle(half)
    eye = np.array([36, 71]) + 10 * _circle(half[::-1])
    outside = [(0, 100), (0, 0), (22, 0), (22, 42), *bow]
    hole = [(22, 81), *eye, (22, 61), (22, 81)]
    outline = _millimetres([*outside, (0, 100), *hole])
    return extruded(outline - outline.mean(axis=0), 0.025)


OBJECTS: dict[str, Callable[[], Solid]] = {
    "mug": mug_solid,
    "bottle": bottle,
    "bowl": bowl,
    "box": box,
    "can": can,
    "spray_bottle": spray_bottle,
    "hammer": hammer,
    "plate": plate,
    "banana": banana,
    "ball": ball,
    "card": card,
    "letter": letter,
}
"""What makes each object, by its name."""


def _millimetres(points: object) -> Float[Array, "k c"]:
    """Points of a drawing in millimetres, in metres."""
    return np.array(points, dtype=np.float64) / 1000


def _circle(angle: Float[Array, "k"]) -> Float[Array, "k 2"]:
    """Points of the unit circle."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _shell(midline: Float[Array, "k 2"], wall: float) -> Float[Array, "n 2"]:
    """The profile of a dish of even thickness [m] whose middle runs from the axis to the rim, which is round."""
    along = np.gradient(midline, axis=0)
    along[:2] = [1.0, 0.0]  # a dish stands on its level middle
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    out = wall / 2 * np.stack([along[:, 1], -along[:, 0]], axis=-1)
    turn = np.linspace(0, np.pi, 7)[1:-1]
    rim = midline[-1] + np.cos(turn)[:, None] * out[-1] + np.sin(turn)[:, None] * wall / 2 * along[-1]
    return np.concatenate([midline + out, rim, (midline - out)[::-1]])


def _tapered(sections: list[tuple[float, float, float]]) -> Solid:
    """A bar along y on z = 0, straight between its upright sections: (y, height, width along x) [mm]."""
    corners = [(x, y, z) for y, height, width in sections for x in (-width / 2, width / 2) for z in (0, height)]
    return convex(_millimetres(corners))


def _frame(z: Float[Array, "3"], x: Float[Array, "3"], origin: tuple[float, float, float]) -> Float[Array, "4 4"]:
    """The frame with these axes at an origin [m]."""
    return from_parts(rotation_facing(z, x), np.array(origin))
