"""The files that a plan writes, and the status that it ends with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from graspmatch.apps.hand import Hand
from graspmatch.apps.speech import Speech
from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import check_place, write_atomically
from graspmatch.formats.registry import write_grasps, writer_of
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspSet

NOT_FOUND = 3
"""Exit status when there is no grasp."""

PICTURED = 3
"""A picture shows the hand at so many of the best grasps."""


@dataclass(frozen=True)
class Outputs:
    """The files to write."""

    grasps: tuple[Path, ...] = ()
    picture: Path | None = None

    @property
    def all(self) -> tuple[Path, ...]:
        """Every one of them."""
        return (*self.grasps, self.picture) if self.picture else self.grasps

    def check(self) -> None:
        """Refuse what cannot be written, before anything is computed."""
        for path in self.grasps:
            writer_of(path)
        if self.picture and self.picture.suffix.lower() != ".png":
            raise GraspmatchError(f"Cannot write {self.picture}: a picture has the suffix .png.")
        for path in self.all:
            check_place(path)


def write_all(scene: Scene, hand: Hand, grasps: GraspSet, say: Speech, outputs: Outputs) -> None:
    """Write the grasps and their picture."""
    for path in outputs.grasps:
        write_grasps(grasps, path, hand.gripper)
        say.show(f"Wrote {path}")
    if outputs.picture is None:
        return
    from graspmatch.apps.picture import picture_of_grasps

    def draw(temporary: Path) -> None:
        picture_of_grasps(scene, hand.gripper, grasps, temporary, link_poses=hand.link_poses, count=PICTURED)

    with say.progress("Drawing"):
        write_atomically(outputs.picture, draw)
    say.show(f"Wrote {outputs.picture}")
