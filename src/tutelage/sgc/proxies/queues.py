"""Queues with an end: what does not fit pushes out the oldest, and is counted."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class BoundedQueue(Generic[T]):
    """From any thread to one thread.

    Args:
        size: how many items wait at most.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._items: deque[T] = deque(maxlen=size)
        self._changed = threading.Condition()
        self._closed = False
        self.dropped = 0

    def put(self, item: T) -> None:
        """Add an item; the oldest one goes if the queue is full."""
        with self._changed:
            self.dropped += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._changed.notify()

    def get(self) -> T | None:
        """Wait for the next item; None once the queue is closed and empty."""
        with self._changed:
            while not self._items:
                if self._closed:
                    return None
                self._changed.wait()
            return self._items.popleft()

    def close(self) -> None:
        """Let `get` return None once it is empty."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def room(self) -> int:
        """How many more items fit."""
        return self._size - len(self._items)

    def __len__(self) -> int:
        return len(self._items)


class LoopQueue(Generic[T]):
    """From any thread to a coroutine.

    Args:
        size: how many items wait at most.
        loop: the event loop of the coroutine.
    """

    def __init__(self, size: int, loop: asyncio.AbstractEventLoop) -> None:
        self._items: deque[T] = deque(maxlen=size)
        self._loop = loop
        self._filled = asyncio.Event()
        self._changed = threading.Condition()
        self._waking = False
        self.dropped = 0

    def put(self, item: T, timeout: float = 0.0) -> None:
        """Add an item; the oldest one goes if the queue is full. Does nothing once the loop is closed.

        timeout: seconds to wait for room before that. Not on the loop's own thread.
        """
        if not (timeout and self.offer(item, timeout)):
            with self._changed:
                self.dropped += self.full
                self._items.append(item)
            self._wake()

    def offer(self, item: T, timeout: float) -> bool:
        """Add an item; False if there is no room within so many seconds. Not on the loop's own thread."""
        with self._changed:
            if not self._changed.wait_for(lambda: not self.full, timeout):
                return False
            self._items.append(item)
        self._wake()
        return True

    async def get(self) -> T:
        """Wait for the next item."""
        while True:
            with self._changed:
                if self._items:
                    self._changed.notify()
                    return self._items.popleft()
                self._waking = False
                self._filled.clear()
            await self._filled.wait()

    @property
    def full(self) -> bool:
        """Would the next item push out another one?"""
        return len(self._items) == self._items.maxlen

    def __len__(self) -> int:
        return len(self._items)

    def _wake(self) -> None:
        with self._changed:
            wake, self._waking = not self._waking, True
        if wake:
            with contextlib.suppress(RuntimeError):  # the loop is closed: nobody reads any more
                self._loop.call_soon_threadsafe(self._filled.set)
