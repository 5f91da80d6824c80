"""Latched topics (transient_local) across the fleet: who comes late gets the last messages, and nobody gets them twice.

The sending proxy keeps the last messages and repeats them, all in one message, when a node arrives, and now and then in case
one arrived unseen. The repetition starts with a byte that no serialized message starts with. A receiver that has got those
messages drops it; one that has not, delivers them in order.
"""

from __future__ import annotations

import hashlib
import struct
import threading
import time
from collections import deque
from collections.abc import Callable

REPEAT = b"\xfftutelage repeat 1\n"
_LENGTH = struct.Struct("<I")
AFTER_ARRIVAL = (0.5, 2.0, 8.0)
"""Seconds after a node has appeared: its subscription may come some time after it."""
EVERY = 30.0
RATE = 10_000
"""At least so many seconds between two repetitions, and at most so many bytes a second on average."""
MAX_BYTES = 64 << 20
"""Of the messages that are repeated; the oldest are left out beyond."""


class Retained:
    """The last messages of a topic, on the side that sends. Safe to use from several threads.

    Args:
        depth: how many.
        send: sends a message to the fleet.
    """

    def __init__(self, depth: int, send: Callable[[bytes], None]) -> None:
        self._messages: deque[bytes] = deque(maxlen=depth)
        self._send = send
        self._lock = threading.Lock()  # what is repeated must be in step with what was sent
        self._due: list[float] = []
        self._peers: frozenset[str] = frozenset()
        self.repeated = 0

    def send(self, message: bytes) -> None:
        """Send a new message, and keep it."""
        with self._lock:
            self._messages.append(message)
            self._send(message)
            if len(self._due) == 0:
                self._due.append(time.monotonic() + self._pause())

    def tend(self, peers: frozenset[str]) -> None:
        """To be called twice a second, with who is present on the topic: repeat what is due."""
        now = time.monotonic()
        with self._lock:
            if peers - self._peers:
                self._due += [now + after for after in AFTER_ARRIVAL]
            self._peers = peers
            if self._messages and any(at <= now for at in self._due):
                self._due = [at for at in self._due if at > now]
                self._send(_pack(self._messages))
                self.repeated += 1
                if not self._due:
                    self._due.append(now + self._pause())

    def _pause(self) -> float:
        return max(EVERY, sum(map(len, self._messages)) / RATE)


class Newcomer:
    """Messages and their repetitions, on the side that receives. Used by one thread.

    Args:
        depth: how many messages to remember of each sender, to tell a repetition of them; 0: take repetitions only of
            senders that have not been heard before, which needs no memory.
    """

    def __init__(self, depth: int = 0) -> None:
        self._depth = depth
        self._heard: dict[str, deque[bytes]] = {}

    def accept(self, sender: str, payload: bytes) -> list[bytes]:
        """The messages to deliver: the payload itself, or what it repeats as far as it is news."""
        heard = self._heard.get(sender)
        if not payload.startswith(REPEAT):
            if heard is None:
                heard = self._heard[sender] = deque(maxlen=self._depth)
            if self._depth:
                heard.append(_digest(payload))
            return [payload]
        messages = _unpack(payload)
        marks = [_digest(message) for message in messages] if self._depth else []
        known = heard is not None and (not self._depth or list(heard)[-len(marks) :] == marks[-self._depth :])
        if known or not messages:
            return []
        self._heard[sender] = deque(marks, maxlen=self._depth)
        return messages


def _digest(message: bytes) -> bytes:
    return hashlib.sha256(message).digest()


def _pack(messages: deque[bytes]) -> bytes:
    kept: list[bytes] = []
    size = 0
    for message in reversed(messages):
        size += len(message)
        if kept and size > MAX_BYTES:
            break
        kept.append(message)
    return REPEAT + b"".join(_LENGTH.pack(len(message)) + message for message in reversed(kept))


def _unpack(payload: bytes) -> list[bytes]:
    """Empty if it is damaged, which only a member of the topic could have done."""
    messages, at = [], len(REPEAT)
    while at < len(payload):
        if at + _LENGTH.size > len(payload):
            return []
        (length,) = _LENGTH.unpack_from(payload, at)
        at += _LENGTH.size
        if length > len(payload) - at:
            return []
        messages.append(payload[at : at + length])
        at += length
    return messages
