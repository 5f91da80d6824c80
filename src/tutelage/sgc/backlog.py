"""What a publisher has yet to send: a bounded queue from which small messages come out together."""

from __future__ import annotations

from collections import deque

QUEUE_MESSAGES = 1024
QUEUE_BYTES = 64 << 20
BATCH_MESSAGES, BATCH_BYTES = 256, 256 << 10
"""What goes out at once at most, unless one message is larger: so much that a signature is a small part of what it costs."""

Batch = list[tuple[bytes, int]]
"""Messages, each with the time at which it was sent in nanoseconds since 1970."""


class Backlog:
    """Messages in order, at most `QUEUE_MESSAGES` of `QUEUE_BYTES`; a single one may be larger. Not for several threads at
    once."""

    def __init__(self, spread: int) -> None:
        """spread: nanoseconds by which the messages of a batch may differ in age, as it has the age of its oldest."""
        self._spread = spread
        self._queue: deque[tuple[bytes, int]] = deque()
        self._bytes = 0

    def __len__(self) -> int:
        """Messages that wait."""
        return len(self._queue)

    def room(self, size: int) -> bool:
        """Is there room for a message of so many bytes?"""
        return not self._queue or (len(self._queue) < QUEUE_MESSAGES and self._bytes + size <= QUEUE_BYTES)

    def add(self, payload: bytes, sent: int) -> int:
        """Another message, if there is room; how many wait then, 0: no room. sent: nanoseconds since 1970."""
        if not self.room(len(payload)):
            return 0
        self._queue.append((payload, sent))
        self._bytes += len(payload)
        return len(self._queue)

    def take(self) -> Batch:
        """What goes out next: small messages together, a large one alone. There must be some."""
        queue = self._queue
        batch = [queue.popleft()]
        size = len(batch[0][0])
        until = batch[0][1] + self._spread
        while queue and len(batch) < BATCH_MESSAGES:
            payload, sent = queue[0]
            if size + len(payload) > BATCH_BYTES or sent > until:
                break
            batch.append(queue.popleft())
            size += len(payload)
        self._bytes -= size
        return batch

    def put_back(self, batch: Batch) -> None:
        """What was taken could not be sent yet."""
        self._queue.extendleft(reversed(batch))
        self._bytes += sum(len(payload) for payload, _ in batch)

    def drop(self) -> int:
        """Forget all of it; how many messages that were."""
        count = len(self._queue)
        self._queue.clear()
        self._bytes = 0
        return count
