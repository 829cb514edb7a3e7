"""The hand with its real meshes: one that moves, and many at once, all in the colours of their scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
from jaxtyping import Float, UInt8

from graspmatch.apps.hand import Hand
from graspmatch.apps.viewer.palette import HAND
from graspmatch.apps.viewer.stage import creased_mesh
from graspmatch.geometry.mesh import TriangleMesh
from graspmatch.geometry.se3 import quaternion_from_matrix

Array = np.ndarray


@dataclass(frozen=True)
class MovingHand:
    """One hand: a node for the gripper frame, below it one for each link that has a shape."""

    root: viser.FrameHandle
    links: tuple[viser.MeshHandle, ...]
    which: tuple[int, ...]
    """Index of each into `Gripper.links`."""

    def move(self, T_world_gripper: Float[Array, "4 4"], T_gripper_link: Float[Array, "l 4 4"]) -> None:
        """To a pose and a posture."""
        _place(self.root, T_world_gripper)
        for node, index in zip(self.links, self.which, strict=True):
            _place(node, T_gripper_link[index])

    def paint(self, colour: UInt8[Array, "3"]) -> None:
        """All links alike."""
        for node in self.links:
            node.color = (int(colour[0]), int(colour[1]), int(colour[2]))


@dataclass(frozen=True)
class HandShape:
    """The meshes of a hand as browsers want them."""

    meshes: tuple[TriangleMesh, ...]
    which: tuple[int, ...]


def shape_of(hand: Hand) -> HandShape:
    """What is drawn of each link that has a shape."""
    links = hand.gripper.links
    meshes = [link.visual if len(link.visual.faces) else link.collision for link in links]
    which = tuple(i for i, mesh in enumerate(meshes) if len(mesh.faces))
    return HandShape(tuple(creased_mesh(meshes[i]) for i in which), which)


def add_moving_hand(server: viser.ViserServer, shape: HandShape) -> MovingHand:
    """A hand at the origin."""
    root = server.scene.add_frame("/hand", show_axes=False)
    nodes = [
        server.scene.add_mesh_simple(f"/hand/{i}", mesh.vertices, mesh.faces, color=HAND, side="double")
        for i, mesh in enumerate(shape.meshes)
    ]
    return MovingHand(root, tuple(nodes), shape.which)


def add_many_hands(
    server: viser.ViserServer,
    shape: HandShape,
    T_world_link: Float[Array, "n l 4 4"],
    colours: UInt8[Array, "n 3"],
    *,
    opacity: float,
) -> Sequence[viser.BatchedMeshHandle]:
    """n hands as one batch for each link; none of them is visible before `show_first` says how many are."""
    nodes = []
    for i, (mesh, index) in enumerate(zip(shape.meshes, shape.which, strict=True)):
        T = T_world_link[:, index]
        nodes.append(
            server.scene.add_batched_meshes_simple(
                f"/hands/{i}",
                mesh.vertices,
                mesh.faces,
                quaternion_from_matrix(T[:, :3, :3]),
                T[:, :3, 3],
                batched_scales=np.zeros(len(T), dtype=np.float32),
                batched_colors=colours,
                opacity=opacity,
                side="double",
                cast_shadow=False,
                visible=False,
            )
        )
    return nodes


def show_first(nodes: Sequence[viser.BatchedMeshHandle], count: int, *, without: int) -> None:
    """Show so many of a batch, less the one that the moving hand is at: the others have no size."""
    for node in nodes:
        number = np.arange(len(node.batched_positions))
        node.batched_scales = ((number < count) & (number != without)).astype(np.float32)
        node.visible = count > 0


def _place(node: viser.SceneNodeHandle, T: Float[Array, "4 4"]) -> None:
    node.wxyz = quaternion_from_matrix(T[:3, :3])
    node.position = T[:3, 3]
