"""SafeDAgger (Zhang and Cho 2017; section 2.4)."""

from __future__ import annotations

import numpy as np

from tutelage.fleet.gates.base import Array, Gate
from tutelage.fleet.view import FleetView


class SafeDAgger(Gate):
    """Eq. 2.5: pi_H where f(s) >= 0.5, else pi_R. One rule to ask and to give back: no hysteresis."""

    needs = ("predicted_discrepancy",)

    def ask(self, view: FleetView) -> Array:
        f = view.signal("predicted_discrepancy")
        return np.where(f >= 0.5, f, 0.0)

    def cede(self, view: FleetView) -> Array:
        return np.asarray(view.signal("predicted_discrepancy") < 0.5)
