"""The cores of this machine and the threads that physics and learning share, and how memory between them is reused."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from threading import Lock, Thread
from typing import Any

import numpy as np


def available_cores() -> int:
    """How many cores this process may use (respects affinity masks)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def default_torch_threads() -> int:
    """Threads of matrix products: those of a policy are too small for more than four."""
    return min(4, available_cores())


class Together:
    """Pieces of work that helpers begin in the background, and that whoever waits for them takes a hand in.

    Physics and learning share the helpers: with the thread that waits, they are no more than `threads`. A thread that waits
    for pieces that helpers have begun does what else there is to do meanwhile, whoever it is for. Pieces are to be compiled
    code, or others that hold no interpreter lock for long, and must not wait for one another.

    Args:
        threads: how many threads compute side by side, the one that waits included. With one, all is done by `results`.
        pieces: the pieces.
    """

    def __init__(self, threads: int, pieces: Sequence[Callable[[], Any]]) -> None:
        self._pieces = [_Piece(piece) for piece in pieces]
        self._helpers = _helpers(threads - 1) if threads > 1 else None
        if self._helpers:
            self._helpers.add(self._pieces)

    def results(self) -> list[Any]:
        """Do what nobody has begun, and wait for the rest; what the pieces returned. Raises what one of them raised."""
        for piece in reversed(self._pieces):  # helpers come from the other end
            piece.do()
        for piece in self._pieces:
            while self._helpers and piece.ended.locked() and (other := self._helpers.next()):
                other.do()
            with piece.ended:
                pass
        for piece in self._pieces:
            if piece.error is not None:
                raise piece.error
        return [piece.result for piece in self._pieces]


def share(kernel: Callable[..., None], items: int, threads: int, *arguments: Any) -> Together:
    """Start some work in the background, in at most so many threads; ask for its `results` before you use what it wrote.

    kernel: compiled code that holds no interpreter lock. kernel(counter, *arguments) does item `claim(counter)`, again and
        again, until there are no more than that (`tutelage.claims`).
    """
    work = partial(kernel, np.zeros(1, dtype=np.intp), *arguments)
    return Together(threads, [work] * min(threads, items))


class _Piece:
    """Some work, what it returned or raised, and two locks: one for whoever does it, one that is free when it is done."""

    __slots__ = ("begun", "ended", "error", "result", "work")

    def __init__(self, work: Callable[[], Any]) -> None:
        self.work, self.result = work, None
        self.error: BaseException | None = None
        self.begun, self.ended = Lock(), Lock()
        self.ended.acquire()

    def do(self) -> None:
        """Do it, if nobody has begun."""
        if self.begun.acquire(blocking=False):
            try:
                self.result = self.work()
            except BaseException as error:
                self.error = error  # for whoever asks for the result
                if not isinstance(error, Exception):
                    raise  # Ctrl-C is for the thread that it reached, whoever the piece is for
            finally:
                self.ended.release()


class _Helpers:
    """Threads that do what there is to do, until this process ends."""

    def __init__(self, number: int) -> None:
        self._pieces: deque[_Piece] = deque()
        self._idle: deque[Lock] = deque()  # what each of them that has nothing to do waits for
        self._over = False
        self._threads = [Thread(target=self._help, name=f"helper_{k}", daemon=True) for k in range(number)]
        for thread in self._threads:
            thread.start()
        atexit.register(self._end)  # compiled code must not go on while the process takes down what it works on

    def add(self, pieces: Iterable[_Piece]) -> None:
        """Let helpers do these; as many wake up, all at once."""
        for piece in pieces:
            self._pieces.append(piece)
            self._wake()

    def next(self) -> _Piece | None:
        """What is to be done next, if anything."""
        try:
            return self._pieces.popleft()
        except IndexError:
            return None

    def _wake(self) -> None:
        with contextlib.suppress(IndexError):
            self._idle.pop().release()

    def _help(self) -> None:
        woken = Lock()
        woken.acquire()
        while not self._over:
            if piece := self.next():
                piece.do()
                del piece  # it holds what it worked on
                continue
            self._idle.append(woken)
            if self._pieces or self._over:  # came before anybody could know that this one is idle
                self._wake()
            woken.acquire()

    def _end(self) -> None:
        self._over = True
        for _ in self._threads:
            self._wake()
        for thread in self._threads:
            thread.join()


@cache
def _helpers(number: int) -> _Helpers:
    """So many threads of this process; the same ones for all who ask for the same number."""
    return _Helpers(number)


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
