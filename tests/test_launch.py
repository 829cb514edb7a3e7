"""Launches on several CPU threads: every element is some thread's, once."""

from __future__ import annotations

import multiprocessing

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
