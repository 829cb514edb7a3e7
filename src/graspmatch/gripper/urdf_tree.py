"""Whether the joints of a URDF form a tree: MuJoCo would only say that something is wrong."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from graspmatch.errors import GraspmatchError


def refuse_tangled(root: ElementTree.Element, path: Path) -> None:
    """Raise where the joints of a URDF form no tree."""
    links = {link.get("name") for link in root.findall("link")}
    parent_of: dict[str, str] = {}
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        ends = {end: getattr(joint.find(end), "attrib", {}).get("link", "") for end in ("parent", "child")}
        for end, link in ends.items():
            if link not in links:
                raise GraspmatchError(
                    f"{path}: the joint '{name}' has the {end} '{link}', which is no link of the file."
                )
        child = ends["child"]
        if child in parent_of:
            raise GraspmatchError(
                f"{path}: the link '{child}' hangs on two joints, '{parent_of[child]}' and '{name}'. A URDF cannot say "
                f"that a linkage closes: remove one of them and let its joints follow with <mimic>, or write an MJCF "
                f"with <equality><connect>."
            )
        parent_of[child] = name
    if links and not links - parent_of.keys():
        raise GraspmatchError(f"{path}: every link hangs on another one, round in a circle; one must be the first.")
