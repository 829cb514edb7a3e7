"""The hand that a command is about."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspmatch.apps.options import Plan
from graspmatch.apps.speech import Speech
from graspmatch.config import BakingConfig, PlannerConfig
from graspmatch.ranges import check_ranges
from graspmatch.types import Gripper


@dataclass(frozen=True)
class Hand:
    """A gripper, and where its links are."""

    gripper: Gripper
    link_poses: Callable[[Float[np.ndarray, "d"]], Float[np.ndarray, "l 4 4"]]
    """Driven joint values to the poses of `gripper.links` in the gripper frame."""


def hand_of(command: Plan, config: PlannerConfig, say: Speech) -> Hand:
    """The hand of a plan."""
    baking = BakingConfig()
    if command.approach_distance is not None:
        check_ranges([("approach_distance", command.approach_distance, 0.01, 0.5)])
        baking = replace(baking, approach_distance=command.approach_distance)
    return load_hand(command.gripper, command.description, config, say, baking)


def load_hand(
    name: str, description: Path | None, config: PlannerConfig, say: Speech, baking: BakingConfig | None = None
) -> Hand:
    """The hand, once it is known that there is one of this name and a device to plan on."""
    from graspmatch.gripper import kinematics
    from graspmatch.gripper.load import load_gripper
    from graspmatch.gripper.zoo import card_path
    from graspmatch.kernels.launch import resolve_device

    card = card_path(name)
    resolve_device(config.device)
    with say.progress(f"Loading {name} (the first time, its preshapes are computed)"):
        gripper = load_gripper(name, description=description, baking=baking)
        model = kinematics.load_hand(card, description)
    return Hand(gripper, lambda joints: kinematics.pose_links(model, joints))
