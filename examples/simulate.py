"""Plan, then let physics say whether the best grasps hold.

python examples/simulate.py
"""

import numpy as np

import graspmatch as gm
from graspmatch.config import LiftConfig
from graspmatch.gripper.kinematics import load_hand
from graspmatch.gripper.zoo import card_path
from graspmatch.scene.household import BULGE, OBJECTS
from graspmatch.simulate.judge import judge
from graspmatch.simulate.rigid_body import rigid_body

NAME = "can"

made = OBJECTS[NAME]()  # a mesh, and the convex parts that physics needs
grasps = gm.plan(gm.Scene.from_mesh(made.mesh), gm.load_gripper("franka_hand")).best(3)

hand = load_hand(card_path("franka_hand"))
can = rigid_body(NAME, made.mesh, made.parts, bulge=BULGE, mass=0.3)
report = judge(grasps, can, hand, np.eye(4), LiftConfig(friction=0.5))  # the object stands where it was planned for

for i in range(len(report)):
    verdict = "held" if report.held[i] else report.reason[i]
    print(f"{i + 1}. confidence {grasps.score[i]:.2f}: {verdict}, slipped {1000 * report.slip[i]:.1f} mm")
print(f"{report.held.sum()} of {len(report)} held; {report.engine}, mass {report.mass:.2f} kg")
