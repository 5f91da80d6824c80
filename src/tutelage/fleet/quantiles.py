"""Quantiles of a stream, in little memory (DDSketch; Masson, Rim and Lee, 2019)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class StreamingQuantiles:
    """Counts values >= 0 in bins of equal relative width; every quantile is right to a known relative error.

    Args:
        accuracy: the relative error of a quantile, such as 0.001.
        smallest: values below it count as 0, values above 1 / smallest as 1 / smallest.
    """

    def __init__(self, accuracy: float = 0.001, smallest: float = 1e-12) -> None:
        self.smallest = smallest
        self._log_width = math.log1p(2 * accuracy / (1 - accuracy))
        self._lowest = math.floor(math.log(smallest) / self._log_width)
        highest = math.ceil(-math.log(smallest) / self._log_width)
        self._counts = np.zeros(highest - self._lowest + 2, dtype=np.int64)  # the first bin counts zeros
        self._new: list[Array] = []
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def add(self, values: Array) -> None:
        """Take in values (n,) >= 0."""
        self._new.append(np.array(values, dtype=np.float64))  # counted together: one value takes as long as a thousand
        self._size += len(values)
        if len(self._new) >= 1000:
            self._count()

    @property
    def counts(self) -> Array:
        """How many values fell into each bin."""
        self._count()
        return self._counts

    def _count(self) -> None:
        if not self._new:
            return
        values, self._new = np.concatenate(self._new), []
        bins = np.ceil(np.log(np.clip(values, self.smallest, 1 / self.smallest)) / self._log_width).astype(np.int64)
        np.add.at(self._counts, np.where(values < self.smallest, 0, bins - self._lowest + 1), 1)

    def quantile(self, q: float) -> float:
        """The smallest value seen that at least the fraction q of all values does not exceed.

        Raises:
            ValueError: nothing was added yet.
        """
        if not self._size:
            raise ValueError("a quantile of no values")
        k = int(np.searchsorted(np.cumsum(self.counts), max(1, math.ceil(q * self._size))))
        if k == 0:
            return 0.0
        upper = math.exp((k - 1 + self._lowest) * self._log_width)
        return 2 * upper / (1 + math.exp(self._log_width))  # the point of the bin whose relative error is least

    def state_dict(self) -> dict[str, Any]:
        """The counts: only bins that hold something."""
        counts = self.counts
        (bins,) = np.nonzero(counts)
        return {"bins": bins, "counts": counts[bins]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._counts[:], self._new = 0, []
        self._counts[state["bins"]] = state["counts"]
        self._size = int(self._counts.sum())
