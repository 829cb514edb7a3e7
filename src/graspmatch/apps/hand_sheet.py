"""A contact sheet of a hand: open, its preshapes with their inner surfaces, closed; with the frames drawn."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from graspmatch.apps.picture import (
    Body,
    LinkPoses,
    Panel,
    camera_around,
    contact_sheet,
    hand_bodies,
    point_cloud_bodies,
    render,
    write_png,
)
from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.geometry.se3 import rotation_facing
from graspmatch.types import Gripper

Array = np.ndarray

APPROACH, CLOSING, CENTRE = (0.16, 0.35, 0.78, 1.0), (0.80, 0.20, 0.16, 1.0), (0.95, 0.75, 0.10, 1.0)
SAMPLES = (0.10, 0.62, 0.42, 1.0)
PANEL = (480, 480)
"""Width and height of each picture [pixels]."""
COLUMNS, MOST_PRESHAPES = 4, 10
TURNED = 25.0
"""Of the camera from straight beside the fingers [degrees]."""
AXIS_LENGTH, AXIS_WIDTH = 0.6, 0.012
"""Of an axis, in sizes of the hand's opening."""


def write_hand_sheet(gripper: Gripper, path: Path, *, link_poses: LinkPoses) -> None:
    """Write the PNG: blue is the approach, red the closing axis, yellow the tool centre point, green the samples S."""
    rows: list[tuple[str, Array, Array | None]] = [("open", gripper.open_joints, None)]
    every = math.ceil(len(gripper.preshapes) / MOST_PRESHAPES)
    for preshape in gripper.preshapes[::every]:
        rows.append((preshape.name, preshape.joints, preshape.samples.points))
    rows.append(("closed", gripper.closed_joints, None))
    panels = [Panel(_draw(gripper, joints, samples, link_poses), name) for name, joints, samples in rows]
    write_png(contact_sheet(panels, columns=COLUMNS), path)


def _draw(
    gripper: Gripper, joints: Float[Array, "d"], samples: Float[Array, "n 3"] | None, link_poses: LinkPoses
) -> UInt8[Array, "h w 3"]:
    """The hand in one posture, fingers up, seen across its closing axis."""
    hand = hand_bodies(gripper, np.eye(4), link_poses(joints))
    bodies = [*hand, *_frame(gripper)]
    if samples is not None:
        bodies += [point_cloud_bodies(samples, 0.012 * gripper.opening, SAMPLES)]
    camera = camera_around(bodies, _azimuth(gripper), 15.0, up=gripper.approach, aspect=PANEL[0] / PANEL[1])
    return render(bodies, camera=camera, size=PANEL)


def _azimuth(gripper: Gripper) -> float:
    """Of a camera beside the hand, a little turned so that depth is seen [degrees]."""
    up = gripper.approach
    hint = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x, y, _ = rotation_facing(up, hint).T @ np.cross(gripper.approach, gripper.closing)
    return math.degrees(math.atan2(y, x)) + TURNED


def _frame(gripper: Gripper) -> list[Body]:
    """Both axes at the tool centre point, and the point."""
    centre, length, width = gripper.tool_centre_point, AXIS_LENGTH * gripper.opening, AXIS_WIDTH * gripper.opening
    axes = ((gripper.approach, APPROACH), (gripper.closing, CLOSING))
    rods = [Body(_rod(centre, centre + length * axis, width), colour) for axis, colour in axes]
    return [*rods, point_cloud_bodies(centre[None], 2.5 * width, CENTRE)]


def _rod(start: Float[Array, "3"], end: Float[Array, "3"], radius: float) -> TriangleMesh:
    from trimesh import creation

    rod = creation.cylinder(radius=radius, segment=np.stack([start, end]), sections=16)
    return TriangleMesh(np.asarray(rod.vertices, dtype=float), np.asarray(rod.faces, dtype=int))
