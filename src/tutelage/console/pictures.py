"""Pictures as JPEG."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import MissingExtraError

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
