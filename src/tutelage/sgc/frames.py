"""What the label of a sealed packet says: a whole message, a piece of a large one, or a sign of life.

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

_LABEL = struct.Struct(">B3xIII")
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
        index, count: of the piece; 0 and 1 for a whole message.
        total: bytes of the whole message.
    """

    kind: Kind
    age: float
    index: int = 0
    count: int = 1
    total: int = 0


def label(kind: Kind, age: float) -> bytes:
    """Of a whole message or a sign of life. age: seconds."""
    return _LABEL.pack(kind, min(int(age * 1000), _LONGEST_AGE), 0, 0)


def pieces(payload: memoryview, age: float) -> Iterator[tuple[bytes, memoryview]]:
    """The labels and pieces of a message that is larger than `PIECE`."""
    milliseconds = min(int(age * 1000), _LONGEST_AGE)
    for index in range(-(-len(payload) // PIECE)):
        label = _LABEL.pack(Kind.PIECE, milliseconds, index, len(payload))
        yield label, payload[index * PIECE : (index + 1) * PIECE]


def age_of(label: bytes) -> float:
    """Seconds since the sender began the stream."""
    return float(_LABEL.unpack(label)[1]) / 1000


def parse(label: bytes, body: bytes) -> Frame:
    """Read the label of a frame.

    Raises:
        Refused: MALFORMED.
    """
    kind, milliseconds, index, total = _LABEL.unpack(label)
    age = milliseconds / 1000
    if kind == Kind.WHOLE:
        return Frame(Kind.WHOLE, age, total=len(body))
    if kind == Kind.LIFE and not body:
        return Frame(Kind.LIFE, age)
    if kind != Kind.PIECE:
        raise Refused(Reason.MALFORMED, "a frame of no known kind")
    count = -(-total // PIECE)
    if not (PIECE < total <= MAX_MESSAGE and index < count):
        raise Refused(Reason.MALFORMED, "a piece of an impossible message")
    if len(body) != (PIECE if index < count - 1 else total - index * PIECE):
        raise Refused(Reason.MALFORMED, "a piece of the wrong length")
    return Frame(Kind.PIECE, age, index, count, total)


class Assembly:
    """Puts the pieces of one stream's messages together. Pieces come in order, or the message is lost."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._next = 0  # sequence number of the piece that must come now
        self.broken = 0
        """Messages of which a piece is missing."""

    def take(self, sequence: int, label: bytes, body: bytes) -> bytes | None:
        """The message that a frame completes, if any.

        Raises:
            Refused: MALFORMED.
        """
        if label[0] == _WHOLE and not self._parts:  # as nearly all are
            return body
        frame = parse(label, body)
        if self._parts and (sequence != self._next or frame.index != len(self._parts)):
            self._parts.clear()
            self.broken += 1
        if frame.kind == Kind.WHOLE:
            return body
        if frame.kind == Kind.LIFE:
            return None
        if frame.index != len(self._parts):
            return None  # the rest of a message whose beginning is lost; counted when it broke, or before we listened
        self._parts.append(body)
        self._next = sequence + 1
        if frame.index < frame.count - 1:
            return None
        parts, self._parts = self._parts, []
        return b"".join(parts)
