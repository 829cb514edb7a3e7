"""From a depth image to grasps in the world: here an image made by code, of a block on a table, seen from above.

python examples/depth_camera.py
"""

import numpy as np

import graspmatch as gm

# Intrinsics and pose of the camera: 60 cm above the table, looking straight down.
K = np.array([[615.0, 0.0, 320.0], [0.0, 615.0, 240.0], [0.0, 0.0, 1.0]])
T_world_camera = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.6], [0, 0, 0, 1]])

rows, columns = np.mgrid[:480, :640]
depth = np.full((480, 640), 0.6)  # [m]
depth[(abs(rows - 240) < 30) & (abs(columns - 320) < 80)] = 0.54  # a block, 6 cm high

scene = gm.Scene.from_depth(depth, gm.Camera(K, T_world_camera=T_world_camera), table=0.0)
for note in scene.notes:
    print("Note:", note)
print(len(scene.target.points), "points of the object,", len(scene.obstacles.points), "of what is in the way")

grasps = gm.plan(scene, gm.load_gripper("franka_hand"))
print(grasps.explain())
if len(grasps):
    print("The best one, in the world:")
    print(grasps.T_world_gripper[0].round(3))
