"""Human supervisors pi_H: who acts when a robot is helped. Here the algorithmic ones; a person is another `Supervisor`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.fleet import Fleet
from tutelage.fleet.policy import Policy
from tutelage.seeding import rng_state, set_rng_state

Array = NDArray[Any]


@runtime_checkable
class Supervisor(Protocol):
    """One human, or several who act alike."""

    def act(self, obs: Array, robots: Array) -> Array:
        """The human's actions for the robots (indices, (n,)) that show obs (n, ...): (n, A)."""
        ...


class PolicySupervisor:
    """An algorithmic human: acts as a fully trained policy (section 5.6).

    Args:
        policy: how they act.
        fleet: whose robots they help. Where these observe images, the human acts on the state of the fleet, in which a
            program finds what a person sees in a picture.
    """

    def __init__(self, policy: Policy, fleet: Fleet | None = None) -> None:
        self.policy, self.fleet = policy, fleet

    def act(self, obs: Array, robots: Array | None = None) -> Array:
        """The human's actions for the robots that show obs (n, ...): indices (n,), by default the whole fleet. (n, A)."""
        state = None if self.fleet is None else self.fleet.state
        if state is not None:
            obs = state if robots is None else state[robots]
        return self.policy.act(obs)


class NoisySupervisor:
    """A human with a trembling hand: Gaussian noise on another supervisor's actions.

    Args:
        inner: the supervisor whose actions are disturbed.
        sigma: standard deviation, in units of the action.
        rng: the seeded stream of this human.
    """

    def __init__(self, inner: Supervisor, sigma: float, rng: np.random.Generator) -> None:
        if not sigma >= 0:
            raise ConfigError(f"a supervisor's noise must be >= 0, got {sigma}")
        self.inner, self.sigma, self.rng = inner, sigma, rng

    def act(self, obs: Array, robots: Array) -> Array:
        actions = self.inner.act(obs, robots)
        return actions + self.sigma * self.rng.standard_normal(actions.shape).astype(actions.dtype)

    def state_dict(self) -> dict[str, Any]:
        """The state of the noise, and of the inner supervisor where it has one."""
        inner = {"inner": self.inner.state_dict()} if hasattr(self.inner, "state_dict") else {}
        return {"rng": rng_state(self.rng), **inner}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        set_rng_state(self.rng, state["rng"])
        if "inner" in state:
            self.inner.load_state_dict(state["inner"])  # type: ignore[attr-defined]


class Team:
    """The M humans of a fleet.

    Args:
        supervisors: one for each human; the same object may appear many times (humans who act alike cost one batch).
        latency: L, timesteps between an assignment and its beginning (eq. 2.2); one number, or one for each human.
    """

    def __init__(self, supervisors: Sequence[Supervisor], latency: int | Sequence[int] = 0) -> None:
        if not supervisors:
            raise ConfigError("a team needs at least one human")
        self.latency = np.broadcast_to(np.asarray(latency, dtype=np.int64), len(supervisors)).copy()
        if (self.latency < 0).any():
            raise ConfigError(f"switching latency must be >= 0 timesteps, got {latency}")
        self.distinct: list[Supervisor] = []
        for supervisor in supervisors:
            if not any(supervisor is known for known in self.distinct):
                self.distinct.append(supervisor)
        self._kind = np.array([next(k for k, d in enumerate(self.distinct) if d is s) for s in supervisors])

    def __len__(self) -> int:
        return len(self._kind)

    def act(self, obs: Array, robots: Array, humans: Array, width: int) -> Array:
        """Actions (n, width) of the humans (n,) who teleoperate the robots (n,) that show obs (n, ...).

        Raises:
            ContractError: a supervisor returned the wrong shape, or numbers that are not finite.
        """
        actions = np.empty((len(robots), width), dtype=np.float32)
        kind = self._kind[humans]
        for k, supervisor in enumerate(self.distinct):
            mine = kind == k
            if mine.any():
                result = np.asarray(supervisor.act(obs[mine], robots[mine]))
                name = type(supervisor).__name__
                if result.shape != (int(mine.sum()), width):
                    raise ContractError(f"{name}.act must return {(int(mine.sum()), width)}, got {result.shape}")
                if not np.isfinite(result).all():
                    raise ContractError(f"{name}.act returned a number that is not finite")
                actions[mine] = result
        return actions

    def state_dict(self) -> dict[str, Any]:
        """The state of the humans that have one."""
        return {str(k): s.state_dict() for k, s in enumerate(self.distinct) if hasattr(s, "state_dict")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        for k, inner in state.items():
            self.distinct[int(k)].load_state_dict(inner)  # type: ignore[attr-defined]
