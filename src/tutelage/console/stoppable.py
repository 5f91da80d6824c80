"""A fleet with an emergency stop: one flag a robot that anybody may set at any time, and that no step gets past."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.fleet.fleet import Fleet, Mask

Array = NDArray[Any]


class StoppableFleet(Fleet):
    """Another fleet, whose robots can be stopped at once, from any thread.

    A stopped robot does not move in any step that begins after `stop` returned (a simulated step that is going on ends; a
    real robot is told at once), and is not online until `clear`: the loop takes its human away.

    Args:
        inner: the other fleet.
        paces: whether its steps take as long as a timestep by themselves, as those of real robots do.
    """

    def __init__(self, inner: Fleet, paces: bool = False) -> None:
        self.inner, self.paces = inner, paces
        self.num_envs, self.metadata, self.render_mode = inner.num_envs, inner.metadata, inner.render_mode
        self.single_action_space, self.single_observation_space = inner.single_action_space, inner.single_observation_space
        self.action_space, self.observation_space = inner.action_space, inner.observation_space
        self.horizon, self.goal_conditioned = inner.horizon, inner.goal_conditioned
        self.can_pause, self.can_checkpoint = inner.can_pause, inner.can_checkpoint
        self.stopped = np.zeros(inner.num_envs, dtype=bool)
        self._said = np.zeros(inner.num_envs, dtype=bool)

    def stop(self, robots: Collection[int]) -> None:
        """Stop robots (indices)."""
        self.stopped[list(robots)] = True
        if hasattr(self.inner, "stop"):
            for robot in robots:
                self.inner.stop(robot)

    def clear(self, robots: Collection[int]) -> None:
        """Let them go on."""
        if hasattr(self.inner, "clear"):
            for robot in robots:
                self.inner.clear(robot)
        self.stopped[list(robots)] = False

    @property
    def latched(self) -> Array:
        """(N,) bool, robots that are stopped, or say so themselves, whoever told them."""
        return np.asarray(self.stopped | self._said)

    @property
    def state(self) -> Array | None:
        return self.inner.state

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Reset robots; a stopped one too, which does not go on thereafter."""
        obs, info = self.inner.reset(seed=seed, options=options)
        return obs, self._told(info)

    def step_async(self, actions: Array, active: Mask | None = None) -> None:
        free = ~self.stopped
        self.inner.step_async(actions, free if active is None else active & free)

    def step_wait(self) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.inner.step_wait()
        return obs, reward, terminated, truncated, self._told(info)

    def _told(self, info: dict[str, Any]) -> dict[str, Any]:
        self._said = info.get("stopped", self._said)
        return {**info, "online": info.get("online", np.ones(self.num_envs, dtype=bool)) & ~self.stopped}

    def state_dict(self) -> dict[str, Any]:
        return {**self.inner.state_dict(), "stopped": self.stopped.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        inner = dict(state)
        self.stopped[:] = inner.pop("stopped")
        self.inner.load_state_dict(inner)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the other fleet."""
        self.inner.close()
