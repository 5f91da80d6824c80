"""Simulated robots as drivers: any Gymnasium environment, and a fleet of one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError
from tutelage.fleet.fleet import Fleet

Array = NDArray[Any]
Grab = Callable[[], Array]
"""Takes a picture: (height, width, 3) uint8, RGB."""


class GymnasiumDriver:
    """Any Gymnasium environment as a robot. An action is a step of it; while it holds, its time stands still.

    Args:
        env: the environment, or the id of a registered one.
        violation: whether a step violated the constraint: (obs, reward, terminated, info) -> bool. Default: the environment
            ended the episode without success.
        success: whether a step completed the task, likewise. Default: `info["success"]` or `info["is_success"]`.
        horizon: timesteps of an episode; default: the environment's own limit, or 1000.
        kwargs: for `gymnasium.make`, with an id.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any] | str,
        *,
        violation: Callable[[Array, float, bool, dict[str, Any]], bool] | None = None,
        success: Callable[[Array, float, bool, dict[str, Any]], bool] | None = None,
        horizon: int | None = None,
        **kwargs: Any,
    ) -> None:
        if isinstance(env, str):
            env = _make(env, kwargs)
        box, seen = env.action_space, env.observation_space
        if not isinstance(box, gym.spaces.Box) or not isinstance(seen, gym.spaces.Box):
            raise ConfigError(f"a robot needs arrays as observations and actions (Box), not {seen} and {box}")
        self.env = env
        self.observation_space, self.action_space = seen, box
        self.task = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        self.horizon = horizon or getattr(env.spec, "max_episode_steps", None) or 1000
        self._violates, self._succeeds = violation, success
        self._obs: Array = np.zeros(seen.shape, seen.dtype)
        self._reward, self._violation, self._success, self._truncated = 0.0, False, False, False
        self._stopped = False

    def get_observation(self) -> Array:
        return self._obs

    def send_action(self, action: Array) -> None:
        if self._stopped or self._violation or self._success or self._truncated:
            return
        obs, reward, terminated, truncated, info = self.env.step(np.asarray(action, self.action_space.dtype))
        given = (obs, float(reward), terminated, info)
        self._obs, self._reward = np.array(obs), float(reward)
        done = info.get("success", info.get("is_success", False))
        self._success = bool(done if self._succeeds is None else self._succeeds(*given))
        fell = terminated and not self._success
        self._violation = bool(fell if self._violates is None else self._violates(*given)) and not self._success
        self._truncated = bool(truncated or terminated)

    def hold(self) -> None:
        self._reward = 0.0

    def reset(self, hard: bool, seed: int | None) -> None:
        """Begin a new episode."""
        obs, _ = self.env.reset(seed=seed)
        self._obs = np.array(obs)
        self._reward, self._violation, self._success, self._truncated = 0.0, False, False, False

    def stop(self) -> None:
        """Take no more actions."""
        self._stopped = True

    def release(self) -> None:
        """Take actions again."""
        self._stopped = False

    def violation(self) -> bool:
        """Has the episode violated the constraint?"""
        return self._violation

    def success(self) -> bool:
        """Has the episode completed the task?"""
        return self._success

    def truncated(self) -> bool:
        """Has the episode ended otherwise?"""
        return self._truncated and not self._violation

    def reward(self) -> float:
        """Of the last step."""
        return self._reward

    def cameras(self) -> Mapping[str, Grab]:
        """What the environment renders, if it was made with `render_mode="rgb_array"`."""
        return {"front": self._picture} if self.env.render_mode == "rgb_array" else {}

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _picture(self) -> Array:
        return np.asarray(self.env.render(), dtype=np.uint8)


class FleetDriver:
    """A fleet of one simulated robot, such as `make_fleet("Navigation", 1)`, as a robot of its own.

    Args:
        fleet: N = 1.
        task: its name.
        width, height: of pictures, where the fleet draws any.
    """

    def __init__(self, fleet: Fleet, task: str = "", width: int = 320, height: int = 240) -> None:
        if fleet.num_envs != 1:
            raise ConfigError(f"a robot is a fleet of one, not of {fleet.num_envs}")
        assert isinstance(fleet.single_observation_space, gym.spaces.Box)
        assert isinstance(fleet.single_action_space, gym.spaces.Box)
        self.fleet, self.task, self.size = fleet, task, (width, height)
        self.observation_space, self.action_space = fleet.single_observation_space, fleet.single_action_space
        self.horizon, self.goal = fleet.horizon, fleet.goal_conditioned
        self._obs: Array = np.zeros((1, *self.observation_space.shape), self.observation_space.dtype)
        self._reward, self._flags = 0.0, {"violation": False, "success": False, "truncated": False}
        self._stopped = False

    def get_observation(self) -> Array:
        return np.asarray(self._obs[0])

    def send_action(self, action: Array) -> None:
        if self._stopped or any(self._flags.values()):
            return
        obs, reward, _, truncated, info = self.fleet.step(np.asarray(action, np.float32)[None])
        self._obs, self._reward = obs, float(reward[0])
        fell, done = bool(info["violation"][0]), bool(info["success"][0])
        self._flags = {"violation": fell, "success": done, "truncated": bool(truncated[0]) and not fell}

    def hold(self) -> None:
        self._reward = 0.0

    def reset(self, hard: bool, seed: int | None) -> None:
        """Begin a new episode."""
        self._obs, _ = self.fleet.reset(seed=seed)
        self._reward, self._flags = 0.0, dict.fromkeys(self._flags, False)

    def stop(self) -> None:
        """Take no more actions."""
        self._stopped = True

    def release(self) -> None:
        """Take actions again."""
        self._stopped = False

    def violation(self) -> bool:
        """Has the episode violated the constraint?"""
        return self._flags["violation"]

    def success(self) -> bool:
        """Has the episode completed the task?"""
        return self._flags["success"]

    def truncated(self) -> bool:
        """Has the episode reached the horizon?"""
        return self._flags["truncated"]

    def reward(self) -> float:
        """Of the last step."""
        return self._reward

    def cameras(self) -> Mapping[str, Grab]:
        """A picture of the robot, where the fleet draws any."""
        draw: Any = getattr(self.fleet, "render_robot", None)
        if draw is None or not getattr(self.fleet, "render_mode", None):
            return {}
        if "width" in getattr(getattr(draw, "__code__", None), "co_varnames", ()):
            return {"front": lambda: np.asarray(draw(0, *self.size))}
        return {"front": lambda: np.asarray(draw(0))}

    def close(self) -> None:
        """Close the fleet."""
        self.fleet.close()


def _make(name: str, kwargs: dict[str, Any]) -> gym.Env[Any, Any]:
    try:
        return gym.make(name, **kwargs)
    except gym.error.Error as error:
        raise ConfigError(f"cannot make the environment {name!r}: {str(error).splitlines()[0]}") from error
    except TypeError:
        if "render_mode" not in kwargs:
            raise
        return gym.make(name, **{key: value for key, value in kwargs.items() if key != "render_mode"})
