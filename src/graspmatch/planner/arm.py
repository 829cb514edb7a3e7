"""Whether a robot's arm reaches: inverse kinematics of many hands at once, along straight ways.

MuJoCo reads the description; positions and Jacobians are then computed here for all candidates together, which is some
ten times faster than one after the other. The arm may collide with anything, itself included: that is not looked at.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from graspmatch.geometry import se3
from graspmatch.types import GraspmatchError, Gripper

Array = np.ndarray

POSITION_TOLERANCE, ANGLE_TOLERANCE = 5e-4, 5e-3
"""[m], [rad]"""
DAMPING = 0.02
"""Of the least-squares steps."""
LONGEST_STEP = 0.4
"""Of a joint in one iteration [rad or m]."""
ITERATIONS, STARTS = 25, 4
"""Of one attempt, and attempts from other joint values, the first one from the middle of the limits."""
WAY_STEPS = 4
"""Poses between two that are given; the arm must follow through all of them ..."""
WAY_ITERATIONS = 12
LARGEST_JUMP = 0.6
"""... without moving a joint by more than this from one to the next [rad or m]."""


@dataclass(frozen=True, eq=False)
class Arm:
    """The joints from a robot's base to its tip, and where hand and base are. Called with ways, it says which it can
    go; so it can be the `reach` of `plan`."""

    name: str
    joint_names: tuple[str, ...]
    T_world_base: Float[Array, "4 4"]
    """Pose of the root of the description in the world."""
    T_tip_gripper: Float[Array, "4 4"]
    T_parent_body: Float[Array, "b 4 4"]
    """Of the bodies of the chain, from the base outwards, with all joints at zero."""
    body: Int[Array, "d"]
    """The body that each joint moves, in the order of the chain."""
    axis: Float[Array, "d 3"]
    anchor: Float[Array, "d 3"]
    """A point on the axis [m], both in the frame of the body."""
    is_slide: Bool[Array, "d"]
    lower: Float[Array, "d"]
    upper: Float[Array, "d"]

    @classmethod
    def read(
        cls,
        path: Path | str,
        gripper: Gripper,
        *,
        tip: str | None = None,
        T_world_base: Float[Array, "4 4"] | None = None,
        T_tip_gripper: Float[Array, "4 4"] | None = None,
    ) -> Arm:
        """The arm of a URDF or MJCF file; a URDF may lack its meshes.

        tip: link that the hand is mounted on; without one, the base link of the hand, if the robot has it.
        T_world_base: pose of the root of the description; by default the world is the robot's.
        T_tip_gripper: pose of the gripper frame on the tip; by default they are the same.
        """
        path = Path(path)
        model = _kinematic_model(path)
        names = [model.body(i).name for i in range(model.nbody)]
        tip = gripper.base_link if tip is None else tip
        if tip not in names:
            known = ", ".join(name for name in names if name)
            raise GraspmatchError(f"{path.name} has no link '{tip}' that a hand could be mounted on. Known: {known}.")
        return _chain(
            path,
            model,
            names.index(tip),
            np.eye(4) if T_world_base is None else T_world_base,
            np.eye(4) if T_tip_gripper is None else T_tip_gripper,
        )

    def __call__(self, T_world_gripper: Float[Array, "n k 4 4"]) -> Bool[Array, "n"]:
        """Whether the arm can take the gripper frame through each of n ways of k poses."""
        return np.all(np.isfinite(self.follow(T_world_gripper)), axis=(1, 2))

    def follow(self, T_world_gripper: Float[Array, "n k 4 4"], seed: int = 0) -> Float[Array, "n k d"]:
        """Joint values at the k poses of each way, reached one after the other on straight lines; NaN where the arm
        cannot follow. Poses of the middle of the way are looked for first, from several starts."""
        n, k = T_world_gripper.shape[:2]
        goals = se3.inverse(self.T_world_base) @ T_world_gripper @ se3.inverse(self.T_tip_gripper)
        found = np.full((n, k, len(self.joint_names)), np.nan)
        rng = np.random.default_rng(seed)
        low, high = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        left = np.flatnonzero(np.linalg.norm(goals[..., :3, 3], axis=-1).max(axis=1) < self.longest)
        for start in range(STARTS):
            if len(left) == 0:
                break
            first = (low + high) / 2 if start == 0 else rng.uniform(low, high)  # the same for all: each way is alone
            q = np.tile(first, (len(left), 1))
            found[left] = self._along(goals[left], q)
            left = left[np.isnan(found[left]).any(axis=(1, 2))]
        found[left] = np.nan
        return found

    @property
    def longest(self) -> float:
        """No pose of the tip is farther from the base than this [m]."""
        slides = np.maximum(np.abs(self.lower), np.abs(self.upper))[self.is_slide]
        return float(np.linalg.norm(self.T_parent_body[:, :3, 3], axis=-1).sum() + slides.sum())

    def tip(self, q: Float[Array, "n d"]) -> Float[Array, "n 4 4"]:
        """T_base_tip for n sets of joint values."""
        return self._forward(q)[0]

    def _along(self, goals: Float[Array, "n k 4 4"], q: Float[Array, "n d"]) -> Float[Array, "n k d"]:
        """Joint values along the ways, from starts for the middle pose outwards; NaN from where they are lost."""
        k = goals.shape[1]
        found = np.full((*goals.shape[:2], q.shape[1]), np.nan)
        middle = k // 2
        found[:, middle] = self._solve(goals[:, middle], q, ITERATIONS)
        for step, stop in ((-1, -1), (1, k)):
            at = found[:, middle]
            for j in range(middle + step, stop, step):
                for share in np.linspace(0, 1, WAY_STEPS + 1)[1:]:
                    goal = _between(goals[:, j - step], goals[:, j], share)
                    after = self._solve(goal, at, WAY_ITERATIONS)
                    jumps = np.abs(after - at).max(axis=1) > LARGEST_JUMP
                    at = np.where(jumps[:, None], np.nan, after)
                found[:, j] = at
        return found

    def _solve(self, goal: Float[Array, "n 4 4"], q: Float[Array, "n d"], iterations: int) -> Float[Array, "n d"]:
        """Damped least squares within the limits; NaN where the tip does not get to its goal."""
        result = np.full_like(q, np.nan)
        left = np.flatnonzero(np.isfinite(q).all(axis=1))
        q = q[left]
        for _ in range(iterations + 1):
            T, jacobian = self._forward(q)
            error = np.concatenate([goal[left, :3, 3] - T[:, :3, 3], _turn(goal[left, :3, :3], T[:, :3, :3])], axis=1)
            there = np.linalg.norm(error[:, :3], axis=1) < POSITION_TOLERANCE
            there &= np.linalg.norm(error[:, 3:], axis=1) < ANGLE_TOLERANCE
            result[left[there]] = q[there]
            left, q, error, jacobian = left[~there], q[~there], error[~there], jacobian[~there]
            if len(left) == 0:
                break
            square = jacobian @ np.swapaxes(jacobian, 1, 2) + DAMPING**2 * np.eye(6)
            step = np.einsum("nij,ni->nj", jacobian, np.linalg.solve(square, error[..., None])[..., 0])
            step *= np.minimum(1.0, LONGEST_STEP / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-9))
            q = np.clip(q + step, self.lower, self.upper)
        return result

    def _forward(self, q: Float[Array, "n d"]) -> tuple[Float[Array, "n 4 4"], Float[Array, "n 6 d"]]:
        """T_base_tip, and its motion by each joint: of its origin [m], and its turn [rad], base frame."""
        n, d = q.shape
        R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        axes, anchors = np.zeros((n, d, 3)), np.zeros((n, d, 3))
        for i, T in enumerate(self.T_parent_body):
            R, p = R @ T[:3, :3], p + R @ T[:3, 3]
            for j in np.flatnonzero(self.body == i):
                axes[:, j], anchors[:, j] = R @ self.axis[j], p + R @ self.anchor[j]
                if self.is_slide[j]:
                    p = p + q[:, j, None] * axes[:, j]
                else:
                    R = R @ _turned(self.axis[j], q[:, j])
                    p = anchors[:, j] - R @ self.anchor[j]
        moved = np.where(self.is_slide[:, None], axes, np.cross(axes, p[:, None] - anchors))
        turned = np.where(self.is_slide[:, None], 0.0, axes)
        return se3.from_parts(R, p), np.swapaxes(np.concatenate([moved, turned], axis=2), 1, 2)


def _chain(
    path: Path, model: mujoco.MjModel, tip: int, T_world_base: Float[Array, "4 4"], T_tip_gripper: Float[Array, "4 4"]
) -> Arm:
    """The joints between the root and a body."""
    bodies = [tip]
    while model.body_parentid[bodies[0]] != 0:
        bodies.insert(0, int(model.body_parentid[bodies[0]]))
    joints = [j for body in bodies for j in range(model.njnt) if model.jnt_bodyid[j] == body]
    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    others = [model.joint(j).name for j in joints if model.jnt_type[j] not in (hinge, slide)]
    if others:
        raise GraspmatchError(f"{path.name}: joint '{others[0]}' is no hinge and no slide; an arm has no others.")
    if not joints:
        raise GraspmatchError(
            f"{path.name}: no joint moves the link '{model.body(tip).name}'; name a link farther out."
        )
    limited = model.jnt_limited[joints].astype(bool)
    zero = model.qpos0[model.jnt_qposadr[joints]]
    return Arm(
        name=path.stem,
        joint_names=tuple(model.joint(j).name for j in joints),
        T_world_base=T_world_base,
        T_tip_gripper=T_tip_gripper,
        T_parent_body=se3.from_parts(se3.matrix_from_quaternion(model.body_quat[bodies]), model.body_pos[bodies]),
        body=np.array([bodies.index(int(model.jnt_bodyid[j])) for j in joints]),
        axis=model.jnt_axis[joints].copy(),
        anchor=model.jnt_pos[joints].copy(),
        is_slide=model.jnt_type[joints] == slide,
        lower=np.where(limited, model.jnt_range[joints, 0] - zero, -2 * np.pi),
        upper=np.where(limited, model.jnt_range[joints, 1] - zero, 2 * np.pi),
    )


def _kinematic_model(path: Path) -> mujoco.MjModel:
    """The description without geometry: meshes need not be there."""
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise GraspmatchError(f"Cannot read the robot {path}: {error}.") from error
    try:
        if root.tag != "robot":
            return mujoco.MjModel.from_xml_path(str(path))
        for link in root.iter("link"):
            for part in [*link.findall("visual"), *link.findall("collision")]:
                link.remove(part)
        for extension in root.findall("mujoco"):
            root.remove(extension)
        extension = ElementTree.Element("mujoco")
        ElementTree.SubElement(extension, "compiler", fusestatic="false", balanceinertia="true")
        root.insert(0, extension)
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-12
        return spec.compile()
    except ValueError as error:
        raise GraspmatchError(f"MuJoCo cannot read the robot {path}: {' '.join(str(error).split())}") from error


def _between(a: Float[Array, "n 4 4"], b: Float[Array, "n 4 4"], share: float) -> Float[Array, "n 4 4"]:
    """A pose on the straight line from one to another; ways do not turn much."""
    turn = _turn(b[:, :3, :3], a[:, :3, :3])
    rotation = se3.rotation_exp(share * turn) @ a[:, :3, :3]
    return se3.from_parts(rotation, (1 - share) * a[:, :3, 3] + share * b[:, :3, 3])


def _turned(axis: Float[Array, "3"], angle: Float[Array, "n"]) -> Float[Array, "n 3 3"]:
    """Rotations about an axis by angles [rad], by the formula of Rodrigues."""
    K = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle)[:, None, None] * K + (1 - np.cos(angle))[:, None, None] * (K @ K)


def _turn(goal: Float[Array, "n 3 3"], now: Float[Array, "n 3 3"]) -> Float[Array, "n 3"]:
    """Rotation vector that turns one rotation into the other [rad]."""
    wxyz = se3.quaternion_from_matrix(goal @ np.swapaxes(now, 1, 2))
    wxyz = np.where(wxyz[:, :1] < 0, -wxyz, wxyz)
    sine = np.linalg.norm(wxyz[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, wxyz[:, :1])
    return wxyz[:, 1:] * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)
