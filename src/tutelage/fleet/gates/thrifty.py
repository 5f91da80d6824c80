"""ThriftyDAgger (algorithm 3): ask in novel or risky states, as often as a budget allows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tutelage.errors import ConfigError
from tutelage.fleet.gates.base import Array, Gate, GateConfig
from tutelage.fleet.quantiles import StreamingQuantiles
from tutelage.fleet.view import FleetView


class ThriftyDAgger(Gate):
    """Intervene where Novelty > delta_h or Risk > beta_H; Cede where L(a_R, a_H) < delta_r and Risk < beta_R.

    Novelty is the ensemble variance, Risk = 1 - Q_G (eq. 3.5). After each episode (line 23, section 3.4):

        delta_h, beta_H = (1 - alpha_h)-quantiles of novelty and risk,  beta_R = median of risk

    over all states that the robot policy visited by itself, and delta_r = the mean discrepancy where a human acted.
    """

    needs: tuple[str, ...] = ("uncertainty", "goal")

    def __init__(self, config: GateConfig) -> None:
        super().__init__(config)
        if config.without == "risk":
            self.needs = ("uncertainty",)
        start = {
            "delta_h": config.novelty,
            "beta_h": config.risk_ask,
            "beta_r": config.risk_cede,
            "delta_r": config.mean_discrepancy,
        }
        self.thresholds = {name: math.nan if value is None else value for name, value in start.items()}
        self.novelty, self.risk = StreamingQuantiles(), StreamingQuantiles()
        self.taught, self.discrepancy = 0, 0.0

    def __call__(self, view: FleetView) -> Array:
        self._observe(view)
        if any(math.isnan(value) for value in self.thresholds.values()):
            raise ConfigError("ThriftyDAgger needs all four thresholds before it starts; assemble a run, or give them")
        return super().__call__(view)

    def ask(self, view: FleetView) -> Array:
        """Intervene(s, delta_h, beta_H)."""
        novelty, risk = self._novelty(view), self._risk(view)
        intervene = (novelty > self.thresholds["delta_h"]) | (risk > self.thresholds["beta_h"])
        return np.where(intervene, np.maximum(risk, np.finfo(np.float64).tiny), 0.0)

    def cede(self, view: FleetView) -> Array:
        """Cede(s, delta_r, beta_R)."""
        # Without risk, no state is too risky to give back in (0 < 0 would say the opposite).
        calm = self.config.without == "risk" or self._risk(view) < self.thresholds["beta_r"]
        return (view.discrepancy < self.thresholds["delta_r"]) & calm

    def _observe(self, view: FleetView) -> None:
        own = ~view.supervised & ~view.violation
        self.novelty.add(self._novelty(view)[own])
        self.risk.add(self._risk(view)[own])
        taught = view.discrepancy[np.isfinite(view.discrepancy)]
        self.taught += len(taught)
        self.discrepancy += float(taught.sum())
        if view.fresh.any() and len(self.novelty) >= self.config.history:
            q = 1 - self.config.budget(view.t)
            self.thresholds["delta_h"], self.thresholds["beta_h"] = self.novelty.quantile(q), self.risk.quantile(q)
            self.thresholds["beta_r"] = self.risk.quantile(0.5)
            if self.taught:
                self.thresholds["delta_r"] = self.discrepancy / self.taught

    def _novelty(self, view: FleetView) -> Array:
        return np.zeros(view.num_robots) if self.config.without == "novelty" else view.uncertainty

    def _risk(self, view: FleetView) -> Array:
        return np.zeros(view.num_robots) if self.config.without == "risk" else 1.0 - view.goal

    def state_dict(self) -> dict[str, Any]:
        """Thresholds, and the history that they come from."""
        return {
            "thresholds": dict(self.thresholds), "taught": self.taught, "discrepancy": self.discrepancy,
            "novelty": self.novelty.state_dict(), "risk": self.risk.state_dict(),
        }  # fmt: skip

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.thresholds = dict(state["thresholds"])
        self.taught, self.discrepancy = state["taught"], state["discrepancy"]
        self.novelty.load_state_dict(state["novelty"])
        self.risk.load_state_dict(state["risk"])
