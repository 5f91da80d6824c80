"""What a robot executes while a human is in control.

Usually what the human wants. LazyDAgger adds noise, so that the human is seen correcting more states; DAgger lets the robot
act and the human only say what would have been right. Whatever is executed, the human's own action is what is learned.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError
from tutelage.seeding import rng_state, set_rng_state

Array = NDArray[Any]


class Execution(Protocol):
    """From what the humans want to what the robots do."""

    def __call__(self, t: int, wanted: Array, proposed: Array) -> Array:
        """Executed actions (n, A) of n teleoperated robots. wanted: the humans', proposed: the policy's, both (n, A)."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """What it remembers between timesteps."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        ...


class AsWanted:
    """What the human wants."""

    def __call__(self, t: int, wanted: Array, proposed: Array) -> Array:
        return wanted

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""


class NoiseInjection:
    """Line 11 of algorithm 1: a ~ N(a_H, sigma^2 I).

    Args:
        variance: sigma^2, in units of half the action range (the actions of MuJoCo tasks reach from -1 to 1).
        low, high: (A,) bounds of the actions.
        rng: the seeded stream of the noise.
    """

    def __init__(self, variance: float, low: Array, high: Array, rng: np.random.Generator) -> None:
        if not 0 <= variance < np.inf:
            raise ConfigError(f"the variance of injected noise must be a number >= 0, got {variance}")
        self.sigma, self.rng = np.sqrt(variance) * (np.asarray(high, dtype=np.float64) - low) / 2, rng

    def __call__(self, t: int, wanted: Array, proposed: Array) -> Array:
        return np.asarray(wanted + self.sigma * self.rng.standard_normal(wanted.shape))

    def state_dict(self) -> dict[str, Any]:
        """The state of the noise."""
        return {"rng": rng_state(self.rng)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        set_rng_state(self.rng, state["rng"])


class BetaMixture:
    """DAgger (Ross et al. 2011): pi_i = beta_i pi_H + (1 - beta_i) pi_R, with beta_i = beta^i in epoch i = 1, 2, ...

    In each timestep, each robot executes the human's action with probability beta_i and its own otherwise. Epoch 0, in which
    the human alone acts, is the offline data.

    Args:
        beta: beta, in [0, 1]; 0: the robot always acts.
        every: timesteps of an epoch.
        rng: the seeded stream of the choices.
    """

    def __init__(self, beta: float, every: int, rng: np.random.Generator) -> None:
        if not 0 <= beta <= 1 or every < 1:
            raise ConfigError(f"DAgger needs beta in [0, 1] and epochs of at least 1 timestep, got {beta} and {every}")
        self.beta, self.every, self.rng = beta, every, rng

    def __call__(self, t: int, wanted: Array, proposed: Array) -> Array:
        human = self.rng.random(len(wanted)) < self.beta ** (1 + t // self.every)
        return np.where(human[:, None], wanted, proposed)

    def state_dict(self) -> dict[str, Any]:
        """The state of the choices."""
        return {"rng": rng_state(self.rng)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        set_rng_state(self.rng, state["rng"])
