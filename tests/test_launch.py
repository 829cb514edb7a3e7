"""Launches on several CPU threads: every element is some thread's, once."""

# pyright: reportInvalidTypeForm=false

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys

import numpy as np
import pytest
import warp as wp

from graspmatch.errors import GraspmatchError
from graspmatch.geometry.grid import Grid
from graspmatch.kernels import warp_fields
from graspmatch.kernels.fields import stack_fields
from graspmatch.kernels.launch import launch, thread_count
from graspmatch.kernels.warp_queue import Queue, take


@wp.kernel
def count_visits(queue: Queue, work: wp.array(dtype=wp.int32), visits: wp.array(dtype=wp.int32)):
    """Each visit of an element is counted after so much work."""
    i = take(queue, wp.tid())
    if i < 0:
        return
    sink = float(work[i])
    for k in range(work[i]):
        sink += wp.sin(float(k))
    visits[i] = visits[i] + wp.where(sink < 1.0e9, 1, 0)


@pytest.mark.parametrize("threads", ["1", "2", "5"])
@pytest.mark.parametrize("count", [1, 3, 64, 5000])
def test_every_element_is_taken_once(threads, count, monkeypatch):
    rng = np.random.default_rng(0)
    monkeypatch.setenv("GRASPMATCH_THREADS", threads)
    work = wp.array(rng.integers(0, 200, size=count) ** 2 // 40, dtype=wp.int32, device="cpu")
    visits = wp.zeros(count, dtype=wp.int32, device="cpu")
    for times in range(1, 21):
        launch(count_visits, count, [work], [visits], "cpu")
        np.testing.assert_array_equal(visits.numpy(), times)


@wp.kernel
def double_the_neighbour(queue: Queue, work: wp.array(dtype=wp.int32), values: wp.array2d(dtype=wp.int32)):
    """In every round the value of an element is twice the one that the next element had in the round before."""
    element = take(queue, wp.tid())
    if element < 0:
        return
    n = work.shape[0]
    sink = float(work[element % n])
    for k in range(work[element % n]):
        sink += wp.sin(float(k))
    before = element / n
    values[before + 1, element % n] = 2 * values[before, (element + 1) % n] + wp.where(sink < 1.0e9, 0, 1)


@pytest.mark.parametrize("threads", ["1", "2", "5"])
@pytest.mark.parametrize("count", [1, 2, 300])
def test_a_round_begins_when_the_one_before_is_done(threads, count, monkeypatch):
    rng = np.random.default_rng(0)
    monkeypatch.setenv("GRASPMATCH_THREADS", threads)
    work = wp.array(rng.integers(0, 200, size=count) ** 2 // 40, dtype=wp.int32, device="cpu")
    first = rng.integers(0, 100, size=count)
    for _ in range(10):
        values = wp.array(np.vstack([first, np.zeros((20, count))]), dtype=wp.int32, device="cpu")
        launch(double_the_neighbour, count, [work], [values], "cpu", rounds=20)
        np.testing.assert_array_equal(values.numpy()[20], 2**20 * np.roll(first, -20))


@pytest.mark.parametrize("wrong", [wp.zeros(3, dtype=wp.float32, device="cpu"), 1, None, Queue()])
def test_an_argument_of_another_type_is_an_error(wrong):
    visits = wp.zeros(3, dtype=wp.int32, device="cpu")
    with pytest.raises(TypeError, match="count_visits: 'work' cannot be"):
        launch(count_visits, 3, [wrong], [visits], "cpu")
    assert not visits.numpy().any()


def test_another_number_of_arguments_is_an_error():
    visits = wp.zeros(3, dtype=wp.int32, device="cpu")
    for wrong in ([], [visits, visits]):
        with pytest.raises(TypeError, match="count_visits takes 2 arguments"):
            launch(count_visits, 3, wrong, [visits], "cpu")


def test_a_launch_of_nothing_does_nothing():
    visits = wp.zeros(1, dtype=wp.int32, device="cpu")
    launch(count_visits, 0, [visits], [visits], "cpu")
    assert visits.numpy()[0] == 0


def test_number_of_threads_that_is_none_is_an_error(monkeypatch):
    for wrong in ("-1", "0", "many"):
        monkeypatch.setenv("GRASPMATCH_THREADS", wrong)
        with pytest.raises(GraspmatchError, match="must be a number of threads"):
            thread_count()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_kernels_run_in_a_forked_process(monkeypatch):
    """The child inherits the thread pool but not its threads."""
    monkeypatch.setenv("GRASPMATCH_THREADS", "2")
    field = stack_fields([Grid(np.zeros(3), 1.0, np.zeros((2, 2, 2)))], "cpu")

    def query() -> None:
        out = wp.empty(8, dtype=wp.float32, device="cpu")
        inputs = [field, wp.zeros(8, dtype=wp.int32, device="cpu"), wp.zeros(8, dtype=wp.vec3, device="cpu")]
        launch(warp_fields.query_stack, 8, inputs, [out], "cpu")

    query()
    child = multiprocessing.get_context("fork").Process(target=query)
    child.start()
    child.join(20)
    child.kill()
    assert child.exitcode == 0


LOADING = """
from graspmatch.kernels import launch, warp_fields, warp_path
launch.load([warp_fields.sweep_along, warp_fields.sweep_across, warp_path.way_clearance], "cpu")
"""


def test_loading_compiles_each_module_once_without_a_launch(tmp_path):
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    subprocess.run([sys.executable, "-c", LOADING], check=True, env=environment)
    compiled = sorted(file.name.split(".")[2].rsplit("_", 1)[0] for file in tmp_path.rglob("*.o"))
    assert compiled == ["warp_fields", "warp_path"]
