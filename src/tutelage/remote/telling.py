"""Lines for whoever looks at the terminal, from a thread of their own: a robot never waits for somebody to read them."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import threading
import traceback
from pathlib import Path

from tutelage.errors import TutelageError

WAITING = 200
"""Lines that may wait; more are dropped. A terminal that was paused, or a connection that hangs, takes none."""

LAST = 1.0
"""Seconds for which the end waits for what was said."""


def told(error: Exception) -> str:
    """An error of somebody's own code in one line, with the place; our own errors say what is wrong by themselves."""
    line = " ".join(str(error).split())
    if isinstance(error, TutelageError):
        return line
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {line}{place}" if line else f"{type(error).__name__}{place}"


class Teller:
    """Writes lines to the standard output or to the standard error."""

    def __init__(self) -> None:
        self._lines: queue.Queue[tuple[int, str] | None] = queue.Queue(WAITING)
        self._thread = threading.Thread(target=self._work, name="robot-teller", daemon=True)
        self._thread.start()

    def say(self, line: str, *, error: bool = False) -> None:
        """A line, without its end. Returns at once."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait((2 if error else 1, line))

    def handler(self) -> logging.Handler:
        """What is logged is said, too, on the standard error."""
        return _Handler(self)

    def close(self) -> None:
        """Say what is left, if somebody listens."""
        with contextlib.suppress(queue.Full):
            self._lines.put(None, timeout=LAST)
            self._thread.join(LAST)

    def _work(self) -> None:
        while (said := self._lines.get()) is not None:
            to, line = said
            rest = f"{line}\n".encode(errors="replace")
            with contextlib.suppress(OSError):  # nobody reads it any more; the robot goes on
                while rest:
                    rest = rest[os.write(to, rest) :]


class _Handler(logging.Handler):
    def __init__(self, teller: Teller) -> None:
        super().__init__()
        self._teller = teller

    def emit(self, record: logging.LogRecord) -> None:
        self._teller.say(self.format(record), error=True)
