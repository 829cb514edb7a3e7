"""Where the particles start: Fibonacci points around the object, a mixture of Gaussians, or poses from elsewhere."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspmatch.config import PoseGaussian, SeedingConfig
from graspmatch.geometry import se3
from graspmatch.geometry.sphere import GOLDEN_RATIO, fibonacci_directions
from graspmatch.planner.candidates import Candidates
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, Gripper, Preshape


def seed_poses(scene: Scene, gripper: Gripper, config: SeedingConfig, rng: np.random.Generator) -> Candidates:
    """The same number of starting poses for every preshape."""
    if config.pattern == "gaussians":
        return pose_seeds(sample_gaussians(config.gaussians, config.points, rng), gripper)
    directions = fibonacci_directions(config.points)
    if config.pattern == "quarter":
        directions = _quarter_sphere(directions, np.array(config.robot_direction))
    above = np.tile([0.0, 0.0, 1.0], (config.above, 1))
    poses = [
        _facing_poses(scene, gripper, preshape, directions, above, index, rng)
        for index, preshape in enumerate(gripper.preshapes)
    ]
    return Candidates(np.repeat(np.arange(len(poses)), len(poses[0])), np.concatenate(poses))


def pose_seeds(T_world_gripper: Float[np.ndarray, "n 4 4"], gripper: Gripper) -> Candidates:
    """Every given pose with every preshape."""
    if T_world_gripper.ndim != 3 or T_world_gripper.shape[1:] != (4, 4) or len(T_world_gripper) == 0:
        raise GraspmatchError(f"Starting poses must have the shape (n, 4, 4), not {T_world_gripper.shape}.")
    count = len(gripper.preshapes)
    preshape = np.repeat(np.arange(count), len(T_world_gripper))
    return Candidates(preshape, np.tile(T_world_gripper, (count, 1, 1)))


def sample_gaussians(
    gaussians: tuple[PoseGaussian, ...], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 4 4"]:
    """Poses drawn from a mixture of Gaussians over positions and rotation vectors."""
    if not gaussians:
        raise GraspmatchError("The seeding pattern 'gaussians' needs at least one Gaussian in seeding.gaussians.")
    weight = np.array([gaussian.weight for gaussian in gaussians])
    which = rng.choice(len(gaussians), count, p=weight / weight.sum())
    position = np.array([gaussian.position for gaussian in gaussians])[which]
    quaternion = np.array([gaussian.wxyz for gaussian in gaussians], dtype=float)[which]
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    spread = np.array([(gaussian.sigma_position, gaussian.sigma_angle) for gaussian in gaussians])[which]
    turn = se3.rotation_exp(rng.normal(size=(count, 3)) * spread[:, 1:])
    offset = rng.normal(size=(count, 3)) * spread[:, :1]
    return se3.from_parts(turn @ se3.matrix_from_quaternion(quaternion), position + offset)


def _quarter_sphere(directions: Float[np.ndarray, "n 3"], towards: Float[np.ndarray, "3"]) -> Float[np.ndarray, "m 3"]:
    """The directions above the horizon on the robot's side."""
    horizontal = np.linalg.norm(towards[:2])
    if horizontal < 1e-9:
        raise GraspmatchError("seeding.robot_direction needs a horizontal part.")
    return directions[(directions[:, 2] > 0) & (directions[:, :2] @ (towards[:2] / horizontal) > 0)]


def _facing_poses(
    scene: Scene,
    gripper: Gripper,
    preshape: Preshape,
    around: Float[np.ndarray, "a 3"],
    above: Float[np.ndarray, "b 3"],
    index: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n 4 4"]:
    """The hand on the object's outline in each direction, facing the centre of mass.

    The turn about the approach follows the golden ratio around the object, and is spread evenly over half a turn above
    it; a random phase lets every seed see other turns.
    """
    directions = np.concatenate([around, above])
    phase = rng.random()
    turns = 2 * np.pi * ((np.arange(len(around)) + index / 2) * GOLDEN_RATIO + phase)
    turns_above = np.pi * ((np.arange(len(above)) + phase) / max(len(above), 1) + index / 2)
    R_world_canonical = _facing(-directions, np.concatenate([turns, turns_above]))
    R_world_gripper = R_world_canonical @ gripper.T_gripper_canonical[:3, :3].T
    reach = np.max((scene.target.points - scene.centre_of_mass) @ directions.T, axis=0)
    tcp_world = scene.centre_of_mass + np.maximum(reach, 0)[:, None] * directions
    return se3.from_parts(R_world_gripper, tcp_world - R_world_gripper @ preshape.tool_centre_point)


def _facing(approach: Float[np.ndarray, "n 3"], turn: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3 3"]:
    """Canonical frames (+z approach, +x closing), turned about the approach from a level closing axis."""
    level = np.cross([0.0, 0.0, 1.0], approach)
    is_vertical = np.linalg.norm(level, axis=-1, keepdims=True) < 1e-6
    frame = se3.rotation_facing(approach, np.where(is_vertical, [1.0, 0.0, 0.0], level))
    return frame @ se3.rotation_exp(turn[:, None] * np.array([0.0, 0.0, 1.0]))
