"""A guess of the force that a fingertip can press with, from what the description says of its motors."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
from jaxtyping import Float

from graspmatch.gripper.kinematics import solve_posture
from graspmatch.gripper.propose.closing import Roles
from graspmatch.gripper.propose.drives import actuator_moments
from graspmatch.gripper.propose.posing import Mechanism

Array = np.ndarray

UNKNOWN = 15.0
"""Where the description says nothing [N]."""
LEAST, MOST = 3.0, 40.0
"""Outside of this a description is not believed [N]: efforts are often left at 0, 100 or 1000."""
SHARE = 0.8
"""Of what the motors could: a hand does not press with all it has."""


def guess_force(
    mechanism: Mechanism, roles: Roles, opened: Float[Array, "d"], closed: Float[Array, "d"]
) -> tuple[float, str]:
    """Force of one fingertip [N], and where it is from.

    By virtual work half way between open and closed: the weakest finger, and of it the drive that gives way first.
    """
    middle = (opened + closed) / 2
    efforts = _efforts(mechanism, middle)
    fingers = []
    for f, (link, tip) in enumerate(mechanism.tips):
        forces = []
        for j in np.flatnonzero(roles.closers[f]):
            step = np.zeros(len(middle))
            step[j] = 1e-3
            before, after = mechanism.pose(middle - step)[link], mechanism.pose(middle + step)[link]
            centre = np.append(tip.mean(axis=0), 1.0)
            lever = float(np.linalg.norm((after - before) @ centre)) / 2e-3
            shared = int(roles.closers[:, j].sum())
            if efforts[j] > 0 and lever > 1e-6:
                forces.append(efforts[j] / lever / shared)
        if forces:
            fingers.append(min(forces))
    if not fingers:
        return UNKNOWN, "a guess: the file says nothing about its motors"
    force = SHARE * min(fingers)
    if not LEAST <= force <= MOST:
        believed = float(np.clip(force, LEAST, UNKNOWN))
        return believed, f"a guess: the file's motors would press with {force:.3g} N, which is not believed"
    return float(round(force)), f"{100 * SHARE:.0f} % of what the file's motors can"


def _efforts(mechanism: Mechanism, middle: Float[Array, "d"]) -> Float[Array, "d"]:
    """Largest force or torque of each driven joint [N or N m], zero where it is not known."""
    model = mechanism.description.model
    efforts = np.zeros(len(mechanism.joint_names))
    root = ElementTree.parse(mechanism.description.path).getroot()
    by_limit = {
        joint.get("name"): float(limit.get("effort", 0))
        for joint in root.iter("joint")
        if (limit := joint.find("limit")) is not None
    }
    for i, name in enumerate(mechanism.joint_names):
        j = model.joint(name).id
        efforts[i] = by_limit.get(name, 0.0)
        if model.jnt_actfrclimited[j]:
            efforts[i] = float(np.abs(model.jnt_actfrcrange[j]).max())
    moments = actuator_moments(model)
    for a in np.flatnonzero(model.actuator_forcelimited[: model.nu]):
        most = float(np.abs(model.actuator_forcerange[a]).max())
        for i in range(len(efforts)):
            efforts[i] = max(efforts[i], most * abs(float(moments[a] @ _motion(mechanism, middle, i))))
    return efforts


def _motion(mechanism: Mechanism, driven: Float[Array, "d"], joint: int) -> Float[Array, "v"]:
    """How fast every dof moves for a driven joint that moves at 1, followers included."""
    model, step = mechanism.description.model, np.zeros(len(driven))
    step[joint] = 1e-4
    before, after = (solve_posture(mechanism.hand, driven + s * step) for s in (-1, 1))
    motion = np.zeros(model.nv)
    for j in (model.joint(name).id for name in mechanism.description.joint_names):
        motion[model.jnt_dofadr[j]] = (after - before)[model.jnt_qposadr[j]] / 2e-4
    return motion
