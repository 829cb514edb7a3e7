"""A cloud that is a PyTorch tensor in, PyTorch tensors out. On the CPU nothing is copied on the way back.

python examples/torch_tensors.py        needs PyTorch
"""

import numpy as np
import torch

import graspmatch as gm
from graspmatch.scene.shapes import mug


def array(tensor: torch.Tensor) -> np.ndarray:
    """A tensor of any device as an array of float64, through DLPack."""
    return np.from_dlpack(tensor.detach().cpu().to(torch.float64).contiguous())


device = "cuda" if torch.cuda.is_available() else "cpu"
vertices = torch.tensor(mug().vertices, dtype=torch.float32, device=device)  # a cloud, from a network perhaps
faces = torch.tensor(mug().faces, device=device)
weights = torch.rand(20_000, 3, device=device).log().neg()
corners = vertices[faces[torch.randint(len(faces), (20_000,), device=device)]]
cloud = (corners * (weights / weights.sum(dim=1, keepdim=True))[..., None]).sum(dim=1)

grasps = gm.plan(gm.Scene.from_cloud(array(cloud)), gm.load_gripper("franka_hand"))
print(grasps.explain())

T_world_gripper = torch.from_dlpack(grasps.T_world_gripper).to(device)
joints = torch.from_dlpack(grasps.grasp_joints).to(device)
score = torch.from_dlpack(grasps.score).to(device)
print(
    T_world_gripper.shape, joints.shape, T_world_gripper.device, "best score", float(score.max()) if len(score) else "-"
)
