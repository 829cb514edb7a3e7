"""Plan grasps for a mesh or a cloud, and write them for Isaac Sim and as a picture of numbers.

python examples/plan.py [OBJECT] [--gripper NAME]
"""

import argparse
from pathlib import Path

import graspmatch as gm
from graspmatch.scene.shapes import mug

parser = argparse.ArgumentParser()
parser.add_argument("object", nargs="?", help="mesh or cloud; none: a mug made by code")
parser.add_argument("--gripper", default="franka_hand", help=", ".join(gm.known_grippers()))
arguments = parser.parse_args()

scene = gm.Scene.read(arguments.object) if arguments.object else gm.Scene.from_mesh(mug())
gripper = gm.load_gripper(arguments.gripper)
grasps = gm.plan(scene, gripper)
print(grasps.explain())

for i in range(min(len(grasps), 3)):
    print(f"\n{i + 1}. confidence {grasps.score[i]:.2f}: go to T_world_pregrasp with", grasps.pregrasp_joints[i])
    print(grasps.T_world_pregrasp[i].round(4))
    print("move straight to T_world_gripper, close to", grasps.grasp_joints[i].round(4), "and lift")
    print(grasps.T_world_gripper[i].round(4))

if len(grasps):
    gm.write_grasps(grasps, Path("grasps.yaml"), gripper)
    print("\nWrote grasps.yaml")
