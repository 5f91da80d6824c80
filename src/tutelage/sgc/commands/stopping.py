"""Programs that run until they are told to stop."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from types import FrameType

LOOK = 0.2
"""Seconds. The system may give a signal to any thread, such as one of Zenoh's; Python then deals with it only when the main
thread wakes."""


class Stop(threading.Event):
    """An event that may be set by a signal, for the main thread to wait for."""

    def wait(self, timeout: float | None = None) -> bool:
        until = float("inf") if timeout is None else time.monotonic() + timeout
        while not super().wait(max(0.0, min(LOOK, until - time.monotonic()))):
            if time.monotonic() >= until:
                return False
        return True


@contextlib.contextmanager
def until_stopped() -> Iterator[threading.Event]:
    """An event that Ctrl-C or SIGTERM sets; inside, neither ends the program."""
    stop = Stop()

    def ask(number: int, frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
