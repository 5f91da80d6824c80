"""HG-DAgger (Kelly et al. 2019): the human watches, and judges when to take over and when to give back."""

from __future__ import annotations

from typing import Any

import numpy as np

from tutelage.errors import ConfigError
from tutelage.fleet.gates.base import Array, Gate, GateConfig
from tutelage.fleet.view import FleetView


class HGDAgger(Gate):
    """A simulated human who watches a few robots at a time and would act as the supervisor does.

    They take over where what the robot is about to do has differed from what they would do by beta_H or more for
    `reaction` timesteps in a row, and give back once it has differed by less than beta_R for as long. They look at `span`
    robots for `dwell` timesteps, then at the next ones: with many robots, nobody sees everything.

    The signal "judgement" is the discrepancy between the robots' actions and the human's, (N,).
    """

    needs = ("judgement",)

    def __init__(self, config: GateConfig) -> None:
        super().__init__(config)
        self.bad: Array | None = None
        self.good: Array | None = None

    def __call__(self, view: FleetView) -> Array:
        if self.config.beta_h is None:
            raise ConfigError("HGDAgger needs beta_h as a number before it starts; assemble a run, or give it")
        if self.bad is None or self.good is None:
            self.bad = self.good = np.zeros(view.num_robots, dtype=np.int64)
        differs = view.signal("judgement")
        sees = self._watched(view) | view.supervised
        going_on = ~view.fresh
        self.bad = (self.bad + 1) * (sees & going_on & (differs >= self.config.beta_h))
        self.good = (self.good + 1) * (view.supervised & going_on & (differs < self.config.beta_r * self.config.beta_h))
        return super().__call__(view)

    def ask(self, view: FleetView) -> Array:
        assert self.bad is not None
        return np.where(self.bad >= self.config.reaction, view.signal("judgement"), 0.0)

    def cede(self, view: FleetView) -> Array:
        assert self.good is not None
        return np.asarray(self.good >= self.config.reaction)

    def _watched(self, view: FleetView) -> Array:
        """The robots that somebody looks at: the next `span` of each human, in turn."""
        n, seen = view.num_robots, min(self.config.span * view.num_humans, view.num_robots)
        if seen == n:
            return np.ones(n, dtype=bool)
        first = view.t // self.config.dwell * seen
        watched = np.zeros(n, dtype=bool)
        watched[(first + np.arange(seen)) % n] = True
        return watched

    def state_dict(self) -> dict[str, Any]:
        """For how long the human has been of which opinion."""
        return {} if self.bad is None or self.good is None else {"bad": self.bad.copy(), "good": self.good.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.bad, self.good = (state[name].copy() if state else None for name in ("bad", "good"))
