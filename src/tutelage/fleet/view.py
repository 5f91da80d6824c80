"""What a priority function may look at."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError, ContractError

Array = NDArray[Any]
Signal = Callable[["FleetView"], Array]


@dataclass
class FleetView:
    """The fleet at one timestep, before allocation.

    Attributes:
        t: timestep.
        obs: (N, ...) observations.
        actions: (N, A) what the policy proposes.
        violation: (N,) bool, c(s).
        supervised: (N,) bool, whether a human is with the robot.
        duration: (N,) timesteps that each robot has been in its present mode.
        human_action: (N, A) the last action a human wanted of the robot (NaN before the first).
        discrepancy: (N,) how far that was from what the policy proposed; see `discrepancy`. NaN for robots that no human
            acted for in the last timestep.
        fresh: (N,) bool, whether the robot's episode begins now.
        num_humans: M.
        rng: the seeded stream of the priority, for random terms and tie-breaks.
        signals: how to compute each signal, by name, for all robots in one batch.
    """

    t: int
    obs: Array
    actions: Array
    violation: Array
    supervised: Array
    duration: Array
    human_action: Array
    discrepancy: Array
    fresh: Array
    num_humans: int
    rng: np.random.Generator
    signals: Mapping[str, Signal]
    computed: dict[str, Array] = field(default_factory=dict)

    @property
    def num_robots(self) -> int:
        """N."""
        return len(self.violation)

    def signal(self, name: str) -> Array:
        """The signal `name` of all robots, (N,) float64, computed on first use.

        Raises:
            ConfigError: nothing in this run computes that signal.
            ContractError: the signal has the wrong shape or is not finite.
        """
        if name not in self.computed:
            if name not in self.signals:
                known = ", ".join(sorted(self.signals)) or "none"
                raise ConfigError(
                    f"this run has no signal {name!r} (it has: {known}); choose a priority without it, or name it in the "
                    "`needs` of yours"
                )
            value = np.asarray(self.signals[name](self), dtype=np.float64)
            if value.shape != (self.num_robots,):
                raise ContractError(f"signal {name!r} must have shape ({self.num_robots},), got {value.shape}")
            if not np.isfinite(value).all():
                raise ContractError(f"signal {name!r} is not finite for robot {int(np.argmin(np.isfinite(value)))}")
            self.computed[name] = value
        return self.computed[name]

    @property
    def uncertainty(self) -> Array:
        """How unsure the policy is about each robot's action, (N,)."""
        return self.signal("uncertainty")

    @property
    def risk(self) -> Array:
        """Estimated discounted probability of a constraint violation, (N,)."""
        return self.signal("risk")

    @property
    def goal(self) -> Array:
        """Estimated discounted probability of reaching the goal, (N,)."""
        return self.signal("goal")
