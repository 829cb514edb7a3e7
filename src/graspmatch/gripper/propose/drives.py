"""Which joints motors move, which follow, and how: from actuators, transmissions, equalities, or else by experience."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from graspmatch.gripper.card import Coupling
from graspmatch.gripper.propose.tree import Branch, Tree

Array = np.ndarray

FEW_FINGERS = 3
"""Hands of so many fingers mostly drive each finger at its base, where the file does not say; others drive all."""
FOLLOWER_SHARE = 0.4
"""What an underactuated joint is taken to turn while its finger closes on nothing, as a share of the one that is
driven."""
PARALLEL = 0.9
"""Cosine between the axes of joints that curl the same finger."""


@dataclass
class Drives:
    """Joints by their indices in the model."""

    driven: list[int] = field(default_factory=list)
    couplings: dict[int, tuple[int, float, float]] = field(default_factory=dict)
    """Follower to driven joint, multiplier and offset, where the description does not couple them."""
    passive: list[int] = field(default_factory=list)
    """Left to springs, or to nothing."""
    reasons: dict[int, str] = field(default_factory=dict)
    """Why, for each joint that is driven or coupled here."""

    def named(self, model: mujoco.MjModel) -> dict[str, Coupling]:
        """The couplings as a card has them."""
        return {
            model.joint(follower).name: Coupling(model.joint(leader).name, multiplier, offset)
            for follower, (leader, multiplier, offset) in self.couplings.items()
        }


def find_drives(model: mujoco.MjModel, files: tuple[Path, ...], tree: Tree) -> Drives:
    """The drives of a hand, fingers and wrist."""
    joints = [j for branch in tree.branches for j in branch.joints]
    everything = [*tree.wrist, *joints]
    dofs = constraint_dofs(model)
    actuated = actuators(model, everything)
    transmitted = transmissions(files[0], model, everything)
    found = Drives()
    if actuated or transmitted:
        _by_actuators(found, model, dofs, actuated or [[j] for j in transmitted])
        why = "an actuator moves it" if actuated else "a transmission moves it"
        found.reasons |= {j: why for j in found.driven}
        _hold_loose_ends(found, model, dofs, tree.branches)
    else:
        _by_experience(found, model, dofs, tree)
    found.driven.sort(key=everything.index)
    known = {*found.driven, *found.couplings}
    found.passive = [j for j in everything if j not in known and not _is_dictated(model, dofs, known, j)]
    return found


def actuators(model: mujoco.MjModel, joints: Iterable[int]) -> list[list[int]]:
    """For each actuator of the hand the joints that it moves, strongest lever first."""
    wanted, found = set(joints), []
    for row in actuator_moments(model):
        moved = [int(model.dof_jntid[v]) for v in np.flatnonzero(np.abs(row) > 1e-9)]
        if moved and wanted.issuperset(moved):
            found.append(moved)
    return found


def actuator_moments(model: mujoco.MjModel) -> Float[Array, "a v"]:
    """What each actuator does to each dof, for one newton of its own, at the description's zero."""
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    moment = np.zeros((model.nu, model.nv))
    if model.nu:
        rows = (data.moment_rownnz, data.moment_rowadr, data.moment_colind)
        mujoco.mju_sparse2dense(moment, data.actuator_moment, *rows)
    return moment


def transmissions(path: Path, model: mujoco.MjModel, joints: Iterable[int]) -> list[int]:
    """The joints that the transmissions or the ros2_control section of a URDF name."""
    root = ElementTree.parse(path).getroot()
    if root.tag != "robot":
        return []
    inside = [*root.iter("transmission"), *root.iter("ros2_control")]
    named = {joint.get("name") for element in inside for joint in element.iter("joint")}
    # A joint that only reports its state is named too.
    silent = {
        joint.get("name")
        for element in root.iter("ros2_control")
        for joint in element.iter("joint")
        if joint.find("command_interface") is None
    }
    return [j for j in joints if model.joint(j).name in named - silent]


def constraint_dofs(model: mujoco.MjModel) -> Float[Array, "r v"]:
    """How the description's equalities tie the dofs, as rows, at its zero."""
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    return data.efc_J.reshape(-1, model.nv)[rows]


def _rank(matrix: Float[Array, "r v"]) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=1e-6)) if matrix.size else 0


def _is_free_besides(model: mujoco.MjModel, dofs: Float[Array, "r v"], known: Iterable[int], joint: int) -> bool:
    """Whether a joint may still be chosen once others are known: the rest can meet the equalities all the same."""
    held = [int(model.jnt_dofadr[j]) for j in [*known, joint]]
    return _rank(np.delete(dofs, held, axis=1)) == _rank(dofs)


def _is_dictated(model: mujoco.MjModel, dofs: Float[Array, "r v"], known: Iterable[int], joint: int) -> bool:
    """Whether the equalities give a joint's value once others are known."""
    free = [v for v in range(model.nv) if v not in {int(model.jnt_dofadr[j]) for j in known}]
    column = int(model.jnt_dofadr[joint])
    if column not in free:
        return True
    unit = np.eye(model.nv)[column][free]
    return _rank(np.vstack([dofs[:, free], unit])) == _rank(dofs[:, free])


def _by_actuators(found: Drives, model: mujoco.MjModel, dofs: Float[Array, "r v"], actuated: list[list[int]]) -> None:
    """One driven joint for each actuator; other joints that it moves follow in proportion to their ranges."""
    for moved in actuated:
        moved = [j for j in moved if j not in found.couplings]
        leader = next((j for j in moved if j in found.driven or _is_free_besides(model, dofs, found.driven, j)), None)
        if leader is None:
            continue
        if leader not in found.driven:
            found.driven.append(leader)
        for j in moved:
            if j not in found.driven and _is_free_besides(model, dofs, [*found.driven, *found.couplings], j):
                found.couplings[j] = _in_proportion(model, j, leader, share=None)
                found.reasons[j] = f"one actuator moves it and {model.joint(leader).name}"


def _hold_loose_ends(
    found: Drives, model: mujoco.MjModel, dofs: Float[Array, "r v"], branches: tuple[Branch, ...]
) -> None:
    """Joints that nothing moves and no spring holds follow the driven joint before them, as by a tendon."""
    for branch in branches:
        leader = None
        for j in branch.joints:
            if j in found.driven:
                leader = j
            known = [*found.driven, *found.couplings]
            is_tied = bool(np.any(dofs[:, model.jnt_dofadr[j]]))
            is_loose = j not in known and not is_tied and not model.jnt_stiffness[j].any()
            if leader is not None and is_loose:
                found.couplings[j] = _in_proportion(model, j, leader, share=FOLLOWER_SHARE)
                found.reasons[j] = "nothing moves it: taken as underactuated"


def _by_experience(found: Drives, model: mujoco.MjModel, dofs: Float[Array, "r v"], tree: Tree) -> None:
    """A file that names no motors: its free joints, or in hands of few fingers the first of each finger that curls."""
    for j in tree.wrist:
        found.driven.append(j)
        found.reasons[j] = "a joint of the wrist"
    curled: list[tuple[int, int]] = []
    for branch in tree.branches:
        for j in branch.joints:
            if model.jnt_stiffness[j].any() or not _is_free_besides(model, dofs, found.driven, j):
                continue
            before = [k for k in branch.joints if k in found.driven and _curl_alike(model, k, j)]
            if before:
                curled.append((j, before[0]))
            found.driven.append(j)
            found.reasons[j] = "no other joint moves it"
    fingers = sum(any(j in found.driven for j in branch.joints) for branch in tree.branches)
    if fingers > FEW_FINGERS:
        return
    for j, leader in curled:
        found.driven.remove(j)
        found.couplings[j] = _in_proportion(model, j, leader, share=FOLLOWER_SHARE)
        found.reasons[j] = "the file names no motors: taken as underactuated, as in most hands of few fingers"


def _curl_alike(model: mujoco.MjModel, first: int, second: int) -> bool:
    """Whether two hinges of a finger turn about parallel axes."""
    if any(model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE for j in (first, second)):
        return False
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return abs(float(data.xaxis[first] @ data.xaxis[second])) > PARALLEL


def _in_proportion(model: mujoco.MjModel, follower: int, leader: int, share: float | None) -> tuple[int, float, float]:
    """Leader, multiplier and offset that take the follower over its range while the leader goes over its own.

    Not more than `share` of it, if given, from the description's zero; both ways if their axes look opposite ways.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    is_alike = float(data.xaxis[follower] @ data.xaxis[leader]) >= 0 or not _curl_alike(model, follower, leader)
    (low, high), (own_low, own_high) = model.jnt_range[leader], model.jnt_range[follower]
    span, own_span = (r[1] - r[0] if r[1] - r[0] > 0 else np.pi for r in ((low, high), (own_low, own_high)))
    sign = 1.0 if is_alike else -1.0
    if share is None:
        multiplier = sign * own_span / span
        return leader, float(multiplier), float(own_low - multiplier * (low if is_alike else high))
    multiplier = sign * min(own_span / span, share)
    # The leader's zero is the follower's, as far as that may go there.
    home = model.qpos0[model.jnt_qposadr[[leader, follower]]]
    return leader, float(multiplier), float(home[1] - multiplier * home[0])
