"""Contacts with their cones of friction, and forks of particles and of rejected candidates."""

from __future__ import annotations

import numpy as np
import viser
from jaxtyping import Float

from graspmatch.apps.viewer.contacts import Contacts, cone
from graspmatch.apps.viewer.forks import forks_at
from graspmatch.apps.viewer.palette import CONE, CONTACT, PARTICLE, colour_of_reason
from graspmatch.geometry.se3 import quaternion_from_matrix, rotation_facing
from graspmatch.planner.recording import Recording
from graspmatch.types import Gripper

Array = np.ndarray

CONE_LENGTH = 0.02
"""[m]"""
THIN, THICK = 1.2, 2.0
"""Lines [pixels]."""


def draw_contacts(server: viser.ViserServer, contacts: Contacts, friction: float) -> None:
    """Replace what is shown of contacts by those of a grasp: points, and cones that open into the object."""
    clear_contacts(server)
    if not len(contacts.points):
        return
    api, n = server.scene, len(contacts.points)
    hint = np.where(np.abs(contacts.pushes[:, :1]) < 0.9, np.eye(3)[0], np.eye(3)[1])
    wxyz = quaternion_from_matrix(rotation_facing(contacts.pushes, hint))
    shape = cone()
    width = np.tile([friction, friction, 1.0], (n, 1)) * CONE_LENGTH
    api.add_batched_meshes_simple(
        "/contacts/cones",
        shape.vertices,
        shape.faces,
        wxyz,
        contacts.points,
        batched_scales=width.astype(np.float32),
        batched_colors=CONE,
        opacity=0.8,
        side="double",
        cast_shadow=False,
    )
    arrows = np.stack([contacts.points, contacts.points + CONE_LENGTH * contacts.pushes], axis=1)
    api.add_line_segments("/contacts/pushes", arrows, CONTACT, thickness=THICK, thickness_units="screen")
    api.add_point_cloud(
        "/contacts/points", contacts.points, CONTACT, point_size=0.004, point_shape="circle", precision="float32"
    )


def clear_contacts(server: viser.ViserServer) -> None:
    """Show none."""
    if server.scene.get_handle_by_name("/contacts") is not None:
        server.scene.remove_by_name("/contacts")


def add_particles(
    server: viser.ViserServer, gripper: Gripper, T_world_gripper: Float[Array, "n 4 4"]
) -> viser.LineSegmentsHandle:
    """Forks of all particles at one iteration; other places are set as its points."""
    lines = forks_at(gripper, T_world_gripper)
    return server.scene.add_line_segments(
        "/particles", lines, PARTICLE, thickness=THIN, thickness_units="screen", visible=False
    )


def add_rejected(server: viser.ViserServer, gripper: Gripper, recording: Recording) -> dict[str, viser.SceneNodeHandle]:
    """Forks of those that were dropped for each reason, in its colour, not visible."""
    nodes = {}
    for number, reason in enumerate(recording.dropped):
        _, poses = recording.dropped_poses(reason)
        if len(poses):
            nodes[reason] = server.scene.add_line_segments(
                f"/rejected/{number}",
                forks_at(gripper, poses),
                colour_of_reason(number),
                thickness=THIN,
                thickness_units="screen",
                visible=False,
            )
    return nodes
