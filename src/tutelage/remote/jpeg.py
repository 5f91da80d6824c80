"""Pictures as JPEG and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import MissingExtraError
from tutelage.remote.messages import MAX_PICTURE, MAX_SIDE, Malformed
from tutelage.remote.wire import jpeg_size

Array = NDArray[Any]


def encode(rgb: Array, quality: int = 80) -> bytes:
    """A picture (height, width, 3) uint8 as JPEG.

    Raises:
        MissingExtraError: OpenCV is not installed.
        ValueError: it is no picture, or more than a message holds.
    """
    cv2 = _cv2()
    if not isinstance(rgb, np.ndarray):
        raise ValueError(f"a picture is (height, width, 3) uint8, not of type {type(rgb).__name__}")
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or not rgb.size or max(rgb.shape) > MAX_SIDE:
        raise ValueError(f"a picture is (height, width, 3) uint8, not {rgb.shape} {rgb.dtype}")
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError("OpenCV could not encode a picture")
    if len(data) > MAX_PICTURE - 64:  # of a message; the rest is for its header
        raise ValueError(
            f"{len(data) / (1 << 20):.1f} MiB are too much for a picture, which has at most {MAX_PICTURE >> 20} MiB: "
            "lower its size or --quality"
        )
    return bytes(data)


def decode(jpeg: bytes) -> Array:
    """A JPEG as (height, width, 3) uint8.

    Raises:
        MissingExtraError: OpenCV is not installed.
        Malformed: it is none, or larger than pictures may be.
    """
    cv2 = _cv2()
    size = jpeg_size(jpeg)  # before anything is set aside for it
    if size is None or not 0 < min(size) <= max(size) <= MAX_SIDE:
        raise Malformed("a picture that is no JPEG")
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None or picture.shape != (size[1], size[0], 3):
        raise Malformed("a picture that is damaged")
    return np.ascontiguousarray(picture[:, :, ::-1])


def available() -> bool:
    """Can pictures be encoded here?"""
    try:
        _cv2()
    except MissingExtraError:
        return False
    return True


def _cv2() -> Any:
    try:
        import cv2
    except ImportError:
        raise MissingExtraError("opencv-python-headless", "remote") from None
    return cv2
