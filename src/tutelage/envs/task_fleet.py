"""What the fleets of built-in tasks share, whatever simulates them: seeds, standing still, noise, success, checkpoints."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tutelage.envs.disturbance import Disturbance, parse
from tutelage.envs.tasks import TASKS
from tutelage.envs.tasks.base import Array, Task
from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.fleet import Fleet, Mask
from tutelage.seeding import rng_state, set_rng_state

PIXELS = 64
"""Height and width of the images that a policy sees (section 3.5)."""


@dataclass(frozen=True)
class Result:
    """What a timestep led to, for all robots; rows of robots that did not move are ignored.

    Attributes:
        obs: (N, D) float64.
        reward: (N,).
        violation: (N,) bool.
        reached: (N,) bool, whether the goal was reached; False where a task has none.
        usable: (N,) bool, False where the simulation diverged: a violation, and its numbers are nobody's.
        info: more, by name, (N, ...) each.
    """

    obs: Array
    reward: Array
    violation: Mask
    reached: Mask
    usable: Mask
    info: Mapping[str, Array]


class TaskFleet(Fleet):
    """N robots at one task; see `Fleet` for the contract. What simulates them is up to the class that is derived.

    Args:
        task: a `Task` or the name of one ("Walker2d").
        num_envs: N robots.
        disturbance: a level name, "name=value,..." or a `Disturbance`; default: the task's own level.
        success_return: the return an episode must reach, without violation, to be a success (section 5.6: 95 % of
            the expert's). Default: reaching the horizon is enough. A task with a goal says itself what success is.
        observation: "state", the task's vector; or "images", what the task's camera sees, (N, 64, 64, 3) uint8. Then the
            vector is in `info["state"]`, (N, D) float64, for humans that are programs.
    """

    dt: float
    """Seconds of a timestep."""

    def __init__(
        self,
        task: Task | str,
        num_envs: int,
        *,
        disturbance: Disturbance | str | None = None,
        success_return: float = -math.inf,
        render_mode: str | None = None,
        observation: Literal["state", "images"] = "state",
    ) -> None:
        if isinstance(task, str):
            if task not in TASKS:
                raise ConfigError(f"unknown task {task!r}; known tasks: {', '.join(TASKS)}")
            task = TASKS[task]()
        if not issubclass(task.fleet_type(), type(self)):
            raise ConfigError(f"{task.name} is no task for a {type(self).__name__}; use make_fleet")
        if num_envs < 1:
            raise ConfigError(f"a fleet needs at least one robot, got {num_envs}")
        if observation not in ("state", "images"):
            raise ConfigError(f'observation must be "state" or "images", got {observation!r}')
        self.task: Task = task
        level = task.disturbance if disturbance is None else disturbance
        self.disturbance = parse(level) if isinstance(level, str) else level
        self.success_return, self.horizon, self.goal_conditioned = success_return, task.horizon, task.goal
        self.num_envs, self.render_mode = num_envs, render_mode
        self._rng = np.random.Generator(np.random.PCG64(0))
        self._scale = np.ones((2, num_envs))
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._return = np.zeros(num_envs)
        self._violation = np.zeros(num_envs, dtype=bool)
        self._complete = np.zeros(num_envs, dtype=bool)
        self._images = np.zeros((num_envs, PIXELS, PIXELS, 3), dtype=np.uint8) if observation == "images" else None
        self._pending: Any = None
        self._seeded = False

    def _declare(self, low: Array, high: Array, width: int) -> None:
        """Say how large actions (A,) and observations are, once the simulation knows."""
        self.single_action_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (width,), dtype=np.float64)
        if self._images is not None:
            self.single_observation_space = gym.spaces.Box(0, 255, (PIXELS, PIXELS, 3), dtype=np.uint8)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.metadata = {**self.metadata, "render_modes": ["rgb_array"], "render_fps": max(1, round(1 / self.dt))}
        self._obs = np.zeros((self.num_envs, width))

    @property
    def state(self) -> Array | None:
        """The task's vectors, (N, D) float64, where images are observed."""
        return None if self._images is None else self._obs

    # -- what simulates the robots ------------------------------------------------------------------------------

    @abstractmethod
    def _vary(self, scale: Array) -> None:
        """Scale the robots' masses and friction, (2, N). Keep the numbers in `_scale`."""

    @abstractmethod
    def _restart(self, robots: Array) -> None:
        """Put the given robots (n indices, at least one) into initial states."""

    @abstractmethod
    def _observe(self) -> Array:
        """(N, D) float64."""

    @abstractmethod
    def _start(self, actions: Array, moving: Mask) -> None:
        """Start one timestep of the moving robots, with actions (N, A) that are 0 for the others."""

    @abstractmethod
    def _finish(self, actions: Array, moving: Mask) -> Result:
        """Finish it. The actions are those that were commanded, without noise."""

    @abstractmethod
    def images(self, robots: Array | None = None) -> NDArray[np.uint8]:
        """What the task's camera sees of the given robots (n indices; default: all), (n, 64, 64, 3) uint8."""

    @abstractmethod
    def render_robot(self, robot: int, width: int = 320, height: int = 240) -> NDArray[np.uint8]:
        """A picture of one robot, (height, width, 3) uint8."""

    # -- Gymnasium ----------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Reset all robots, or those of `options["reset_mask"]` (N,) bool.

        With a seed, the stream of initial states and disturbances restarts, and the masses and friction of these
        robots are drawn anew.
        """
        mask = self.reset_mask(options)
        if not (self._seeded or mask.all()):
            raise ContractError("the first reset of a fleet must reset all robots; call reset() without a mask")
        if seed is not None or not self._seeded:
            self._rng = np.random.Generator(np.random.PCG64(seed))
            self._seeded = True
            self._complete[mask] = False  # with a seed, what comes does not depend on what was
            spread = np.array([[self.disturbance.mass], [self.disturbance.friction]])
            self._vary(np.where(mask, 1 + self._rng.uniform(-1, 1, (2, self.num_envs)) * spread, self._scale))
        robots = np.flatnonzero(mask)
        if robots.size:
            self._restart(robots)
            self._elapsed[mask], self._return[mask], self._violation[mask], self._complete[mask] = 0, 0.0, False, False
            self._obs = np.where(mask[:, None], self._observe(), self._obs)
            self._look(mask)
        return self._seen({"violation": self._violation.copy(), "success": np.zeros(self.num_envs, dtype=bool)})

    def step_async(self, actions: Array, active: Mask | None = None) -> None:
        actions = np.asarray(actions, dtype=np.float64)
        if not self._seeded:
            raise ContractError("reset the fleet before its first step")
        moving = ~(self._violation | self._complete)
        moving = moving if active is None else moving & active
        self.check_actions(actions, moving)
        self._start(np.where(moving[:, None], actions, 0.0), moving)
        self._pending = moving, actions

    def step_wait(self) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        moving, actions = self._pending
        result = self._finish(actions, moving)
        usable = moving & result.usable
        reward = np.where(usable, result.reward, 0.0)
        self._obs = np.where(usable[:, None], result.obs, self._obs)
        self._look(usable)
        self._violation = self._violation | (moving & (result.violation | ~result.usable))
        self._elapsed += moving
        self._return += reward
        truncated = moving & (self._elapsed >= self.horizon) & ~self._violation
        if self.goal_conditioned:
            success = moving & ~self._violation & result.reached
            self._complete = self._complete | success  # it stands still until it is reset
        else:
            success = truncated & (self._elapsed == self.horizon) & (self._return >= self.success_return)
        seen, info = self._seen(
            {
                **result.info,
                "violation": self._violation.copy(),
                "success": success,
                "return": self._return.copy(),
                "elapsed": self._elapsed.copy(),
            }
        )
        return seen, reward, self._violation.copy(), truncated, info

    def _look(self, mask: Mask) -> None:
        """Draw what the robots of the mask (N,) see, if it is images that are observed."""
        if self._images is not None:
            self._images = self._images.copy()  # the old ones belong to whom they were given
            self._images[mask] = self.images(np.flatnonzero(mask))

    def _seen(self, info: dict[str, Any]) -> tuple[Array, dict[str, Any]]:
        """What a policy observes of all robots, and the info that goes with it."""
        if self._images is None:
            return self._obs, info
        return self._images, info | {"state": self._obs}

    def render(self) -> tuple[Array, ...] | None:
        """A picture of every robot, (H, W, 3) uint8 each, when `render_mode` is "rgb_array"."""
        return tuple(self.render_robot(i) for i in range(self.num_envs)) if self.render_mode else None

    # -- state --------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        return {
            "scale": self._scale,
            "elapsed": self._elapsed.copy(),
            "return": self._return.copy(),
            "violation": self._violation.copy(),
            "complete": self._complete.copy(),
            "obs": self._obs.copy(),
            **({} if self._images is None else {"images": self._images.copy()}),
            "rng": rng_state(self._rng),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._vary(state["scale"])
        self._elapsed[:] = state["elapsed"]
        self._return[:] = state["return"]
        self._violation = state["violation"].copy()
        self._complete = state["complete"].copy()
        self._obs = state["obs"].copy()
        if self._images is not None:
            self._images = state["images"].copy()
        set_rng_state(self._rng, state["rng"])
        self._seeded = True
