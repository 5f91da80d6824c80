"""Any Gymnasium environment as a fleet: say what a violation is and what success is.

fleet = GymnasiumFleet(
    "Hopper-v5",
    num_envs=10,
    violation=lambda outcome: outcome.terminated,  # it fell
    success=lambda outcome: outcome.truncated & (outcome.episode_return > 3000),
)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from tutelage.envs.adapter import AdaptedFleet, Backend, Judge, Outcome
from tutelage.errors import ConfigError
from tutelage.fleet.fleet import Mask

Array = NDArray[Any]

__all__ = ["GymnasiumFleet", "Outcome"]


class GymnasiumFleet(AdaptedFleet):
    """Gymnasium environments as a fleet; see `Fleet` for the contract.

    Single environments are stepped one by one in this thread, and can be paused. A vector environment steps all its
    robots at once: while a violated robot stands still here, its environment goes on unseen until the robot is reset, so
    such a fleet cannot pause. Neither can be checkpointed: Gymnasium gives no access to a simulator's state.

    Args:
        env: the id of a registered environment, a function that makes one, or a `VectorEnv` without autoreset.
        violation: which robots violated their constraint in a timestep, from an `Outcome`: (N,) bool.
        success: which robots completed the task in a timestep, likewise.
        num_envs: N robots; may be left out for a `VectorEnv`.
        horizon: timesteps of an episode; default: the environment's own limit.
        kwargs: passed on to `gymnasium.make` (with an id) or to the function.
    """

    def __init__(
        self,
        env: str | Callable[..., gym.Env[Any, Any]] | VectorEnv[Any, Any, Any],
        *,
        violation: Judge,
        success: Judge,
        num_envs: int | None = None,
        horizon: int | None = None,
        **kwargs: Any,
    ) -> None:
        backend: Backend
        if isinstance(env, VectorEnv):
            if num_envs not in (None, env.num_envs):
                raise ConfigError(f"num_envs is {num_envs}, but the vector environment has {env.num_envs} robots")
            if kwargs:
                raise ConfigError(f"a vector environment is already made; it cannot take {', '.join(kwargs)}")
            backend = _Vector(env, horizon)
        else:
            if num_envs is None or num_envs < 1:
                raise ConfigError(f"a fleet needs at least one robot; got num_envs={num_envs}")
            backend = _Singles(_maker(env, horizon, kwargs), num_envs, horizon)
        super().__init__(backend, violation, success)
        self.render_mode = "rgb_array" if backend.draws else None
        self.spec = backend.spec


def _maker(env: Any, horizon: int | None, kwargs: dict[str, Any]) -> Callable[[], gym.Env[Any, Any]]:
    if isinstance(env, str):
        limit: dict[str, Any] = {} if horizon is None else {"max_episode_steps": horizon}
        return lambda: gym.make(env, **limit, **kwargs)
    if isinstance(env, gym.Env) or not callable(env):
        raise ConfigError(f"give an environment id, a function that makes one, or a VectorEnv; got {env!r}")
    return lambda: env(**kwargs)


def _horizon(asked: int | None, spec: Any) -> int:
    limit = asked if asked is not None else getattr(spec, "max_episode_steps", None)
    if limit is None:
        raise ConfigError("the environment has no limit on the length of an episode; say horizon=... timesteps")
    return int(limit)


class _Singles(Backend):
    """N environments, each of its own; one is stepped by stepping it."""

    _add_info: Any = VectorEnv._add_info  # Gymnasium's one way of batching the infos of single environments

    def __init__(self, make: Callable[[], gym.Env[Any, Any]], num_envs: int, horizon: int | None) -> None:
        self.num_envs = num_envs
        try:
            self._envs = [make() for _ in range(num_envs)]
        except gym.error.Error as error:
            raise ConfigError(f"cannot make the environment: {str(error).splitlines()[0]}") from error
        first = self._envs[0]
        if not isinstance(first, gym.Env):
            raise ConfigError(f"the function must make a gymnasium.Env, got {type(first).__name__}")
        self.obs_space, self.action_space, self.spec = first.observation_space, first.action_space, first.spec
        self.horizon = _horizon(horizon, first.spec)
        self.draws = first.render_mode == "rgb_array"
        self._step: tuple[Array, Mask] | None = None

    def reset(self, robots: Mask, seed: int | None) -> Array:
        obs = np.zeros((self.num_envs, *_shape(self.obs_space)), dtype=self.obs_space.dtype)
        for i in np.flatnonzero(robots):
            obs[i], _ = self._envs[i].reset(seed=None if seed is None else seed + int(i))
        return obs

    def start(self, actions: Array, robots: Mask) -> None:
        self._step = actions.astype(self.action_space.dtype), robots

    def finish(self) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        assert self._step is not None
        actions, robots = self._step
        obs = np.zeros((self.num_envs, *_shape(self.obs_space)), dtype=self.obs_space.dtype)
        reward = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, dtype=bool), np.zeros(self.num_envs, dtype=bool)
        info: dict[str, Any] = {}
        for i in np.flatnonzero(robots):
            obs[i], reward[i], terminated[i], truncated[i], own = self._envs[i].step(actions[i])
            info = self._add_info(info, own, int(i))
        return obs, reward, terminated, truncated, info

    def picture(self, robot: int) -> Array | None:
        return np.asarray(self._envs[robot].render()) if self.draws else None

    def close(self) -> None:
        for env in self._envs:
            env.close()


class _Vector(Backend):
    """A vector environment, which can only step all its robots: those that should stand still go on as unseen ghosts."""

    can_pause = False

    def __init__(self, env: VectorEnv[Any, Any, Any], horizon: int | None) -> None:
        if env.metadata.get("autoreset_mode") is not AutoresetMode.DISABLED:
            raise ConfigError(
                "this vector environment resets robots by itself; make it with autoreset_mode=AutoresetMode.DISABLED "
                "(gymnasium.make_vec takes vector_kwargs={'autoreset_mode': AutoresetMode.DISABLED})"
            )
        self._env, self.num_envs = env, env.num_envs
        self.obs_space, self.action_space = env.single_observation_space, env.single_action_space
        inner = env.unwrapped
        self.spec = env.spec
        if isinstance(inner, SyncVectorEnv | AsyncVectorEnv):  # make_vec changes the limit of its parts only
            self.spec = inner.get_attr("spec")[0]
        self.horizon = _horizon(horizon, self.spec)
        self.draws = env.render_mode == "rgb_array"
        self._async = isinstance(env, AsyncVectorEnv)
        self._ended = np.zeros(self.num_envs, dtype=bool)
        self._last: Array = np.zeros(0)
        self._actions: Array = np.zeros(0)

    def reset(self, robots: Mask, seed: int | None) -> Array:
        if robots.all():
            obs, _ = self._env.reset(seed=seed)
            self._last = np.array(obs)
        else:
            self._reset_some(robots, seed)
        self._ended = self._ended & ~robots
        return self._last

    def _reset_some(self, robots: Mask, seed: int | None) -> None:
        obs, _ = self._env.reset(seed=seed, options={"reset_mask": robots.copy()})
        if not np.array_equal(obs[~robots], self._last[~robots], equal_nan=self._last.dtype.kind == "f"):
            raise ConfigError(f"{type(self._env).__name__} ignores reset_mask: it reset robots that were not in the mask")
        self._last = np.array(obs)

    def start(self, actions: Array, robots: Mask) -> None:
        if self._ended.any():  # ghosts whose episode is over must not be stepped (Gymnasium asserts it)
            self._reset_some(self._ended, None)
            self._ended = np.zeros(self.num_envs, dtype=bool)
        assert isinstance(self.action_space, gym.spaces.Box)
        idle = (self.action_space.low + self.action_space.high) / 2
        self._actions = np.where(robots[:, None], actions, idle).astype(self.action_space.dtype)
        if self._async:
            self._env.step_async(self._actions)  # type: ignore[attr-defined]

    def finish(self) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        result = self._env.step_wait() if self._async else self._env.step(self._actions)  # type: ignore[attr-defined]
        obs, reward, terminated, truncated, info = result
        self._last, self._ended = np.array(obs), terminated | truncated
        return self._last, reward, terminated, truncated, info

    def picture(self, robot: int) -> Array | None:
        pictures = self._env.render() if self.draws else None
        return None if pictures is None else np.asarray(pictures[robot])

    def close(self) -> None:
        self._env.close()


def _shape(space: gym.Space[Any]) -> tuple[int, ...]:
    return space.shape or ()
