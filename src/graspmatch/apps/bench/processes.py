"""Work in many processes, each of which keeps to its share of the cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import TypeVar

from graspmatch.apps.bench.machine import usable_cores

Job = TypeVar("Job")
Result = TypeVar("Result")


def in_processes(work: Callable[[Job], Result], jobs: Iterable[Job], *, processes: int) -> Iterator[Result]:
    """The results as they come, in any order; work and jobs are sent to other processes, where they are several."""
    if processes == 1:
        yield from map(work, jobs)
        return
    # Fresh interpreters with one thread each: the cores are shared out among processes.
    context = get_context("spawn")
    threads = str(max(1, usable_cores() // processes))
    with ProcessPoolExecutor(processes, context, initializer=use_threads, initargs=(threads,)) as pool:
        futures = [pool.submit(work, job) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            for future in futures:
                future.cancel()


def use_threads(threads: str) -> None:
    """Of a process, for kernels."""
    os.environ.setdefault("GRASPMATCH_THREADS", threads)
