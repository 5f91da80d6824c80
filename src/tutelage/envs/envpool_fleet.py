"""EnvPool's tasks as a fleet: C++ physics, stepped in a thread pool, for the robots that move and no others."""

from __future__ import annotations

import difflib
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tutelage.envs.adapter import AdaptedFleet, Backend, Judge, Outcome
from tutelage.errors import ConfigError, MissingExtraError
from tutelage.fleet.fleet import Mask
from tutelage.seeding import derive

try:
    import envpool
except ImportError as error:
    raise MissingExtraError("envpool", "envpool") from error

Array = NDArray[Any]

__all__ = ["EnvPoolFleet", "Outcome"]


class EnvPoolFleet(AdaptedFleet):
    """An EnvPool task as a fleet; see `Fleet` for the contract. It cannot be checkpointed.

    EnvPool takes its seed when a pool is made, so a seeded reset makes a new pool. The same seed then gives the same run.

    Args:
        task_id: an EnvPool id such as "Walker2d-v4" (`envpool.list_all_envs()` names all).
        num_envs: N robots.
        violation: which robots violated their constraint in a timestep, from an `Outcome`: (N,) bool.
        success: which robots completed the task in a timestep, likewise.
        observe: the entry that robots see, of tasks that observe a dictionary of arrays.
        horizon: timesteps of an episode; default: the task's own.
        threads: physics threads; default: EnvPool's choice.
        kwargs: the task's own settings.

    `settings` are all of the task's own, those that were not given too.
    """

    def __init__(
        self,
        task_id: str,
        num_envs: int,
        *,
        violation: Judge,
        success: Judge,
        observe: str | None = None,
        horizon: int | None = None,
        threads: int | None = None,
        **kwargs: Any,
    ) -> None:
        known = envpool.list_all_envs()
        if task_id not in known:
            close = difflib.get_close_matches(task_id, known)
            hint = f"did you mean {' or '.join(close)}?" if close else "see envpool.list_all_envs()"
            raise ConfigError(f"EnvPool has no task {task_id!r}; {hint}")
        if num_envs < 1:
            raise ConfigError(f"a fleet needs at least one robot, got {num_envs}")
        if horizon is not None:
            kwargs["max_episode_steps"] = horizon
        pool = _Pool(task_id, num_envs, observe, threads, kwargs)
        super().__init__(pool, violation, success)
        self.settings = pool.settings


class _Pool(Backend):
    """One pool in its synchronous mode, where any subset of robots may be sent and exactly that subset comes back."""

    def __init__(
        self, task_id: str, num_envs: int, observe: str | None, threads: int | None, kwargs: dict[str, Any]
    ) -> None:
        self._task, self.num_envs, self._observe = task_id, num_envs, observe
        self._settings = {**kwargs, **({} if threads is None else {"num_threads": threads})}
        spec = envpool.make_spec(task_id, num_envs=num_envs, **self._settings)
        seen, self.action_space = spec.gymnasium_observation_space, spec.gymnasium_action_space
        parts = seen.spaces if isinstance(seen, gym.spaces.Dict) else {}
        if (observe is None or observe not in parts) if parts else (observe is not None):
            which = f"observe one of {', '.join(parts)}" if parts else "it observes one array, so leave `observe` out"
            raise ConfigError(f"EnvPool's {task_id} has no observation {observe!r}: {which}")
        self.obs_space = parts[observe] if observe is not None else seen
        self.settings: dict[str, Any] = spec.config._asdict()
        self.horizon = int(spec.config.max_episode_steps)
        self._pool: Any = None

    def reset(self, robots: Mask, seed: int | None) -> Array:
        if self._pool is None or seed is not None:
            if not robots.all():
                raise ConfigError("EnvPool can be seeded for all robots only; reset without a mask, or without a seed")
            self.close()
            fresh = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
            self._pool = envpool.make(
                self._task,
                env_type="gymnasium",
                num_envs=self.num_envs,
                seed=derive(fresh, "envpool") % 2**30,
                **self._settings,
            )
        obs, info = self._pool.reset(np.flatnonzero(robots).astype(np.int32))
        return self._scatter(self._part(obs), info)

    def start(self, actions: Array, robots: Mask) -> None:
        moving = np.flatnonzero(robots).astype(np.int32)
        self._pool.send(actions[moving].astype(self.action_space.dtype), moving)

    def finish(self) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self._pool.recv()
        batched = {k: self._scatter(v, info) for k, v in info.items() if isinstance(v, np.ndarray) and k != "env_id"}
        rows = (self._scatter(x, info) for x in (self._part(obs), reward, terminated, truncated))
        return (*rows, batched)  # type: ignore[return-value]

    def _part(self, obs: Any) -> Array:
        """What robots see of what EnvPool observes."""
        return obs if self._observe is None else obs[self._observe]  # type: ignore[no-any-return]

    def _scatter(self, rows: Array, info: dict[str, Any]) -> Array:
        """Rows of the robots that answered, in whatever order, as rows of all robots."""
        scattered = np.zeros((self.num_envs, *rows.shape[1:]), dtype=rows.dtype)
        scattered[info["env_id"]] = rows
        return scattered

    def close(self) -> None:
        if self._pool is not None:
            self._pool.close()
            self._pool = None
