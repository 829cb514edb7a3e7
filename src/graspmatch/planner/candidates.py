"""What passes from stage to stage: poses of preshapes, and what was found out about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float, Int

Array = np.ndarray


@dataclass(frozen=True)
class Candidates:
    """n poses of the hand in one of its preshapes."""

    preshape: Int[Array, "n"]
    T_world_gripper: Float[Array, "n 4 4"]

    def __len__(self) -> int:
        return len(self.preshape)

    def select(self, keep: Array) -> Self:
        """The candidates of a mask or an index array."""
        return type(self)(**{name: values[keep] for name, values in vars(self).items()})


@dataclass(frozen=True)
class Matched(Candidates):
    """After Algorithm 1."""

    matching_error: Float[Array, "n"]
    """Eq. (14) over all samples [m2]."""
    loss: Float[Array, "n"]
    """Eq. (13) [m2]."""
    is_free: Array
    """Whether nothing of C is inside the hand; many that are not get free by opening or backing off."""


@dataclass(frozen=True)
class Free(Matched):
    """After the collision stage: hand and approach are clear; `preshape` is the posture to arrive with."""

    matched_preshape: Int[Array, "n"]
    """The preshape that was matched, the same or a narrower one."""
    clearance: Float[Array, "n"]
    retreat: Float[Array, "n"]
    """How far the match was backed off along its approach [m]."""


@dataclass(frozen=True)
class Closed(Free):
    """After closing the fingers."""

    closing_fraction: Float[Array, "n f"]
    """Where on its closing motion each finger first meets the object; above 1 where it never does."""
    grasp_joints: Float[Array, "n d"]


@dataclass(frozen=True)
class Graded(Closed):
    """After judging what the closed fingers hold."""

    error: Float[Array, "n"]
    """Eq. (14) of the matched preshape at the final pose [m2]."""
    final_loss: Float[Array, "n"]
    """Eq. (13) there [m2]."""
    clear_share: Float[Array, "n"]
    """Share of arrivals, as planned or a little displaced, in which the hand meets nothing on its way in."""
    margin: Float[Array, "n"]
    """Smallest wrench that is not resisted in the end, the mean over all trials: see `hold.Held`, `grade.grade`."""
    held_share: Float[Array, "n"]
    """Share of the trials in which the object is held."""
    standing: Float[Array, "n"]
    """The mean margin as the fingers meet the object, before it turns, for a hand that presses no harder than two
    fingers of one drive."""
    contacts: Float[Array, "n"]
    """Of fingers and palm in the end, at most five of each: the mean over all trials."""
    seen_share: Float[Array, "n"]
    """How sure it is that the surface is there that the fingers touch: 1 where it was seen, see `grade.sure_of`."""
    tries: Int[Array, "n"]
    """How many trials that were."""
    confidence: Float[Array, "n"]
    """Share of such grasps that hold in simulation once the hand has arrived."""

    @property
    def sureness(self) -> Float[Array, "n"]:
        """Share of such grasps that arrive, find what they are to touch, and hold, though some come a little
        displaced."""
        return self.clear_share * self.seen_share * self.confidence
