"""How rosbridge packs messages: CBOR with typed arrays (RFC 8949, RFC 8746), PNG, fragments."""

from __future__ import annotations

import base64
import json
import math
import struct
import zlib
from typing import Any

import numpy as np

_TYPED = {"u1": 64, "<u2": 69, "<u4": 70, "<u8": 71, "i1": 72, "<i2": 77, "<i4": 78, "<i8": 79, "<f4": 85, "<f8": 86}
_TAGS = {np.dtype(name): tag for name, tag in _TYPED.items()}
MAX_FRAGMENTS = 10_000


def dump_json(message: dict[str, Any]) -> str:
    """As text."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False)


def dump_cbor(value: Any) -> bytes:
    """As CBOR. NumPy arrays of numbers become typed arrays, little-endian; those of booleans become lists."""
    out = bytearray()
    _cbor(value, out)
    return bytes(out)


def _cbor(value: Any, out: bytearray) -> None:
    if value is None or isinstance(value, bool):
        out.append({None: 0xF6, False: 0xF4, True: 0xF5}[value])
    elif isinstance(value, int):
        _head(0, value, out) if value >= 0 else _head(1, -1 - value, out)
    elif isinstance(value, float):
        out += b"\xfb" + struct.pack(">d", value)
    elif isinstance(value, bytes):
        _head(2, len(value), out)
        out += value
    elif isinstance(value, str):
        text = value.encode()
        _head(3, len(text), out)
        out += text
    elif isinstance(value, dict):
        _head(5, len(value), out)
        for key, item in value.items():
            _cbor(key, out)
            _cbor(item, out)
    elif isinstance(value, np.ndarray) and (tag := _TAGS.get(value.dtype)) is not None:
        _head(6, tag, out)
        _cbor(value.tobytes(), out)
    else:
        _head(4, len(value), out)
        for item in value.tolist() if isinstance(value, np.ndarray) else value:
            _cbor(item, out)


def _head(major: int, number: int, out: bytearray) -> None:
    if number < 24:
        out.append(major << 5 | number)
        return
    for code, (limit, form) in enumerate(((1 << 8, ">B"), (1 << 16, ">H"), (1 << 32, ">I"), (1 << 64, ">Q")), 24):
        if number < limit:
            out.append(major << 5 | code)
            out += struct.pack(form, number)
            return
    raise ValueError("too large a number for CBOR")


def dump_png(text: str) -> str:
    """Text as the bytes of an RGB image, padded with line ends, as base64; what rosbridge calls PNG compression."""
    data = text.encode()
    width = max(1, math.isqrt(len(data) // 3))
    height = -(-len(data) // (3 * width))
    padded = data.ljust(3 * width * height, b"\n")
    rows = b"".join(b"\0" + padded[at : at + 3 * width] for at in range(0, len(padded), 3 * width))
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows, 1)), (b"IEND", b""))
    png = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )
    return base64.b64encode(png).decode("ascii")


def fragments(text: str, size: int, ident: str) -> list[str]:
    """A message's text as fragment messages of at most `size` characters of it each; `ident` is the message's."""
    size = max(size, -(-len(text) // MAX_FRAGMENTS))
    pieces = [text[at : at + size] for at in range(0, len(text), size)]
    common = {"op": "fragment", "id": ident, "total": len(pieces)}
    return [dump_json({**common, "data": piece, "num": i}) for i, piece in enumerate(pieces)]


class Defragmenter:
    """Puts a client's fragments together again.

    Args:
        limit: characters of one message, and of all unfinished ones together.
    """

    MOST = 16
    """Unfinished messages; the oldest is forgotten when there are more."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._size = 0
        self._parts: dict[str, dict[int, str]] = {}

    def add(self, message: dict[str, Any]) -> str | None:
        """The whole text once all its fragments are there.

        Raises:
            ValueError: an impossible fragment, or too much of them.
        """
        ident, data, num, total = (message.get(key) for key in ("id", "data", "num", "total"))
        whole = isinstance(num, int) and isinstance(total, int) and 0 <= num < total <= MAX_FRAGMENTS
        if not (isinstance(ident, str | int) and isinstance(data, str) and whole):
            raise ValueError(f"a fragment needs id, data, num and total, with num < total <= {MAX_FRAGMENTS}")
        key = str(ident)
        parts = self._parts.setdefault(key, {})
        self._size += len(data) - len(parts.get(num, ""))  # type: ignore[arg-type]
        parts[num] = data  # type: ignore[index]
        if self._size > self._limit:
            self._parts.clear()
            self._size = 0
            raise ValueError(f"fragments of more than {self._limit} characters; all of them are dropped")
        if len(parts) == total:
            self._forget(key)
            if set(parts) != set(range(total)):
                raise ValueError("fragments do not fit together")
            return "".join(parts[i] for i in range(total))
        if len(self._parts) > self.MOST:
            self._forget(next(iter(self._parts)))
        return None

    def _forget(self, key: str) -> None:
        self._size -= sum(map(len, self._parts.pop(key).values()))
