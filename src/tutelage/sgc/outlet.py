"""Where a subscription's messages leave it: into the application's callback, or a bounded queue that it reads from."""

from __future__ import annotations

import contextlib
import logging
import queue as queues
from collections.abc import Callable

from tutelage.sgc.messages import Message

log = logging.getLogger(__name__)

LOOK = 0.1
"""Seconds between two looks whether the subscription was closed, while the application's queue is full."""


class Outlet:
    """Gives messages to the application, one after the other.

    Attributes:
        received, bytes: messages given, and what they hold.
        superseded: messages of a lossy topic that newer ones replaced.
        failed: exceptions of the callback.
        closed: True when no more is to be given.
    """

    def __init__(self, alias: str, on_message: Callable[[Message], None] | None, limit: int, *, lossy: bool) -> None:
        """
        Args:
            alias: of the topic.
            limit: messages in the queue; beyond, a reliable topic waits, and a lossy one drops the oldest.
        """
        self.received = self.bytes = self.superseded = self.failed = 0
        self.closed = False
        self._alias, self._lossy = alias, lossy
        self._call = self._put if on_message is None else on_message
        self._queue: queues.Queue[Message | None] = queues.Queue(limit)

    def give(self, messages: list[Message]) -> None:
        """To the application."""
        for message in messages:
            self.received += 1
            self.bytes += len(message.payload)
            try:
                self._call(message)
            except Exception:
                self.failed += 1
                log.exception("the callback of %s", self._alias)

    def take(self, timeout: float | None) -> Message | None:
        """The next message of the queue; None: none came within `timeout` seconds, or there will be none any more."""
        try:
            message = self._queue.get(timeout=timeout)
        except queues.Empty:
            return None
        if message is None:
            self._queue.put(None)  # for whoever else waits
        return message

    def end(self) -> None:
        """Whoever reads gets what is there, then the end."""
        while True:
            try:
                self._queue.put_nowait(None)
                return
            except queues.Full:
                self._queue.get_nowait()

    def __len__(self) -> int:
        """Messages that wait for the application."""
        return self._queue.qsize()

    def _put(self, message: Message) -> None:
        while not self.closed:
            try:
                self._queue.put(message, block=not self._lossy, timeout=LOOK)
                return
            except queues.Full:
                if self._lossy:
                    with contextlib.suppress(queues.Empty):
                        self._queue.get_nowait()
                        self.superseded += 1
