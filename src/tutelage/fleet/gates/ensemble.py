"""EnsembleDAgger (Menda, Driggs-Campbell and Kochenderfer 2019): doubt and discrepancy."""

from __future__ import annotations

import numpy as np

from tutelage.errors import ConfigError
from tutelage.fleet.gates.base import Array, Gate
from tutelage.fleet.view import FleetView


class EnsembleDAgger(Gate):
    """The robot acts where its doubt (ensemble variance) is at most chi and the discrepancy is below tau = beta_H.

    The original knows the true discrepancy everywhere, because its human labels every timestep. Here, a robot without a
    human uses the predicted one, as SafeDAgger does; a robot with a human the true one.
    """

    needs = ("uncertainty", "predicted_discrepancy")

    def ask(self, view: FleetView) -> Array:
        doubt, unsafe = view.uncertainty, view.signal("predicted_discrepancy") >= 0.5
        return np.where((doubt > self._chi) | unsafe, np.maximum(doubt, np.finfo(np.float64).tiny), 0.0)

    def cede(self, view: FleetView) -> Array:
        if self.config.beta_h is None:
            raise ConfigError("EnsembleDAgger needs beta_h as a number before it starts; assemble a run, or give it")
        return (view.uncertainty <= self._chi) & (view.discrepancy < self.config.beta_h)

    @property
    def _chi(self) -> float:
        if self.config.doubt is None:
            raise ConfigError("EnsembleDAgger needs doubt (chi) as a number before it starts; assemble a run, or give it")
        return self.config.doubt
