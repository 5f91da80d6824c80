"""Pictures of flat scenes from above, many at once: discs and squares on a background, with smooth edges."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Picture = NDArray[np.uint8]


def paint(background: Picture, shapes: Array, discs: NDArray[np.bool_], colours: Picture) -> Picture:
    """Pictures (n, H, W, 3) of n scenes with K shapes each, the later ones on top.

    Args:
        background: (H, W, 3).
        shapes: (n, K, 4) middle (x to the right, y down), half of the side or radius, all in pixels, and angle, rad. Pixel
            (0, 0) has its middle at (0.5, 0.5).
        discs: (K,) which shapes are discs; the others are squares.
        colours: (K, 3).
    """
    pictures = np.empty((len(shapes), *background.shape), dtype=np.uint8)
    _paint(pictures, background, np.ascontiguousarray(shapes, dtype=np.float64), discs, colours)
    return pictures


@numba.njit(nogil=True, cache=True)
def _paint(pictures, background, shapes, discs, colours):  # type: ignore[no-untyped-def]
    height, width = background.shape[0], background.shape[1]
    for i in range(len(shapes)):
        pictures[i] = background
        for k in range(shapes.shape[1]):
            x, y, half, angle = shapes[i, k]
            c, s = np.cos(angle), np.sin(angle)
            reach = half + 1.0 if discs[k] else half * (abs(c) + abs(s)) + 1.0
            for row in range(max(0, int(y - reach)), min(height, int(y + reach) + 1)):
                for column in range(max(0, int(x - reach)), min(width, int(x + reach) + 1)):
                    dx, dy = column + 0.5 - x, row + 0.5 - y
                    far = np.hypot(dx, dy) if discs[k] else max(abs(c * dx + s * dy), abs(c * dy - s * dx))
                    cover = min(max(0.5 + half - far, 0.0), 1.0)  # of the pixel, about
                    if cover > 0.0:
                        for channel in range(3):
                            under = pictures[i, row, column, channel]
                            pictures[i, row, column, channel] = np.uint8(
                                np.rint(under + cover * (np.float64(colours[k, channel]) - under))
                            )
