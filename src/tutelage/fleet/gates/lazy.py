"""LazyDAgger (algorithm 1): ask by the classifier, give back by what the human really did."""

from __future__ import annotations

import numpy as np

from tutelage.errors import ConfigError
from tutelage.fleet.gates.base import Array
from tutelage.fleet.gates.safe import SafeDAgger
from tutelage.fleet.view import FleetView


class LazyDAgger(SafeDAgger):
    """Asks like SafeDAgger. Gives back once L(a_R, a_H) < beta_R (lines 12-15), where beta_R < beta_H.

    The noise of line 11 is an `Execution`.
    """

    def cede(self, view: FleetView) -> Array:
        if self.config.ask_again:  # LazyDAgger (-Switch to Auto)
            return super().cede(view)
        if self.config.beta_h is None:
            raise ConfigError("LazyDAgger needs beta_h as a number before it starts; assemble a run, or give it")
        return np.asarray(view.discrepancy < self.config.beta_r * self.config.beta_h)
