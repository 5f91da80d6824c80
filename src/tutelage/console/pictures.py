"""Pictures as JPEG."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import MissingExtraError, TutelageError

try:
    import cv2
except ModuleNotFoundError:
    raise MissingExtraError("opencv-python-headless", "console") from None

cv2.setNumThreads(1)
QUALITY = 80
Picture = NDArray[np.uint8]


def fitted(rgb: Picture, width: int, height: int) -> Picture:
    """(H, W, 3) uint8, made smaller where it is larger than width x height, with its shape kept."""
    scale = min(width / rgb.shape[1], height / rgb.shape[0])
    if scale >= 1:
        return rgb
    size = max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale))
    smaller: Any = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return np.asarray(smaller, dtype=np.uint8)


def jpeg(rgb: Picture) -> bytes:
    """Encode (H, W, 3) uint8."""
    done, encoded = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise ValueError(f"a picture of shape {rgb.shape} cannot be encoded")
    return bytes(encoded.data)


def decoded(content: bytes) -> Picture:
    """A JPEG as (H, W, 3) uint8.

    Raises:
        TutelageError: it is no JPEG.
    """
    picture: Any = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise TutelageError("a robot sent a picture that is no JPEG")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def size_of(content: bytes) -> tuple[int, int]:
    """Width and height of a JPEG, from its header (ITU T.81, B.2.2).

    Raises:
        TutelageError: it is no JPEG.
    """
    at = 2 if content[:2] == b"\xff\xd8" else len(content)
    while at + 9 <= len(content) and content[at] == 0xFF:
        kind, length = content[at + 1], int.from_bytes(content[at + 2 : at + 4], "big")
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):  # a frame header, not a table
            height, width = struct.unpack_from(">HH", content, at + 5)
            if width and height:
                return width, height
            break
        at += 2 + length
    raise TutelageError("a robot sent a picture that is no JPEG")
