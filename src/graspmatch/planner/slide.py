"""Fingers that meet the object one after the other push it, until they balance or all have met it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.config import GripConfig
from graspmatch.geometry import se3
from graspmatch.planner.candidates import Candidates
from graspmatch.planner.contacts import Contacts, Touchable, contacts_of
from graspmatch.types import Gripper

Array = np.ndarray

STEP = 0.002
"""Of the object [m]."""
STEPS = 15
"""At most: an object that is pushed by more than 3 cm is elsewhere than planned in any case."""
BALANCED = 0.35
"""Pushes of one finger each whose sum is shorter than this are held by friction."""
SLACK = 0.01
"""Closing fraction within which fingers count as touching together."""


def slide(
    candidates: Candidates, target: Touchable, gripper: Gripper, config: GripConfig, device: str
) -> Float[Array, "n 3"]:
    """How far the closing fingers push the object, without turning it [m], gripper frame.

    Quasi-static: all fingers close at one pace; those that touch carry the object along the sum of their pushes, never
    down, until the others touch, the pushes cancel, or the fingers are closed.
    """
    pushed = np.zeros((len(candidates), 3))
    if not len(candidates):
        return pushed
    moving = np.arange(len(candidates))
    reached = np.zeros(len(candidates))
    touches = np.ones((len(candidates), len(gripper.fingers)), dtype=bool)
    up_gripper = -target.down @ candidates.T_world_gripper[:, :3, :3]
    for _ in range(STEPS):
        T_world_gripper = candidates.T_world_gripper[moving] @ se3.translation(-pushed[moving])
        contacts = contacts_of(
            Candidates(candidates.preshape[moving], T_world_gripper), target, gripper, config, device
        )
        fraction = contacts.fraction
        # The fingers that touch have followed the object; at first, all are on their way.
        followed = np.minimum(np.where(touches[moving], fraction, np.inf).min(axis=-1), 1.0)
        reached[moving] = np.maximum(reached[moving], followed)
        touching = (fraction <= reached[moving, None] + SLACK) & (fraction <= 1)
        touches[moving] = touching
        total = (finger_pushes(contacts) * touching[..., None]).sum(axis=1)
        strength = np.linalg.norm(total, axis=-1)
        count = touching.sum(axis=-1)
        all_touch = (count > 1) & (count >= np.sum(fraction <= 1, axis=-1))
        goes_on = (strength > BALANCED) & (reached[moving] < 1) & ~all_touch
        moving = moving[goes_on]
        if not len(moving):
            break
        step = STEP * total[goes_on] / strength[goes_on, None]
        up = up_gripper[moving]
        step -= np.minimum(np.sum(step * up, axis=-1), 0.0)[:, None] * up  # the table is in the way
        pushed[moving] += step
    return pushed


def finger_pushes(contacts: Contacts) -> Float[Array, "n f 3"]:
    """Mean push of each finger's contacts; zero where it has none."""
    fingers = contacts.fraction.shape[1]
    count = contacts.count[:, :fingers]
    is_contact = np.arange(contacts.push.shape[2]) < count[..., None]
    total = np.sum(contacts.push[:, :fingers] * is_contact[..., None], axis=2)
    return total / np.maximum(count, 1)[..., None]
