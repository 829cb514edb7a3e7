"""Many scenes in one call: the grasps of each as if it were alone, errors and the robot's reach as there."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from graspmatch.config import ClosingConfig, PlannerConfig, RefiningConfig, SeedingConfig
from graspmatch.kernels.launch import launches_on, thread_count
from graspmatch.planner.many import plan_many
from graspmatch.planner.plan import plan
from graspmatch.types import GraspmatchError
from test_planner import box_scene

QUICK = PlannerConfig(seeding=SeedingConfig(points=60, batches=1), refining=RefiningConfig(count=1, rounds=1), seed=5)
SIZES = ((0.08, 0.03, 0.06), (0.05, 0.04, 0.09), (0.5, 0.5, 0.5), (0.03, 0.03, 0.12), (0.1, 0.02, 0.05))
"""Of boxes, of which the toy cannot grasp the third."""


@pytest.fixture(scope="module")
def boxes():
    return [box_scene(size) for size in SIZES]


@pytest.mark.parametrize("threads", ["1", "2", "5"])
def test_each_scene_gets_the_grasps_that_it_gets_alone(toy, boxes, threads, device, monkeypatch):
    monkeypatch.setenv("GRASPMATCH_THREADS", threads)
    config = replace(QUICK, device=device)
    together = plan_many(boxes, toy, config)
    assert [len(grasps) > 0 for grasps in together] == [True, True, False, True, True]
    for scene, grasps in zip(boxes, together, strict=True):
        alone = plan(scene, toy, config)
        np.testing.assert_array_equal(grasps.T_world_gripper, alone.T_world_gripper)
        np.testing.assert_array_equal(grasps.grasp_joints, alone.grasp_joints)
        np.testing.assert_array_equal(grasps.score, alone.score)
        assert grasps.tally == alone.tally
        assert grasps.explain() == alone.explain()


def test_no_scenes_get_no_grasps(toy):
    assert plan_many([], toy) == []


def test_a_wrong_configuration_is_an_error_as_for_one_scene(toy, boxes):
    wrong = replace(QUICK, closing=ClosingConfig(fewest_fingers=9))
    with pytest.raises(GraspmatchError) as alone:
        plan(boxes[0], toy, wrong)
    with pytest.raises(GraspmatchError) as together:
        plan_many(boxes, toy, wrong)
    assert str(together.value) == str(alone.value)


def test_what_a_robot_cannot_reach_is_asked_by_one_thread_at_a_time(toy, boxes, monkeypatch):
    monkeypatch.setenv("GRASPMATCH_THREADS", "4")
    inside, most, asked = 0, 0, set()

    def from_the_left(poses):
        nonlocal inside, most
        inside += 1
        most = max(most, inside)
        asked.add(threading.get_ident())
        time.sleep(0.002)  # others would come in between
        inside -= 1
        return poses[:, 1, 1, 3] > -0.2

    together = plan_many(boxes, toy, QUICK, reach=from_the_left)
    assert most == 1
    assert len(asked) > 1
    assert all((grasps.T_world_gripper[:, 1, 3] > -0.2).all() for grasps in together)
    assert any(len(grasps) for grasps in together)


def test_products_of_matrices_have_as_many_threads_as_before(toy, boxes, monkeypatch):
    monkeypatch.setenv("GRASPMATCH_THREADS", "3")
    before = [pool["num_threads"] for pool in threadpool_info()]
    plan_many(boxes, toy, QUICK)
    assert [pool["num_threads"] for pool in threadpool_info()] == before


def test_a_python_thread_may_have_its_own_number_of_threads_for_launches(monkeypatch):
    monkeypatch.setenv("GRASPMATCH_THREADS", "7")
    others = []
    with launches_on(2):
        assert thread_count() == 2
        with launches_on(1):
            assert thread_count() == 1
        assert thread_count() == 2
        other = threading.Thread(target=lambda: others.append(thread_count()))
        other.start()
        other.join()
    with pytest.raises(ZeroDivisionError), launches_on(3):
        raise ZeroDivisionError
    assert thread_count() == 7
    assert others == [7]


def test_kernels_that_no_plan_has_loaded_yet_are_loaded_once():
    """In a process of its own: several threads come to each kernel at about the same time."""
    program = """
from concurrent.futures import ThreadPoolExecutor
import warp as wp
from graspmatch.kernels import launch, warp_avoid, warp_hold, warp_steps
loads = []
init = wp.Launch.__init__
wp.Launch.__init__ = lambda self, kernel, *rest: (loads.append(kernel.key), init(self, kernel, *rest))[1]
kernels = [warp_steps.take_best, warp_hold.hold, warp_avoid.back_off, warp_steps.descend] * 8
with ThreadPoolExecutor(8) as pool:
    blanks = list(pool.map(launch._blank, kernels))
assert sorted(loads) == ["back_off", "descend", "hold", "take_best"], loads
assert all(blank.kernel is kernel for blank, kernel in zip(blanks, kernels))
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=300)
