"""The emergency stop of a robot: it acts at once, and stays until the server clears it, whatever is restarted meanwhile."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

from tutelage.errors import TutelageError
from tutelage.files import write_atomic
from tutelage.remote.messages import Counts, Malformed, StopOperation
from tutelage.remote.wire import unpack_stop

log = logging.getLogger(__name__)

FILE = "stopped"
SERVERS = 16


class Latch:
    """Latched by the stop lane, or here on the robot. Safe to use from several threads.

    The latch is a file in the robot's folder: a robot that is switched off and on is still stopped.

    Attributes:
        counts: messages on the lane that were dropped, by reason.
    """

    def __init__(self, folder: Path | None, on_stop: Callable[[bool], None], on_clear: Callable[[], None]) -> None:
        """
        Args:
            folder: of the robot's node; None: nothing outlasts the program.
            on_stop, on_clear: called at once, on the thread of whoever says so. on_stop is called for each message, as the
                first call may have failed, and is told whether it is the first.
        """
        self.counts = Counts()
        self._file = None if folder is None else folder / FILE
        self._on_stop, self._on_clear = on_stop, on_clear
        self._lock = threading.Lock()
        self._stopped = self._file is not None and self._file.exists()
        self._newest: OrderedDict[int, int] = OrderedDict()

    @property
    def stopped(self) -> bool:
        """Is it latched?"""
        return self._stopped

    def take(self, data: bytes) -> None:
        """A message came on the lane."""
        try:
            message = unpack_stop(data)
        except Malformed:
            self.counts.add("malformed")
            return
        with self._lock:
            late = message.number <= self._newest.get(message.server, 0)
            if not late:
                self._newest[message.server] = message.number
                self._newest.move_to_end(message.server)
                while len(self._newest) > SERVERS:
                    self._newest.popitem(last=False)
        if late:
            self.counts.add("replaced")
        elif message.operation == StopOperation.STOP:
            self.stop()
        else:
            self._clear()

    def stop(self) -> None:
        """Stop now. Also for a button on the robot itself."""
        first, self._stopped = not self._stopped, True  # before anything that may take time
        self._on_stop(first)
        if self._file is not None and not self._file.exists():
            try:
                write_atomic(self._file, b"emergency stop; the server clears it\n")
            except TutelageError as error:  # the disk is full, for instance
                log.warning("the emergency stop holds, but would not outlast this program: %s", error)

    def _clear(self) -> None:
        if self._file is not None:
            try:
                self._file.unlink(missing_ok=True)
            except OSError as error:
                log.warning("the emergency stop is cleared, but will be back after the next start: %s", error)
        if self._stopped:
            self._stopped = False
            self._on_clear()
            if self._stopped:  # by a button on the robot, meanwhile
                self._on_stop(True)
