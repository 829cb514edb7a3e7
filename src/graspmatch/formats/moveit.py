"""Messages of type `moveit_msgs/Grasp`, as YAML and without ROS: a list of them, with no key that the type lacks.

The pose is that of the end effector's parent link in MoveIt's configuration; `T_parent_gripper` says where our gripper
frame, the hand's base link, is in it. What is left out of a message has the default of its type.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import MOST_GRASPS, one_line
from graspmatch.formats.foreign import Found, foreign_grasps, joint_names_of, joint_table
from graspmatch.formats.native import quaternion_rotation
from graspmatch.formats.yaml_files import read_yaml, write_yaml
from graspmatch.geometry import se3
from graspmatch.types import GraspSet, Gripper

Message = dict[str, Any]

LIFT = 0.2
"""Way up after the grasp [m], as in the simulator's protocol `lift`."""
LEAST_LIFT = 0.1
AXES = ("x", "y", "z")


def write_moveit(
    grasps: GraspSet,
    path: Path,
    gripper: Gripper,
    *,
    frame_id: str = "world",
    T_parent_gripper: Float[np.ndarray, "4 4"] | None = None,
) -> None:
    """Write poses, postures, approach and a lift along the z of `frame_id`, the frame that the grasps are in."""
    if np.isnan(grasps.T_world_pregrasp).any():
        raise GraspmatchError(
            f"Cannot write {path}: where the approach begins is not known. Possible: to read the grasps with the "
            "gripper given."
        )
    T_gripper_parent = np.eye(4) if T_parent_gripper is None else se3.inverse(T_parent_gripper)
    write_yaml([_message(grasps, i, gripper, frame_id, T_gripper_parent) for i in range(len(grasps))], path)


def read_moveit(
    path: Path, gripper: Gripper | None = None, *, T_parent_gripper: Float[np.ndarray, "4 4"] | None = None
) -> GraspSet:
    """Read messages, best first: a list, one alone, or the documents of `rostopic echo`."""
    documents = read_yaml(path)
    if not is_moveit(documents):
        raise GraspmatchError(f"{path} has no messages of type moveit_msgs/Grasp: none has a 'grasp_pose'.")
    return moveit_grasps(documents, path, gripper, T_parent_gripper)


def is_moveit(documents: list[Any]) -> bool:
    """Whether the documents of a file are messages of this type; an empty list is one without any."""
    messages = _messages(documents)
    return documents == [[]] or (
        bool(messages) and all(isinstance(message, dict) and "grasp_pose" in message for message in messages)
    )


def moveit_grasps(
    documents: list[Any],
    path: Path,
    gripper: Gripper | None,
    T_parent_gripper: Float[np.ndarray, "4 4"] | None = None,
) -> GraspSet:
    """The grasps of the documents of a file."""
    messages = _messages(documents)
    if len(messages) > MOST_GRASPS:
        raise GraspmatchError(f"{path} has {len(messages)} grasps, at most {MOST_GRASPS} are read.")
    entries = [_Entry(message, i, path) for i, message in enumerate(messages)]
    frames = sorted({entry.frame_id for entry in entries})
    if len(frames) > 1:
        raise GraspmatchError(f"{path} has grasps in several frames, '{frames[0]}' and '{frames[1]}': one is possible.")
    names = joint_names_of([entry.before | entry.after for entry in entries], path)
    T_parent_gripper = np.eye(4) if T_parent_gripper is None else T_parent_gripper
    found = Found(
        T_world_gripper=np.array([entry.pose for entry in entries]).reshape(-1, 4, 4) @ T_parent_gripper,
        T_world_pregrasp=np.array([entry.pregrasp for entry in entries]).reshape(-1, 4, 4) @ T_parent_gripper,
        score=np.array([entry.quality for entry in entries], dtype=float),
        joint_names=names,
        pregrasp_joints=joint_table([entry.before for entry in entries], names),
        grasp_joints=joint_table([entry.after for entry in entries], names),
    )
    return foreign_grasps(found, path, gripper)


class _Entry:
    """One message, checked."""

    def __init__(self, message: Message, i: int, path: Path) -> None:
        try:
            stamped = message["grasp_pose"]
            self.frame_id = _frame(stamped)
            self.pose = _pose(stamped["pose"])
            self.pregrasp = _pregrasp(message.get("pre_grasp_approach") or {}, self.pose, self.frame_id)
            self.before = _positions(message.get("pre_grasp_posture") or {})
            self.after = _positions(message.get("grasp_posture") or {})
            self.quality = float(message.get("grasp_quality", 0.0))
            if not np.isfinite(self.quality):
                raise ValueError("'grasp_quality' is not finite")
        except Exception as error:  # anything may stand where a number should
            raise GraspmatchError(f"{path}: message {i} is malformed ({one_line(error)}).") from error


def _message(
    grasps: GraspSet, i: int, gripper: Gripper, frame_id: str, T_gripper_parent: Float[np.ndarray, "4 4"]
) -> Message:
    """One grasp."""
    T = grasps.T_world_gripper[i]
    way = T[:3, 3] - grasps.T_world_pregrasp[i, :3, 3]
    distance = float(np.linalg.norm(way))
    direction = way / distance if distance > 0 else T[:3, :3] @ gripper.approach
    T_world_parent = T @ T_gripper_parent
    w, x, y, z = se3.quaternion_from_matrix(T_world_parent[:3, :3]).tolist()
    position = dict(zip(AXES, T_world_parent[:3, 3].tolist(), strict=True))
    return {
        "id": f"grasp_{i}",
        "pre_grasp_posture": _posture(grasps.joint_names, grasps.pregrasp_joints[i]),
        "grasp_posture": _posture(grasps.joint_names, grasps.grasp_joints[i]),
        "grasp_pose": {
            "header": {"frame_id": frame_id},
            "pose": {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}},
        },
        "grasp_quality": 0.0 if np.isnan(grasps.score[i]) else float(grasps.score[i]),
        # The whole way was checked to be free, and begins where the fingers are clear of the object: no less will do.
        "pre_grasp_approach": _translation(direction, frame_id, distance, distance),
        "post_grasp_retreat": _translation(np.array([0.0, 0.0, 1.0]), frame_id, LIFT, LEAST_LIFT),
        "max_contact_force": float(gripper.finger_force),
        "allowed_touch_objects": [],
    }


def _posture(names: tuple[str, ...], values: Float[np.ndarray, "d"]) -> Message:
    """A trajectory of one point; the empty one where a value is not known."""
    if np.isnan(values).any():
        return {"joint_names": [], "points": []}
    return {"joint_names": list(names), "points": [{"positions": values.tolist()}]}


def _translation(direction: Float[np.ndarray, "3"], frame_id: str, distance: float, least: float) -> Message:
    """A straight way of the hand [m]."""
    vector = dict(zip(AXES, direction.tolist(), strict=True))
    return {
        "direction": {"header": {"frame_id": frame_id}, "vector": vector},
        "desired_distance": distance,
        "min_distance": least,
    }


def _messages(documents: list[Any]) -> list[Any]:
    """The messages of a file: those of its lists, and its other documents; `rostopic echo` ends with an empty one."""
    return [
        message
        for document in documents
        if document is not None
        for message in (document if isinstance(document, list) else [document])
    ]


def _frame(stamped: Message) -> str:
    return str((stamped.get("header") or {}).get("frame_id", ""))[:200]


def _vector(entry: Message) -> Float[np.ndarray, "3"]:
    vector = np.array([float(entry[axis]) for axis in AXES])
    if not np.isfinite(vector).all():
        raise ValueError("a vector has a number that is not finite")
    return vector


def _pose(entry: Message) -> Float[np.ndarray, "4 4"]:
    wxyz = np.array([float(entry["orientation"][name]) for name in "wxyz"])
    return se3.from_parts(quaternion_rotation(wxyz), _vector(entry["position"]))


def _pregrasp(approach: Message, T_world_parent: Float[np.ndarray, "4 4"], frame_id: str) -> Float[np.ndarray, "4 4"]:
    """Where the approach begins; NaN where the message does not say.

    A direction is in the frame of the pose, or else in that of a link of the hand, which moves with it.
    """
    distance = float(approach.get("desired_distance", 0.0))
    if not np.isfinite(distance):
        raise ValueError("'desired_distance' is not finite")
    direction = _vector(approach["direction"]["vector"]) if distance > 0 else np.zeros(3)
    length = float(np.linalg.norm(direction))
    if length == 0:
        return np.full((4, 4), np.nan)
    if _frame(approach["direction"]) != frame_id:
        direction = T_world_parent[:3, :3] @ direction
    return se3.translation(-distance / length * direction) @ T_world_parent


def _positions(posture: Message) -> dict[str, float]:
    """Joint values at the end of a trajectory."""
    points = posture.get("points") or []
    names = [str(name) for name in posture.get("joint_names") or []]
    if not points:
        return {}
    values = [float(value) for value in points[-1]["positions"]]
    if len(values) != len(names) or not np.isfinite(values).all():
        raise ValueError(f"a posture has {len(values)} positions, expected {len(names)} finite ones")
    return dict(zip(names, values, strict=True))
