"""Where kernels run: device names, and launches that use all cores of the CPU.

A Warp launch on the CPU runs on one thread but releases the interpreter lock, so that several run side by side. Every
kernel launched this way takes its elements from a `Queue`, its first argument, and writes only those: results do not
depend on the number of threads. Small launches are many: what Python does for each counts.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from graspmatch.errors import GraspmatchError
from graspmatch.kernels.warp_queue import Queue


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


MOST_THREADS = 255
"""That a byte can tell apart."""
BLOCK_DIM = 128
"""Threads of a block on the GPU."""


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="graspmatch")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked child has the pool but not its threads


class _Share(threading.local):
    """What a Python thread may take of the CPU."""

    threads: int | None = None


_share = _Share()


@contextlib.contextmanager
def launches_on(threads: int) -> Iterator[None]:
    """While it lasts, what this Python thread launches has so many CPU threads, for others launch something, too."""
    before, _share.threads = _share.threads, threads
    try:
        yield
    finally:
        _share.threads = before


def thread_count() -> int:
    """Number of CPU threads used for kernels: see `launches_on`, else `GRASPMATCH_THREADS`, else the cores this process
    may run on."""
    if _share.threads is not None:
        return _share.threads
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
    rounds: int = 1,
) -> None:
    """Run `kernel(queue, *inputs, *outputs)` for elements 0 to `dim`, on all cores or on the GPU.

    lanes: threads for each element on the GPU.
    rounds: how often. Elements of the second are numbered from `dim` on, and begin when all of the first are done.
    """
    if dim == 0:
        return
    if device != "cpu":
        for k in range(rounds):
            queue = Queue()
            queue.begin = k * dim
            wp.launch(kernel, dim * lanes, [queue, *inputs], outputs, device=device, block_dim=BLOCK_DIM)
        return
    threads = min(thread_count(), dim, MOST_THREADS)
    shared = np.zeros(rounds * (4 + dim), dtype=np.uint8)
    queues = [Queue.ctype(dim * k // threads, dim, rounds, k + 1, shared.ctypes.data) for k in range(threads)]
    arguments = [*inputs, *outputs]
    packed = _packed(kernel, arguments)
    own, *others = [_command(kernel, [queue, *packed], rounds * dim + 1) for queue in queues]
    jobs = [_pool(threads).submit(_run, other, [shared, *arguments]) for other in others]
    own.launch()
    for job in jobs:
        job.cancel()  # a thread that has not woken by now finds nothing left


def _run(command: wp.Launch, _used: list) -> None:
    """Another thread's share, with all the memory that it may look at as long as it runs."""
    command.launch()


def _command(kernel: wp.Kernel, parameters: list, dim: int) -> wp.Launch:
    command = copy.copy(_blank(kernel))
    command.params = [None, *parameters]
    command.set_dim(dim)  # is the first
    return command


_loading = threading.Lock()


def load(kernels: Sequence[wp.Kernel], device: str) -> None:
    """Get the modules of some kernels ready. What this machine has never compiled is compiled side by side, which
    takes long; the launches would do it one after the other."""
    with _loading:
        _load(tuple(kernels), device)


@functools.cache
def _load(kernels: tuple[wp.Kernel, ...], device: str) -> None:
    modules = {kernel.module.name: kernel.module for kernel in kernels}
    wp.force_load(device, list(modules.values()), block_dim=BLOCK_DIM, max_workers=_cores())


def _blank(kernel: wp.Kernel) -> wp.Launch:
    """A launch on the CPU that lacks its parameters."""
    with _loading:  # the first one loads the kernel, which Warp must not do twice at once
        return _loaded(kernel)


@functools.cache
def _loaded(kernel: wp.Kernel) -> wp.Launch:
    return wp.Launch(kernel, wp.get_device("cpu"))


def _packed(kernel: wp.Kernel, values: list) -> list:
    """Arguments but the first as the kernel reads them: what `wp.launch` does, in a quarter of the time."""
    expected = kernel.adj.args[1:]
    if len(values) != len(expected):
        raise TypeError(f"{kernel.key} takes {len(expected)} arguments, not {len(values)}.")
    return [_packed_one(kernel, argument, value) for argument, value in zip(expected, values, strict=True)]


def _packed_one(kernel: wp.Kernel, argument: Any, value: Any) -> Any:
    kind = argument.type
    if isinstance(value, wp.array):
        is_right = isinstance(kind, wp.array) and value.dtype is kind.dtype and value.ndim == kind.ndim
        packed = value.__ctype__()
    elif hasattr(value, "__ctype__"):  # a struct
        packed = value.__ctype__()
        is_right = type(packed) is getattr(kind, "ctype", None)
    elif isinstance(value, (int, float, np.number)):
        is_right = kind in (wp.int32, wp.uint64, wp.float32)
        packed = kind._type_(value) if is_right else None
    else:  # a vector
        is_right = isinstance(kind, type) and isinstance(value, kind)
        packed = value
    if not is_right:
        raise TypeError(f"{kernel.key}: '{argument.label}' cannot be {value!r}.")
    return packed
