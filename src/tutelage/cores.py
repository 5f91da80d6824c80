"""How many cores there are for physics and for matrix products, and how memory between them is reused."""

from __future__ import annotations

import ctypes
import os
import sys


def available_cores() -> int:
    """How many cores this process may use (respects affinity masks)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def default_torch_threads() -> int:
    """Threads of matrix products: those of a policy are too small for more than four."""
    return min(4, available_cores())


def cores_beside_learning() -> int:
    """Threads of physics while one thread learns: of three cores and more, that one is left alone."""
    cores = available_cores()
    return cores - 1 if cores > 2 else cores


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
