"""How several byte strings become one and back: each with its length in front, nothing else."""

from __future__ import annotations

import struct

from tutelage.sgc.reasons import Reason, Refused

_LENGTH = struct.Struct(">I")


def pack(*parts: bytes) -> bytes:
    """Each part after its length (4 bytes, big endian). Injective: different parts give different bytes."""
    return b"".join(piece for part in parts for piece in (_LENGTH.pack(len(part)), part))


def unpack(data: bytes, count: int) -> list[bytes]:
    """The `count` parts that `pack` joined.

    Raises:
        Refused: MALFORMED: too short, too long, or another number of parts.
    """
    parts: list[bytes] = []
    at = 0
    for _ in range(count):
        if at + 4 > len(data):
            raise Refused(Reason.MALFORMED, "ends within a length")
        (length,) = _LENGTH.unpack_from(data, at)
        at += 4
        if length > len(data) - at:
            raise Refused(Reason.MALFORMED, "ends within a part")
        parts.append(bytes(data[at : at + length]))
        at += length
    if at != len(data):
        raise Refused(Reason.MALFORMED, "goes on after its last part")
    return parts
