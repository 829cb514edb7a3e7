"""Who touches whom in a state, and how hard."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from graspmatch.simulate.hand import HAND_BIT, OBJECT_BIT, TABLE_BIT
from graspmatch.simulate.world import World


@dataclass(frozen=True)
class Touch:
    """The contacts of the hand."""

    fingers: frozenset[int]
    """Fingers on the object."""
    hand_on_object: bool
    """Any part of the hand, the palm too."""
    press: float
    """Sum of the normal forces between the hand and this and all other objects [N]."""
    hand_on_table: bool
    depth: float
    """Deepest penetration of hand and object [m]."""


NOTHING = Touch(frozenset(), hand_on_object=False, press=0.0, hand_on_table=False, depth=0.0)


def touch(world: World, data: mujoco.MjData) -> Touch:
    """What the hand touches; contacts that carry no force count as none."""
    if not data.ncon:
        return NOTHING
    model = world.model
    geoms = data.contact.geom
    kinds = model.geom_contype[geoms]
    with_hand = np.flatnonzero((kinds == HAND_BIT).any(axis=1))
    fingers, press, depth = set(), 0.0, 0.0
    on_object = on_table = False
    force = np.zeros(6)
    for i in with_hand:
        mujoco.mj_contactForce(model, data, i, force)
        if force[0] <= 0:
            continue
        if TABLE_BIT in kinds[i]:
            on_table = True
        elif OBJECT_BIT in kinds[i]:
            press += force[0]
            bodies = model.geom_bodyid[geoms[i]]
            if world.object_body not in bodies:
                continue
            own = bodies[kinds[i] == HAND_BIT][0]
            fingers.add(int(world.finger_of_body[own]))
            depth = max(depth, -float(data.contact.dist[i]))
            on_object = True
    return Touch(frozenset(fingers - {-1}), on_object, press, on_table, depth)
