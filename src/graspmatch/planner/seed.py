"""Where the particles start: Fibonacci points around the object, a mixture of Gaussians, or poses from elsewhere."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from graspmatch.config import PoseGaussian, SeedingConfig
from graspmatch.geometry import se3
from graspmatch.geometry.sphere import GOLDEN_RATIO, fibonacci_directions
from graspmatch.planner.candidates import Candidates
from graspmatch.scene.scene import Scene
from graspmatch.types import GraspmatchError, Gripper


def seed_poses(scene: Scene, gripper: Gripper, config: SeedingConfig, rng: np.random.Generator) -> Candidates:
    """The same number of starting poses for every preshape that the card asks for."""
    if config.pattern == "gaussians":
        return pose_seeds(sample_gaussians(config.gaussians, config.points, rng), gripper)
    R_world_up = upright_frame(scene, np.array(config.robot_direction))
    directions = fibonacci_directions(config.points)
    if config.pattern == "quarter":
        directions = directions[(directions[:, 2] > 0) & (directions[:, 0] > 0)]
    above = np.tile([0.0, 0.0, 1.0], (config.above, 1))
    if len(directions) + len(above) == 0:
        raise GraspmatchError("There are no starting poses: seeding.points or seeding.above must be larger.")
    preshapes = asked_for(gripper)
    tcp_gripper = np.array([gripper.preshapes[i].tool_centre_point for i in preshapes])
    poses = _facing_poses(scene, gripper, tcp_gripper, directions, above, R_world_up, rng)
    return Candidates(np.repeat(preshapes, poses.shape[1]), poses.reshape(-1, 4, 4))


def asked_for(gripper: Gripper) -> Int[np.ndarray, "p"]:
    """The preshapes that the card asks for: all but those of the fingertips."""
    return np.flatnonzero([not preshape.is_fingertips for preshape in gripper.preshapes])


def pose_seeds(T_world_gripper: Float[np.ndarray, "n 4 4"], gripper: Gripper) -> Candidates:
    """Every given pose with every preshape that the card asks for."""
    if T_world_gripper.ndim != 3 or T_world_gripper.shape[1:] != (4, 4):
        raise GraspmatchError(f"Starting poses must have the shape (n, 4, 4), not {T_world_gripper.shape}.")
    if len(T_world_gripper) == 0:
        raise GraspmatchError("There are no starting poses: the set given is empty.")
    is_rigid = se3.is_rigid(T_world_gripper)
    if not is_rigid.all():
        raise GraspmatchError(f"{np.sum(~is_rigid)} of {len(is_rigid)} starting poses are no finite rigid transforms.")
    preshapes = asked_for(gripper)
    return Candidates(np.repeat(preshapes, len(T_world_gripper)), np.tile(T_world_gripper, (len(preshapes), 1, 1)))


def sample_gaussians(
    gaussians: tuple[PoseGaussian, ...], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 4 4"]:
    """Poses drawn from a mixture of Gaussians over positions and rotation vectors."""
    if not gaussians:
        raise GraspmatchError(
            "The seeding pattern 'gaussians' needs SeedingConfig(gaussians=(PoseGaussian(...), ...)) in Python, or a "
            "file of them (--seeds mixture.toml)."
        )
    weight = np.array([gaussian.weight for gaussian in gaussians])
    norms = np.linalg.norm([gaussian.wxyz for gaussian in gaussians], axis=-1)
    if np.any(weight < 0) or weight.sum() <= 0 or np.any(norms < 1e-9):
        raise GraspmatchError("Every seeding Gaussian needs a quaternion that is not zero and a weight of 0 or more.")
    which = rng.choice(len(gaussians), count, p=weight / weight.sum())
    position = np.array([gaussian.position for gaussian in gaussians])[which]
    quaternion = np.array([gaussian.wxyz for gaussian in gaussians], dtype=float)[which]
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    spread = np.array([(gaussian.sigma_position, gaussian.sigma_angle) for gaussian in gaussians])[which]
    turn = se3.rotation_exp(rng.normal(size=(count, 3)) * spread[:, 1:])
    offset = rng.normal(size=(count, 3)) * spread[:, :1]
    return se3.from_parts(turn @ se3.matrix_from_quaternion(quaternion), position + offset)


def upright_frame(scene: Scene, robot_direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Frame with z up and x towards the robot. Up is the table's normal; where there is no table, towards the sensor,
    for what it saw can be reached from there; else the world's z."""
    up = np.array([0.0, 0.0, 1.0])
    if scene.table is not None:
        up = scene.table.normal
    elif scene.sensor_origin is not None and np.any(scene.sensor_origin != scene.centre_of_mass):
        up = scene.sensor_origin - scene.centre_of_mass
    hints = [robot_direction, *np.eye(3)]
    hint = next(h for h in hints if np.linalg.norm(np.cross(up, h)) > 1e-3 * np.linalg.norm(up))
    return se3.rotation_facing(up, hint)


def _facing_poses(
    scene: Scene,
    gripper: Gripper,
    tcp_gripper: Float[np.ndarray, "p 3"],
    around: Float[np.ndarray, "a 3"],
    above: Float[np.ndarray, "b 3"],
    R_world_up: Float[np.ndarray, "3 3"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "p n 4 4"]:
    """For every preshape the hand on the object's outline in each direction, facing the centre of mass.

    The turn about the approach follows the golden ratio around the object, and is spread evenly over half a turn above
    it; a random phase lets every seed see other turns.
    """
    directions = np.concatenate([around, above])
    phase = rng.random(len(tcp_gripper))[:, None]
    shift = np.arange(len(tcp_gripper))[:, None] / 2
    turns = 2 * np.pi * ((np.arange(len(around)) + shift) * GOLDEN_RATIO + phase)
    turns_above = np.pi * ((np.arange(len(above)) + phase) / max(len(above), 1) + shift)
    turned = se3.rotation_exp(np.concatenate([turns, turns_above], axis=1)[..., None] * np.array([0.0, 0.0, 1.0]))
    R_world_gripper = R_world_up @ _facing(-directions) @ turned @ gripper.T_gripper_canonical[:3, :3].T
    directions_world = directions @ R_world_up.T
    reach = np.max(directions_world @ (scene.target.points - scene.centre_of_mass).T, axis=1)
    tcp_world = scene.centre_of_mass + np.maximum(reach, 0)[:, None] * directions_world
    return se3.from_parts(R_world_gripper, tcp_world - np.einsum("pnij,pj->pni", R_world_gripper, tcp_gripper))


def _facing(approach: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Canonical frames (+z approach, +x closing) with a level closing axis."""
    level = np.cross([0.0, 0.0, 1.0], approach)
    is_vertical = np.linalg.norm(level, axis=-1, keepdims=True) < 1e-6
    return se3.rotation_facing(approach, np.where(is_vertical, [1.0, 0.0, 0.0], level))
