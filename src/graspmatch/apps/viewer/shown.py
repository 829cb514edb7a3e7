"""What a page shows, and what its pickers choose from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from graspmatch.apps.hand import Hand
from graspmatch.apps.viewer.contacts import Contacts, contacts_of
from graspmatch.apps.viewer.motion import completed
from graspmatch.config import PlannerConfig
from graspmatch.kernels.launch import resolve_device
from graspmatch.planner.plan import plan
from graspmatch.planner.recording import Recording
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet

Array = np.ndarray


@dataclass(frozen=True)
class Shown:
    """A scene, a hand, and grasps of it."""

    hand: Hand
    grasps: GraspSet
    scene: Scene | None
    """None where a file of grasps was given without its object."""
    recording: Recording
    """Empty where the grasps come from a file."""
    contacts: tuple[Contacts, ...]
    """Of each grasp; empty without a scene."""

    @property
    def up(self) -> Float[Array, "3"]:
        """Unit vector along which objects are lifted."""
        table = self.scene.table if self.scene is not None else None
        return np.array([0.0, 0.0, 1.0]) if table is None else table.normal


@dataclass(frozen=True)
class Catalogue:
    """What can be chosen on the page, by name; a hand or a scene is loaded when it is."""

    hands: Mapping[str, Callable[[], Hand]]
    scenes: Mapping[str, Callable[[], Scene]]
    config: PlannerConfig


def shown_of(hand: Hand, grasps: GraspSet, scene: Scene | None, recording: Recording, device: str) -> Shown:
    """Grasps made ready to be looked at."""
    grasps = completed(grasps, hand.gripper)
    contacts = [] if scene is None else contacts_of(scene, hand.gripper, grasps, resolve_device(device))
    return Shown(hand, grasps, scene, recording, tuple(contacts))


def planned(catalogue: Catalogue, hand: str, scene: str, seed: int, count: int) -> Shown:
    """Plan for a hand and a scene of the catalogue, and keep what happens on the way."""
    config = replace(catalogue.config, seed=seed, ranking=replace(catalogue.config.ranking, count=count))
    recording = Recording()
    the_hand, the_scene = catalogue.hands[hand](), catalogue.scenes[scene]()
    grasps = plan(the_scene, the_hand.gripper, config, recording=recording)
    return shown_of(the_hand, grasps, the_scene, recording, config.device)
