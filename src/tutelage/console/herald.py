"""Tells subscribers what happened, in order, from a thread of its own; of a lease that ended when it is on the disk."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable

from tutelage.console.audit import Audit
from tutelage.console.states import LeaseEnded, Stepped, Told
from tutelage.errors import TutelageError

_LOG = logging.getLogger(__name__)
LATE = 200
"""Events that may wait; beyond that, timesteps are left out."""


class Herald:
    """Who is told what. `tell` returns at once, from any thread.

    Args:
        audit: a lease that ended is told of after all that was recorded before is durable.
    """

    def __init__(self, audit: Audit) -> None:
        self._audit = audit
        self._queue: queue.SimpleQueue[Told | None] = queue.SimpleQueue()
        self._listeners: tuple[Callable[[Told], None], ...] = ()
        self._unsaved: list[LeaseEnded] = []
        self._thread = threading.Thread(target=self._run, name="herald", daemon=True)

    def start(self) -> None:
        """Begin to tell."""
        self._thread.start()

    def tell(self, event: Told) -> None:
        """Tell everybody, soon."""
        self._queue.put(event)

    def subscribe(self, listener: Callable[[Told], None]) -> Callable[[], None]:
        """Tell this one too, until what is returned is called."""
        self._listeners = (*self._listeners, listener)

        def unsubscribe() -> None:
            self._listeners = tuple(known for known in self._listeners if known is not listener)

        return unsubscribe

    def close(self) -> None:
        """Tell what waits, then end."""
        self._queue.put(None)
        if self._thread.is_alive():
            self._thread.join(15.0)

    def _run(self) -> None:
        while (event := self._queue.get()) is not None:
            if isinstance(event, LeaseEnded):
                self._unsaved.append(event)
            elif not (isinstance(event, Stepped) and self._queue.qsize() > LATE):
                self._pass_on(event)
            self._acknowledge()
        self._acknowledge()

    def _acknowledge(self) -> None:
        """Leases whose record is durable by now."""
        if not self._unsaved:
            return
        try:
            self._audit.flush()
        except TutelageError:
            return  # tried again after the next event; there is one every timestep, and while robots are held
        ended, self._unsaved = self._unsaved, []
        for event in ended:
            self._pass_on(event)

    def _pass_on(self, event: Told) -> None:
        for listener in self._listeners:
            try:
                listener(event)
            except Exception:
                _LOG.exception("a listener failed")
