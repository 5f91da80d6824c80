"""DAgger (Ross, Gordon and Bagnell 2011): a human says what would have been right in every state."""

from __future__ import annotations

import numpy as np

from tutelage.fleet.gates.base import Array, Gate
from tutelage.fleet.view import FleetView


class DAgger(Gate):
    """Asks always: with fewer humans than robots, chance decides. What is executed meanwhile is up to `BetaMixture`."""

    def ask(self, view: FleetView) -> Array:
        return np.ones(view.num_robots)

    def cede(self, view: FleetView) -> Array:
        return np.zeros(view.num_robots, dtype=bool)
