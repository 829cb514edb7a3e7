"""A recorded plan: the same grasps, every particle at every iteration, and everyone who was dropped."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from graspmatch.config import MatchingConfig, PlannerConfig, SeedingConfig
from graspmatch.gripper.load import load_gripper
from graspmatch.planner.plan import plan
from graspmatch.planner.recording import Recording
from graspmatch.scene.scene import Scene
from graspmatch.scene.shapes import mug
from graspmatch.types import GraspSet

CONFIG = PlannerConfig(seeding=SeedingConfig(points=40, above=2, batches=2), device="cpu")


@pytest.fixture(scope="module")
def recorded() -> tuple[GraspSet, Recording]:
    recording = Recording()
    grasps = plan(Scene.from_mesh(mug()), load_gripper("franka_hand"), CONFIG, recording=recording)
    return grasps, recording


def test_recording_changes_no_grasp(recorded: tuple[GraspSet, Recording]) -> None:
    grasps, _ = recorded
    plain = plan(Scene.from_mesh(mug()), load_gripper("franka_hand"), CONFIG)
    for entry in dataclasses.fields(grasps):
        value = getattr(plain, entry.name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(grasps, entry.name), value, err_msg=entry.name)
    assert grasps.tally == plain.tally


def test_particles_are_there_at_every_iteration(recorded: tuple[GraspSet, Recording]) -> None:
    grasps, recording = recorded
    preshape, poses = recording.particles()
    assert poses.shape == (MatchingConfig().iterations + 2, grasps.tally["candidates"], 4, 4)
    assert len(preshape) == grasps.tally["candidates"]
    moved = np.linalg.norm(np.diff(poses[:, :, :3, 3], axis=0), axis=-1)
    assert np.all(np.median(moved[:-1], axis=1)[:15] > 1e-5)  # all of the Stein phase moves


def test_all_who_were_dropped_are_there_with_their_reasons(recorded: tuple[GraspSet, Recording]) -> None:
    grasps, recording = recorded
    for reason, count in grasps.tally.items():
        if reason != "candidates":
            preshape, poses = recording.dropped_poses(reason)
            assert len(preshape) == len(poses) == count, reason
    dropped = sum(len(recording.dropped_poses(reason)[0]) for reason in recording.dropped)
    assert dropped + len(grasps) == grasps.tally["candidates"]


def test_a_recording_of_nothing_is_empty() -> None:
    preshape, poses = Recording().particles()
    assert len(preshape) == poses.shape[1] == 0
    assert len(Recording().dropped_poses("no reason")[1]) == 0
