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
_LONGEST_AGE = 4_000_000  # seconds; in milliseconds it just fits


class Kind(IntEnum):
    """What a frame is."""

    WHOLE = 0
    PIECE = 1
    LIFE = 2  # nothing but a sequence number: shows that the sender lives and what it has sent so far


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame, read.

    Attributes:
        kind: what it is.
        index, count: of the piece; 0 and 1 for a whole message.
    """

    kind: Kind
    index: int = 0
    count: int = 1


def label(kind: Kind, age: float, index: int = 0, total: int = 0) -> bytes:
    """Of a frame. age: seconds. index, total: of a piece, and bytes of its whole message."""
    return _LABEL.pack(kind, int(age * 1000) if age < _LONGEST_AGE else _LONGEST_AGE * 1000, index, total)


def pieces(payload: memoryview, age: float) -> Iterator[tuple[bytes, memoryview]]:
    """The labels and pieces of a message that is larger than `PIECE`."""
    for index in range(-(-len(payload) // PIECE)):
        yield label(Kind.PIECE, age, index, len(payload)), payload[index * PIECE : (index + 1) * PIECE]


def age_of(label: bytes) -> float:
    """Seconds since the sender began the stream."""
    return float(_LABEL.unpack(label)[1]) / 1000


def parse(label: bytes, body: bytes) -> Frame:
    """Read the label of a frame.

    Raises:
        Refused: MALFORMED.
    """
    kind, _, index, total = _LABEL.unpack(label)
    if kind == Kind.WHOLE:
        return Frame(Kind.WHOLE)
    if kind == Kind.LIFE and not body:
        return Frame(Kind.LIFE)
    if kind != Kind.PIECE:
        raise Refused(Reason.MALFORMED, "a frame of no known kind")
    count = -(-total // PIECE)
    if not (PIECE < total <= MAX_MESSAGE and index < count):
        raise Refused(Reason.MALFORMED, "a piece of an impossible message")
    if len(body) != (PIECE if index < count - 1 else total - index * PIECE):
        raise Refused(Reason.MALFORMED, "a piece of the wrong length")
    return Frame(Kind.PIECE, index, count)


class Assembly:
    """Puts the pieces of one stream's messages together. Pieces come in order, or the message is lost."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._next = 0  # sequence number of the piece that must come now

    @property
    def unfinished(self) -> bool:
        """Has a message begun that is not complete?"""
        return bool(self._parts)

    def take(self, sequence: int, label: bytes, body: bytes) -> bytes | None:
        """The message that a frame completes, if any.

        Raises:
            Refused: MALFORMED.
        """
        frame = parse(label, body)
        if self._parts and (sequence != self._next or frame.index != len(self._parts)):
            self._parts.clear()
        if frame.kind == Kind.WHOLE:
            return body
        if frame.kind == Kind.LIFE:
            return None
        if frame.index != len(self._parts):
            return None  # the rest of a message whose beginning is lost, or was sent before we listened
        self._parts.append(body)
        self._next = sequence + 1
        if frame.index < frame.count - 1:
            return None
        parts, self._parts = self._parts, []
        return b"".join(parts)
