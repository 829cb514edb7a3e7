"""Another planner's grasps, refined: its poses are the starts, and what comes out is free, closed and judged.

    python examples/refine_other.py

Here the other planner is a crude one: the hand comes straight from above, at twelve turns. From a file it would be
`graspmatch plan mug.stl --gripper franka_hand --starts theirs.yaml`.
"""

import numpy as np

import graspmatch as gm
from graspmatch.geometry import se3
from graspmatch.scene.shapes import mug

scene = gm.Scene.from_mesh(mug())
gripper = gm.load_gripper("franka_hand")

# Approach straight down, the tool centre point 2 cm below the rim.
above = scene.target.points[:, 2].max() - 0.02
down = se3.rotation_facing(np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]))
turns = se3.rotation_exp(np.linspace(0, np.pi, 12, endpoint=False)[:, None] * [0.0, 0.0, 1.0])
R_world_gripper = turns @ down @ gripper.T_gripper_canonical[:3, :3].T
centre = np.array([*scene.centre_of_mass[:2], above])
theirs = se3.from_parts(R_world_gripper, centre - R_world_gripper @ gripper.tool_centre_point)

ours = gm.plan(scene, gripper, starts_world_gripper=theirs)
print(ours.explain())
for i in range(len(ours)):
    moved = np.linalg.norm(theirs[:, :3, 3] - ours.T_world_gripper[i, :3, 3], axis=-1).min()
    print(f"{i + 1}. confidence {ours.score[i]:.2f}, {1000 * moved:.0f} mm from the nearest of theirs")
