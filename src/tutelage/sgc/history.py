"""What a publisher keeps of the recent past, so that subscribers can fetch what they missed; and how they ask for it.

A request names ranges of sequence numbers, an answer holds sealed packets as they were first sent, and the lowest sequence
number that is still there. Neither is trusted: the packets prove themselves, and a wrong number loses no more than a router
could drop anyway.
"""

from __future__ import annotations

import struct
import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator

from tutelage.sgc.reasons import Reason, Refused

PACKETS = 4096
BYTES = 64 << 20
ANSWER = 256 << 10
"""Bytes of an answer, unless a single packet is larger."""
RANGES = 64
"""Of a request."""

_Kept = tuple[int, int, float, bytes | bytearray, bool]
"""Last and first sequence number, when, packet, does it confirm others?"""

_RANGE = struct.Struct(">QQ")
_FLOOR = struct.Struct(">Q")
_LENGTH = struct.Struct(">I")


class History:
    """The newest packets of one stream, in order. Safe to use from several threads."""

    def __init__(self, packets: int = PACKETS, size: int = BYTES, max_age: float | None = None) -> None:
        """
        Args:
            packets, size: how many packets and bytes are kept; the newest packet always is.
            max_age: seconds after which a packet is worthless, None: never.
        """
        self._limit, self._size, self._max_age = packets, size, float("inf") if max_age is None else max_age
        self._lock = threading.Lock()
        self._packets: deque[_Kept] = deque()
        self._held = 0
        self._confirms = False

    def add(self, first: int, last: int, packet: bytes | bytearray, now: float, *, confirms: bool = False) -> None:
        """Keep a packet.

        first, last: sequence numbers of its messages.
        now: seconds of a clock that does not jump.
        confirms: without this one, those before it are worth nothing to the receiver (an anchor of a chain).
        """
        with self._lock:
            kept = self._packets
            kept.append((last, first, now, packet, confirms))
            self._held += len(packet)
            if confirms:
                self._confirms = True
            while len(kept) > self._limit or self._held > self._size or now - kept[0][2] > self._max_age:
                if len(kept) == 1:
                    break
                self._held -= len(kept.popleft()[3])

    def find(self, ranges: Iterable[tuple[int, int]], size: int = ANSWER) -> tuple[int, list[bytes | bytearray]]:
        """The lowest sequence number kept, and the packets with messages in the ranges, oldest first, up to `size` bytes.

        If these are worth nothing without a later one in the ranges, that one, too.
        """
        with self._lock:
            kept = list(self._packets)
        found: list[bytes | bytearray] = []
        total, confirmed = 0, True
        for at in _within(kept, ranges):
            packet, confirms = kept[at][3:]
            total += len(packet)
            if found and total > size:
                if confirmed:
                    break
                if not confirms:
                    continue  # to the anchor
            found.append(packet)
            confirmed = confirms or not self._confirms
        return (kept[0][1] if kept else 0), found

    def nearly_gone(self, first: int) -> bool:
        """Is a sequence number in the older half of a history that is more than half full? It will not be kept for long."""
        with self._lock:
            count = len(self._packets)
            full = count > self._limit // 2 or self._held > self._size // 2
            return full and first <= self._packets[count // 2][0]

    def answer(self, request: bytes) -> bytes:
        """Answer a subscriber's request.

        Raises:
            Refused: MALFORMED.
        """
        floor, packets = self.find(parse_request(request))
        return b"".join([_FLOOR.pack(floor), *(part for packet in packets for part in (_LENGTH.pack(len(packet)), packet))])


def _within(kept: list[_Kept], ranges: Iterable[tuple[int, int]]) -> Iterator[int]:
    """Indices of the packets with messages in the ranges, each once."""
    done = 0
    for first, last in ranges:
        for at in range(max(done, bisect_left(kept, (first,))), len(kept)):
            if kept[at][1] > last:
                break
            yield at
            done = at + 1


def make_request(ranges: Iterable[tuple[int, int]]) -> bytes:
    """A request for the messages of some ranges, first and last included; beyond `RANGES` the rest is left out."""
    return b"".join(_RANGE.pack(first, last) for first, last in list(ranges)[:RANGES])


def parse_request(request: bytes) -> list[tuple[int, int]]:
    """The ranges of a request, in order.

    Raises:
        Refused: MALFORMED.
    """
    if not request or len(request) % _RANGE.size or len(request) > RANGES * _RANGE.size:
        raise Refused(Reason.MALFORMED, "a request for missing messages of a wrong length")
    ranges: list[tuple[int, int]] = list(_RANGE.iter_unpack(request))
    ends = [end for pair in ranges for end in pair]
    if ends != sorted(ends):
        raise Refused(Reason.MALFORMED, "ranges out of order")
    return ranges


def parse_answer(answer: bytes) -> tuple[int, list[memoryview]]:
    """The lowest sequence number that the publisher still has, and packets.

    Raises:
        Refused: MALFORMED.
    """
    if len(answer) < _FLOOR.size:
        raise Refused(Reason.MALFORMED, "an answer without its head")
    packets, at, view = [], _FLOOR.size, memoryview(answer)
    while at < len(view):
        if at + _LENGTH.size > len(view):
            raise Refused(Reason.MALFORMED, "an answer that ends within a length")
        (length,) = _LENGTH.unpack_from(view, at)
        at += _LENGTH.size
        if length > len(view) - at:
            raise Refused(Reason.MALFORMED, "an answer that ends within a packet")
        packets.append(view[at : at + length])
        at += length
    floor: int = _FLOOR.unpack_from(view)[0]
    return floor, packets
