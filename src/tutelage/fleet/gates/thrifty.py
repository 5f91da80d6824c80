"""ThriftyDAgger (algorithm 3): ask in novel or risky states, as often as a budget allows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tutelage.errors import ConfigError
from tutelage.fleet.gates.base import Array, Gate, GateConfig
from tutelage.fleet.quantiles import StreamingQuantiles
from tutelage.fleet.view import FleetView

_TINY = float(np.finfo(np.float64).tiny)


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
        if math.isnan(sum(self.thresholds.values())):
            raise ConfigError("ThriftyDAgger needs all four thresholds before it starts; assemble a run, or give them")
        return super().__call__(view)

    def ask(self, view: FleetView) -> Array:
        """Intervene(s, delta_h, beta_H)."""
        without = self.config.without
        if without == "risk":
            return np.where(view.uncertainty > self.thresholds["delta_h"], _TINY, 0.0)
        risk = 1.0 - view.goal
        intervene = risk > self.thresholds["beta_h"]
        if without != "novelty":
            intervene |= view.uncertainty > self.thresholds["delta_h"]
        return np.where(intervene, np.maximum(risk, _TINY), 0.0)

    def cede(self, view: FleetView) -> Array:
        """Cede(s, delta_r, beta_R)."""
        close: Array = view.discrepancy < self.thresholds["delta_r"]
        if self.config.without == "risk":
            return close
        return close & (1.0 - view.goal < self.thresholds["beta_r"])

    def _observe(self, view: FleetView) -> None:
        own = ~(view.supervised | view.violation)
        if self.config.without != "novelty":
            self.novelty.add(view.uncertainty[own])
        if self.config.without != "risk":
            self.risk.add(1.0 - view.goal[own])
        taught = view.discrepancy[np.isfinite(view.discrepancy)]
        if taught.size:
            self.taught += len(taught)
            self.discrepancy += float(taught.sum())
        if view.fresh.any() and max(len(self.novelty), len(self.risk)) >= self.config.history:
            q = 1 - self.config.budget(view.t)
            if len(self.novelty):
                self.thresholds["delta_h"] = self.novelty.quantile(q)
            if len(self.risk):
                self.thresholds["beta_h"], self.thresholds["beta_r"] = self.risk.quantile(q), self.risk.quantile(0.5)
            if self.taught:
                self.thresholds["delta_r"] = self.discrepancy / self.taught

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
