"""A two-finger hand made of boxes, small enough to bake in a moment: palm at z = 0, pads at y = +-0.03 when open."""

from __future__ import annotations

from pathlib import Path

from graspmatch.config import BakingConfig

COARSE = BakingConfig(grid_spacing=0.005, link_spacing=0.004, fewest_closing_steps=12)

MJCF = """
<mujoco>
  <worldbody>
    <body name="palm">
      <geom type="box" size="0.02 0.05 0.01" pos="0 0 -0.01"/>
      <body name="left">
        <joint name="slide_left" type="slide" axis="0 -1 0" range="0 0.03"/>
        <geom type="box" size="0.01 0.005 0.03" pos="0 0.035 0.03"/>
      </body>
      <body name="right">
        <joint name="slide_right" type="slide" axis="0 1 0" range="0 0.03"/>
        <geom type="box" size="0.01 0.005 0.03" pos="0 -0.035 0.03"/>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="slide_right" joint2="slide_left"/></equality>
</mujoco>
"""

CARD = """
name = "toy"
title = "Toy"
description = "toy.xml"
base_link = "palm"
approach = [0, 0, 1]
closing = [0, 1, 0]
tool_centre_point = [0, 0, 0.045]
finger_force = 10.0
opening = 0.06
palm = ["palm"]
[joints.slide_left]
open = 0.0
closed = 0.03
[[fingers]]
name = "left"
links = ["left"]
joints = ["slide_left"]
[[fingers]]
name = "right"
links = ["right"]
joints = ["slide_left"]
[preshapes]
steps = 3
closing = [0.0, 0.6]
[samples]
method = "mesh"
voxel_size = 0.005
"""


def write_toy(folder: Path, card: str = CARD) -> Path:
    """Card and description in a folder; the card's path."""
    (folder / "toy.xml").write_text(MJCF)
    (folder / "card.toml").write_text(card)
    return folder / "card.toml"
