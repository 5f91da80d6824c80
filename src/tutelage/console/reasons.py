"""Why robots ask, and who comes first: a priority that also says why."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.console.offers import Offers
from tutelage.fleet.priority import Constraint, Goal, Lexicographic, Priority, Random, Risk, Uncertainty, UncertaintyGoal
from tutelage.fleet.view import FleetView

Array = NDArray[Any]


class Reasons:
    """A priority that also says why: wraps another one.

    Robots whose person went away ask too, after all others, until somebody takes them.

    `order` and `reason` are those of the last timestep: the robots that need somebody, the neediest first, and why.

    Args:
        inner: the priority.
        offers: who waits since when, and whose person went away.
        fifo: who has waited longest is first, whatever the priority says.
    """

    def __init__(self, inner: Priority, offers: Offers, fifo: bool = False) -> None:
        self.inner, self._offers, self._fifo = inner, offers, fifo
        self.order: list[int] = []
        self.reason: list[str] = []

    def __call__(self, view: FleetView) -> Array:
        ranks = self.inner(view)
        asked = np.zeros((len(ranks), 1))
        asked[list(self._offers.left_behind)] = 1.0
        ranks = np.hstack([ranks, asked])  # the least of all reasons
        (asking,) = np.nonzero((ranks > 0).any(axis=1))
        waited = np.array([a.since if (a := self._offers.asking.get(r)) else np.inf for r in asking.tolist()])
        columns = [] if self._fifo else [-ranks[asking, c] for c in reversed(range(ranks.shape[1]))]
        best = asking[np.lexsort([waited, *columns])]
        self.order = best.tolist()
        self.reason = [self._why(view, ranks[robot], robot) for robot in self.order]
        return ranks

    def _why(self, view: FleetView, row: Array, robot: int) -> str:
        if view.violation[robot]:
            return "violated"
        terms = self.inner.terms if isinstance(self.inner, Lexicographic) else []
        column = 0
        for term in terms:
            gate = hasattr(term, "cede")
            if (row[column : column + 1 + gate] > 0).any():
                return _reason_of(term, view, robot)
            column += 1 + gate
        return "asked"

    def state_dict(self) -> dict[str, Any]:
        """That of the priority."""
        return self.inner.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """That of the priority."""
        self.inner.load_state_dict(state)


def _reason_of(term: Any, view: FleetView, robot: int) -> str:
    kinds = {Constraint: "violated", Uncertainty: "uncertain", UncertaintyGoal: "uncertain", Risk: "risky", Goal: "risky"}
    if type(term) in kinds:
        return kinds[type(term)]
    if isinstance(term, Random) or "uncertainty" not in term.needs:
        return "risky" if "predicted_discrepancy" in term.needs else "asked"
    thresholds = getattr(term, "thresholds", None)  # of ThriftyDAgger
    if thresholds is not None and not view.uncertainty[robot] > thresholds["delta_h"]:
        return "risky"
    return "novel" if thresholds is not None else "uncertain"
