"""The few fakes of the tests: a fleet of points, and a policy, priority, supervisor and learner that do as they are told.

All of them note what they are asked in a shared `log`, so that a test can read in which order things happened.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space

from tutelage.fleet.fleet import Fleet
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step
from tutelage.fleet.supervisor import Supervisor, Team
from tutelage.fleet.view import FleetView
from tutelage.seeding import rng_state, set_rng_state

POSITION, ELAPSED, EPISODE, ROBOT = range(4)
"""Columns of an observation of `PointFleet`."""
SPEED = 0.1
Script = Mapping[int, Sequence[int]]


class PointFleet(Fleet):
    """Points on a line. obs (N, 4): position, timesteps in the episode, number of the episode, own index.

    Each step, position += SPEED * action + drift + noise. It violates beyond `bound` and succeeds beyond `goal`.

    Args:
        num_envs: N.
        bound, goal, horizon, drift, noise, start: as above; start: half-width of the initial positions.
        falls, successes: robots that violate / succeed in the step of that number, whatever their position.
        away: robots that cannot be reached after the step of that number.
        can_pause: whether `active` is obeyed.
        log: where to note calls.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        bound: float = np.inf,
        goal: float = np.inf,
        horizon: int = 10**6,
        drift: float = 0.0,
        noise: float = 0.0,
        start: float = 0.0,
        falls: Script | None = None,
        successes: Script | None = None,
        away: Script | None = None,
        can_pause: bool = True,
        log: list[Any] | None = None,
    ) -> None:
        self.num_envs, self.bound, self.goal, self.horizon = num_envs, bound, goal, horizon
        self.drift, self.noise, self.start = drift, noise, start
        self.falls, self.successes = dict(falls or {}), dict(successes or {})
        self.away = dict(away or {})
        self.can_pause, self.log = can_pause, [] if log is None else log
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), dtype=np.float64)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.rng = np.random.Generator(np.random.PCG64(0))
        self.t = 0
        self.obs = np.zeros((num_envs, 4))
        self.obs[:, EPISODE], self.obs[:, ROBOT] = -1, np.arange(num_envs)
        self.violation = np.zeros(num_envs, dtype=bool)
        self.moved: list[Any] = []
        """Which robots moved in each step."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        mask = options["reset_mask"] if options else np.ones(self.num_envs, dtype=bool)
        self.log.append("reset")
        if seed is not None:
            self.rng = np.random.Generator(np.random.PCG64(seed))
        self.obs = self.obs.copy()
        self.obs[mask, POSITION] = self.start * self.rng.uniform(-1, 1, int(mask.sum()))
        self.obs[mask, ELAPSED] = 0
        self.obs[mask, EPISODE] += 1
        self.violation = self.violation & ~mask
        return self.obs, {"violation": self.violation.copy(), "success": np.zeros(self.num_envs, dtype=bool)}

    def step_async(self, actions: Any, active: Any = None) -> None:
        self.log.append("step_async")
        assert actions.shape == (self.num_envs, 1)
        moving = ~self.violation if active is None or not self.can_pause else ~self.violation & active
        self._pending = actions, moving

    def step_wait(self) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.log.append("step_wait")
        actions, moving = self._pending
        self.moved.append(moving)
        self.obs = self.obs.copy()
        shift = SPEED * actions[:, 0] + self.drift + self.noise * self.rng.standard_normal(self.num_envs)
        self.obs[:, POSITION] += np.where(moving, shift, 0.0)
        self.obs[:, ELAPSED] += moving
        at = self.obs[:, POSITION]
        self.violation = self.violation | (moving & ((np.abs(at) > self.bound) | self._scripted(self.falls)))
        success = moving & (((at > self.goal) & ~self.violation) | self._scripted(self.successes))
        truncated = moving & (self.obs[:, ELAPSED] >= self.horizon) & ~self.violation
        info = {"violation": self.violation.copy(), "success": success}
        if self.away:
            info["online"] = ~self._scripted(self.away)
        self.t += 1
        return self.obs, np.where(moving, 1.0, 0.0), self.violation.copy(), truncated, info

    def _scripted(self, script: dict[int, Sequence[int]]) -> Any:
        return np.isin(np.arange(self.num_envs), script.get(self.t, []))

    def state_dict(self) -> dict[str, Any]:
        return {"t": self.t, "obs": self.obs.copy(), "violation": self.violation.copy(), "rng": rng_state(self.rng)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.t, self.obs, self.violation = state["t"], state["obs"].copy(), state["violation"].copy()
        set_rng_state(self.rng, state["rng"])


class FakePolicy:
    """Always the same action; uncertainty as given, constant or a function of the observations."""

    def __init__(self, action: float = 0.0, uncertainty: Any = 0.0, log: list[Any] | None = None) -> None:
        self.action, self.spread, self.log = action, uncertainty, [] if log is None else log

    def act(self, obs: Any) -> Any:
        self.log.append("policy.act")
        return np.full((len(obs), 1), self.action, dtype=np.float32)

    def uncertainty(self, obs: Any) -> Any:
        self.log.append("policy.uncertainty")
        return self.spread(obs) if callable(self.spread) else np.full(len(obs), self.spread)


class FakeSupervisor:
    """Always the same action; keeps (timestep of the call, obs, robots) of each call in `seen`."""

    def __init__(self, action: float = 0.5, log: list[Any] | None = None) -> None:
        self.action, self.log = action, [] if log is None else log
        self.seen: list[tuple[Any, Any]] = []

    def act(self, obs: Any, robots: Any) -> Any:
        self.log.append("supervisor.act")
        self.seen.append((np.array(obs), np.array(robots)))
        return np.full((len(obs), 1), self.action, dtype=np.float32)


class FakePriority:
    """Whatever `rank` says: a function of the view, giving (N,) or (N, K)."""

    def __init__(self, rank: Callable[[FleetView], Any], log: list[Any] | None = None) -> None:
        self.rank, self.log = rank, [] if log is None else log

    def __call__(self, view: FleetView) -> Any:
        self.log.append("priority")
        ranks = np.asarray(self.rank(view), dtype=np.float64)
        return ranks if ranks.ndim == 2 else ranks[:, None]

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


class FakeLearner:
    """Keeps the steps; notes at each update how many of them it has."""

    def __init__(self, log: list[Any] | None = None) -> None:
        self.log, self.steps = [] if log is None else log, []
        self.known: list[int] = []

    def record(self, step: Step) -> None:
        self.log.append("record")
        self.steps.append(step)

    def update(self, t: int) -> dict[str, float]:
        self.log.append("update")
        self.known.append(len(self.steps))
        return {"policy": float(t)}

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


def wants(ranks: Any) -> FakePriority:
    """The same priorities at every timestep."""
    return FakePriority(lambda view: np.asarray(ranks))


def violated_first(view: FleetView) -> Any:
    """Every robot wants a human, violated ones most."""
    return 1.0 + view.violation


def make_loop(
    fleet: PointFleet, priority: Any, humans: int = 1, *, latency: Any = 0, supervisor: Supervisor | None = None, **rest: Any
) -> Loop:
    """A loop with `humans` alike supervisors, and a policy that stands still unless another one is given."""
    team = Team([supervisor or FakeSupervisor()] * humans, latency)
    return Loop(fleet, rest.pop("policy", FakePolicy()), priority, team, **rest)


def make_view(
    t: int = 0, *, violation: Sequence[bool] = (False,) * 4, supervised: Any = None, fresh: Any = None,
    discrepancy: Any = None, humans: int = 1, seed: int = 0, **signals: Any,
) -> FleetView:  # fmt: skip
    """Four robots (or as many as `violation` has) with the given signals."""
    n = len(violation)
    helped, new = (np.zeros(n, dtype=bool) if mask is None else np.array(mask) for mask in (supervised, fresh))
    differs = np.full(n, np.nan) if discrepancy is None else np.array(discrepancy, dtype=float)
    return FleetView(
        t, np.zeros((n, 2)), np.zeros((n, 1)), np.array(violation), helped, np.zeros(n, dtype=int),
        np.full((n, 1), np.nan), differs, new, humans, np.random.default_rng(seed),
        {name: (lambda view, value=value: np.array(value)) for name, value in signals.items()},
    )  # fmt: skip


class Good(PointFleet):
    """A seed restarts everything; falls, arrivals and the horizon occur under random actions."""

    def __init__(self, num_envs: int = 4) -> None:
        super().__init__(num_envs, bound=0.3, goal=0.25, horizon=15, noise=0.05, start=0.1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None:
            self.t, self.obs = 0, self.obs.copy()
            self.obs[:, EPISODE] = -1
        return super().reset(seed=seed, options=options)


def right(obs: Any) -> Any:
    """Commands (N, 1) of the observations (N, 4), as they should be."""
    return np.tanh(obs[:, :1]).astype(np.float32)


def scribble(obs: Any) -> Any:
    """The same, but it spoils the observations."""
    obs += 1.0
    return right(obs)


def count(calls: list[int]) -> Any:
    """Another number at every call."""
    calls.append(1)
    return len(calls) * 0.1
