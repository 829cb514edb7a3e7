"""A hand of your own: a description and a card, here two plates that slide towards each other.

python examples/own_gripper.py
"""

from pathlib import Path

import graspmatch as gm
from graspmatch.scene.shapes import mug

DESCRIPTION = """
<mujoco>
  <worldbody>
    <body name="palm">
      <geom type="box" size="0.02 0.06 0.01" pos="0 0 -0.01"/>
      <body name="left">
        <joint name="slide_left" type="slide" axis="0 -1 0" range="0 0.045"/>
        <geom type="box" size="0.01 0.005 0.03" pos="0 0.05 0.03"/>
      </body>
      <body name="right">
        <joint name="slide_right" type="slide" axis="0 1 0" range="0 0.045"/>
        <geom type="box" size="0.01 0.005 0.03" pos="0 -0.05 0.03"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
CARD = """
name = "two_plates"
description = "two_plates.xml"
base_link = "palm"
approach = [0, 0, 1]
closing = [0, 1, 0]
tool_centre_point = [0, 0, 0.05]
finger_force = 30                 # [N]
opening = 0.09                    # [m]
palm = ["palm"]
joints = { slide_left = { open = 0.0, closed = 0.045 } }
couplings = { slide_right = { joint = "slide_left" } }
preshapes = { steps = 6 }
samples = { voxel_size = 0.005 }

[[fingers]]
name = "left"
links = ["left"]
joints = ["slide_left"]

[[fingers]]
name = "right"
links = ["right"]
joints = ["slide_left"]
"""

Path("two_plates.xml").write_text(DESCRIPTION)
Path("two_plates.toml").write_text(CARD)
gripper = gm.load_gripper("two_plates.toml")
print(gm.plan(gm.Scene.from_mesh(mug()), gripper).explain())
