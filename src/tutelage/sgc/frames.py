"""What stands in front of each message inside its sealed packet: whole, a piece of a large message, or a sign of life.

Large messages travel in pieces, so that sealing, every hop and opening work on different pieces at the same time, and so
that a lost packet costs one piece. The age of the stream tells a receiver whether it has missed the beginning.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

from tutelage.sgc.reasons import Reason, Refused

PIECE = 512 << 10
"""Bytes of a large message that travel in one packet."""

MAX_MESSAGE = 256 << 20
"""Bytes of the largest message. A receiver sets memory aside for a message that has begun, so there must be a limit."""

_HEAD = struct.Struct(">BI")
_PIECE = struct.Struct(">BIII")
_LONGEST_AGE = 0xFFFFFFFF


class Kind(IntEnum):
    """What a frame is."""

    WHOLE = 0
    PIECE = 1
    LIFE = 2  # nothing but a sequence number: shows that the sender lives and what it has sent so far


_WHOLE = int(Kind.WHOLE)


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame, read.

    Attributes:
        kind: what it is.
        age: seconds since the sender began the stream, on its own clock.
        body: the message, or its piece.
        index, count: of the piece; 0 and 1 for a whole message.
        total: bytes of the whole message.
    """

    kind: Kind
    age: float
    body: memoryview
    index: int = 0
    count: int = 1
    total: int = 0


def head(kind: Kind, age: float) -> bytes:
    """What stands in front of a whole message or a sign of life. age: seconds."""
    return _HEAD.pack(kind, min(int(age * 1000), _LONGEST_AGE))


def pieces(payload: memoryview, age: float) -> Iterator[bytes]:
    """The frames of a message that is larger than `PIECE`, each made when it is asked for: the first is soon on its way."""
    count = -(-len(payload) // PIECE)
    milliseconds = min(int(age * 1000), _LONGEST_AGE)
    for index in range(count):
        head = _PIECE.pack(Kind.PIECE, milliseconds, index, len(payload))
        yield b"".join((head, payload[index * PIECE : (index + 1) * PIECE]))


def age_of(payload: bytes | memoryview) -> float:
    """Seconds since the sender began the stream; without end if the frame is too short to tell."""
    return float(_HEAD.unpack_from(payload)[1]) / 1000 if len(payload) >= _HEAD.size else float("inf")


def parse(payload: bytes | memoryview) -> Frame:
    """Read a frame.

    Raises:
        Refused: MALFORMED.
    """
    view = memoryview(payload)
    if len(view) < _HEAD.size:
        raise Refused(Reason.MALFORMED, "a frame shorter than its head")
    kind, age = _HEAD.unpack_from(view)
    if kind == Kind.WHOLE:
        return Frame(Kind.WHOLE, age / 1000, view[_HEAD.size :], total=len(view) - _HEAD.size)
    if kind == Kind.LIFE and len(view) == _HEAD.size:
        return Frame(Kind.LIFE, age / 1000, view[_HEAD.size :])
    if kind != Kind.PIECE or len(view) < _PIECE.size:
        raise Refused(Reason.MALFORMED, "a frame of no known kind")
    _, _, index, total = _PIECE.unpack_from(view)
    count = -(-total // PIECE)
    body = view[_PIECE.size :]
    if not (PIECE < total <= MAX_MESSAGE and index < count):
        raise Refused(Reason.MALFORMED, "a piece of an impossible message")
    if len(body) != (PIECE if index < count - 1 else total - index * PIECE):
        raise Refused(Reason.MALFORMED, "a piece of the wrong length")
    return Frame(Kind.PIECE, age / 1000, body, index, count, total)


class Assembly:
    """Puts the pieces of one stream's messages together. Pieces come in order, or the message is lost."""

    def __init__(self) -> None:
        self._parts: list[memoryview] = []
        self._next = 0  # sequence number of the piece that must come now
        self.broken = 0
        """Messages of which a piece is missing."""

    def take(self, sequence: int, payload: bytes) -> bytes | None:
        """The message that a frame, not yet read, completes, if any.

        Raises:
            Refused: MALFORMED.
        """
        if not self._parts and len(payload) >= _HEAD.size and payload[0] == _WHOLE:  # as nearly all are
            return payload[_HEAD.size :]
        return self.add(sequence, parse(payload))

    def add(self, sequence: int, frame: Frame) -> bytes | None:
        """The message that this frame completes, if any."""
        if self._parts and (sequence != self._next or frame.index != len(self._parts)):
            self._parts.clear()
            self.broken += 1
        if frame.kind == Kind.WHOLE:
            return bytes(frame.body)
        if frame.kind == Kind.LIFE:
            return None
        if frame.index != len(self._parts):
            return None  # the rest of a message whose beginning is lost; counted when it broke, or before we listened
        self._parts.append(frame.body)
        self._next = sequence + 1
        if frame.index < frame.count - 1:
            return None
        parts, self._parts = self._parts, []
        return b"".join(parts)
