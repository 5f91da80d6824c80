"""The cores of this machine and the threads that physics and learning share, and how memory between them is reused."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any


def available_cores() -> int:
    """How many cores this process may use (respects affinity masks)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def default_torch_threads() -> int:
    """Threads of matrix products: those of a policy are too small for more than four."""
    return min(4, available_cores())


class Together:
    """Pieces of work that helpers begin in the background, and that whoever waits for them takes a hand in.

    Physics and learning share the helpers: with the thread that waits, they are no more than `threads`. Pieces are to be
    compiled code, or others that hold no interpreter lock for long, and must not wait for one another.

    Args:
        threads: how many threads compute side by side, the one that waits included. With one, all is done by `results`.
        pieces: the pieces.
    """

    def __init__(self, threads: int, pieces: Sequence[Callable[[], Any]]) -> None:
        self._pieces = pieces
        self._futures = [_helpers(threads - 1).submit(piece) for piece in pieces] if threads > 1 else []

    def results(self) -> list[Any]:
        """Do what nobody has begun, and wait for the rest; what the pieces returned. Raises what they raised."""
        if not self._futures:
            return [piece() for piece in self._pieces]
        found: list[Any] = [None] * len(self._pieces)
        begun = []
        for k in reversed(range(len(self._pieces))):  # helpers come from the other end
            if self._futures[k].cancel():
                found[k] = self._pieces[k]()
            else:
                begun.append(k)
        for k in begun:
            found[k] = self._futures[k].result()
        return found


@cache
def _helpers(number: int) -> ThreadPoolExecutor:
    """So many threads of this process; the same ones for all who ask for the same number."""
    return ThreadPoolExecutor(number, thread_name_prefix="helper")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # a forked process has none of these threads


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
