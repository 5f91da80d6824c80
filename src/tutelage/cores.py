"""The cores of this machine and the threads that physics and learning share, and how memory between them is reused."""

from __future__ import annotations

import ctypes
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import cache


def available_cores() -> int:
    """How many cores this process may use (respects affinity masks)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def default_torch_threads() -> int:
    """Threads of matrix products: those of a policy are too small for more than four."""
    return min(4, available_cores())


@cache
def workers(threads: int | None = None) -> ThreadPoolExecutor:
    """So many threads of this process, by default one a core, for compiled code that holds no interpreter lock.

    Whoever asks for the same number gets the same threads: physics and learning take turns in them, so that together they
    have no more than there are cores. What runs in one of them must not wait for another.
    """
    return ThreadPoolExecutor(threads or available_cores(), thread_name_prefix="worker")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=workers.cache_clear)  # a forked process has none of these threads


@cache
def one_thread_a_product() -> None:
    """Let compiled code compute each of its matrix products in the thread that asks for it (in this process, for good)."""
    import scipy.linalg.cython_blas  # noqa: F401  the library that compiled code calls must be there to be told
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, user_api="blas")


def keep_freed_memory() -> None:
    """Let this process keep up to 64 MiB that it freed, where its C library is glibc.

    glibc would give the memory of a gradient step back to the system, and the next step would wait for it page by page.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            trim_threshold, mmap_threshold = -1, -3
            mallopt(trim_threshold, 64 * 2**20)
            mallopt(mmap_threshold, 16 * 2**20)
