"""A few threads for work that waits: questions to other nodes, handlers of requests. Bounded; they keep no program alive."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

log = logging.getLogger(__name__)


class Workers:
    """Threads that start as they are needed and end with the program, unlike those of a ThreadPoolExecutor."""

    def __init__(self, name: str, threads: int = 8, waiting: int = 256) -> None:
        """
        Args:
            threads: that work at a time.
            waiting: calls that may wait for them.
        """
        self._name = name
        self._limit = threads
        self._waiting: queue.Queue[tuple[Callable[..., Any], tuple[Any, ...]] | None] = queue.Queue(waiting)
        self._lock = threading.Lock()
        self._started = self._idle = 0
        self._closed = False
        self._threads: list[threading.Thread] = []

    def submit(self, call: Callable[..., Any], *args: Any) -> bool:
        """Call it on one of the threads; False: too many calls wait already, or `close` was called, and it is not called."""
        with self._lock:
            if self._closed:
                return False
            try:
                self._waiting.put_nowait((call, args))
            except queue.Full:
                return False
            if self._waiting.qsize() > self._idle and self._started < self._limit:
                self._started += 1
                thread = threading.Thread(target=self._work, name=f"{self._name}-{self._started}", daemon=True)
                self._threads.append(thread)
                thread.start()
        return True

    def close(self) -> None:
        """Call nothing more; does not wait for what runs."""
        with self._lock:
            self._closed = True
            while True:
                try:
                    self._waiting.get_nowait()
                except queue.Empty:
                    break
            for _ in range(min(self._started, self._waiting.maxsize)):
                self._waiting.put_nowait(None)

    def join(self, timeout: float) -> None:
        """After `close`: wait for what runs, at most so many seconds. A program that ends while one of its threads is inside
        the network's library may end with an abort."""
        until = time.monotonic() + timeout
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, until - time.monotonic()))

    def _work(self) -> None:
        while True:
            with self._lock:
                self._idle += 1
            job = self._waiting.get()
            with self._lock:
                self._idle -= 1
            if job is None:
                return
            try:
                job[0](*job[1])
            except Exception:
                log.exception("%s", self._name)
