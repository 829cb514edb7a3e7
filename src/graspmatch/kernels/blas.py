"""Products of matrices beside kernels."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator

from threadpoolctl import ThreadpoolController


@contextlib.contextmanager
def blas_on_one_thread() -> Iterator[None]:
    """While it lasts, matrix products have one thread: the others of OpenBLAS wait for the next product in a loop, for
    longer than a stage of a plan takes, on the cores that kernels run on."""
    with _blas().limit(limits=1, user_api="blas"):
        yield


@functools.cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()
