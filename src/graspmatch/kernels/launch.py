"""Where kernels run: device names, and launches cut into chunks so that the CPU uses all its cores.

A Warp launch on the CPU runs on one thread but releases the interpreter lock, so chunks of the same launch run side by
side on a pool. Every kernel launched this way takes the index of its first element as first argument, and writes only
its own elements: results do not depend on the number of chunks.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import itertools
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from graspmatch.errors import GraspmatchError


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Warp's native loader reports a missing CUDA driver on the file descriptor itself, on every start; being without a
    GPU is no news to a user without one, and `resolve_device` says it where it matters."""
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


wp.config.log_level = wp.LOG_ERROR
with _silent_stderr():
    wp.init()


def resolve_device(name: str) -> str:
    """The Warp device of a name: `auto` is CUDA where there is a device, else the CPU."""
    cuda = [str(device) for device in wp.get_cuda_devices()]
    if name == "auto":
        return cuda[0] if cuda else "cpu"
    if name == "cuda" and cuda:
        return cuda[0]
    if name not in ("cpu", *cuda):
        raise GraspmatchError(f"No device named '{name}'. Available: {', '.join(['cpu', *cuda])}.")
    return name


@functools.cache
def _cores() -> int:
    """That this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="graspmatch")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked child has the pool but not its threads


def thread_count() -> int:
    """Number of CPU threads used for kernels: `GRASPMATCH_THREADS`, else the cores this process may run on."""
    wanted = os.environ.get("GRASPMATCH_THREADS")
    if not wanted:
        return _cores()
    if not wanted.isdecimal() or int(wanted) == 0:
        raise GraspmatchError(f"GRASPMATCH_THREADS is '{wanted}'; it must be a number of threads, 1 or more.")
    return int(wanted)


def upload(values: ArrayLike, dtype: Any, device: str) -> wp.array:
    """Values as kernels take them. Of those that change their type on the way there is no second copy on a CPU, which
    takes a third of the time; nobody may change the others afterwards."""
    scalar = np.int32 if dtype is wp.int32 else np.float32
    return wp.array(np.ascontiguousarray(values, dtype=scalar), dtype=dtype, device=device, copy=device != "cpu")


def download(values: wp.array) -> np.ndarray:
    """What kernels have written; on a CPU the memory itself, which the next launch may change."""
    return np.asarray(values) if values.device.is_cpu else values.numpy()


def launch(
    kernel: wp.Kernel,
    dim: int,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    device: str,
    *,
    lanes: int = 1,
    chunks: int = 1,
) -> None:
    """Run `kernel(first, *inputs, *outputs)` for elements 0 to `dim`, on all cores or on the GPU.

    lanes: threads for each element on the GPU.
    chunks: pieces that each CPU thread's share is cut into, where elements differ much in what they cost.
    """
    if dim == 0:
        return
    if device != "cpu":
        wp.launch(kernel, dim * lanes, [0, *inputs], outputs, device=device, block_dim=128)
        return
    threads = min(thread_count(), dim)
    pieces = min(threads * chunks, dim)
    bounds = itertools.pairwise(dim * i // pieces for i in range(pieces + 1))
    first = wp.launch(kernel, dim, [0, *inputs], outputs, device=device, record_cmd=True)
    others = [_copy_of(first) for _ in range(threads - 1)]
    waiting = iter(list(bounds))  # of which every thread takes the next as soon as it is free
    jobs = [_pool(threads).submit(_run_all, command, waiting) for command in others]
    _run_all(first, waiting)
    for job in jobs:
        if not job.cancel():  # a thread that has not woken by now finds nothing left
            job.result()


def _copy_of(command: wp.Launch) -> wp.Launch:
    """The same launch with parameters of its own: packing them again takes ten times as long."""
    twin = copy.copy(command)
    twin.params, twin.fwd_args = list(command.params), list(command.fwd_args)
    return twin


def _run_all(command: wp.Launch, bounds: Iterator[tuple[int, int]]) -> None:
    for begin, end in bounds:
        command.set_dim(end - begin)
        command.set_param_at_index(0, begin)
        command.launch()
