"""How far two actions are apart: the L of equations 2.1 and 3.1."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def discrepancy(a: Array, b: Array, low: Array, high: Array) -> Array:
    """Squared Euclidean distance of actions as a fraction of the largest possible one, ||high - low||^2: 0 to 1.

    Thresholds in these units mean the same for all robots (appendix A.1 states beta_H this way). a, b: (..., A); low, high:
    (A,) the bounds. Returns (...,) float64.
    """
    span = np.square(np.asarray(high, dtype=np.float64) - low).sum()
    return np.asarray(np.square(np.asarray(a, dtype=np.float64) - b).sum(axis=-1) / span)
