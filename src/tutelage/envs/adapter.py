"""What every adapter of somebody else's environments shares: the bookkeeping that turns them into a fleet.

A simulator that we did not write knows nothing of constraints and of people who reset robots. `AdaptedFleet` adds that; a
`Backend` only steps and resets the robots that it is told to.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.fleet import Fleet, Mask

Array = NDArray[Any]


@dataclass(frozen=True)
class Outcome:
    """What one timestep led to, for all robots: the argument of the functions that judge it. Not to be changed.

    Robots that stood still during the step keep their observation and have reward 0 and no flag set; what a function
    says about them is ignored.

    Attributes:
        obs: (N, ...) observations after the step.
        reward: (N,) float64.
        terminated: (N,) bool, the environment ended the episode.
        truncated: (N,) bool, the environment or the horizon cut the episode off.
        episode_return: (N,) float64, sum of the rewards of the episode, this step included.
        elapsed: (N,) int, timesteps of the episode, this one included.
        info: the environment's own, as Gymnasium batches it: `info[key]` is an array over robots.
    """

    obs: Array
    reward: Array
    terminated: Mask
    truncated: Mask
    episode_return: Array
    elapsed: Array
    info: dict[str, Any]


Judge = Callable[[Outcome], Array]
"""Says which robots violated their constraint, or succeeded: (N,) bool."""


class Backend(ABC):
    """N robots of some simulator. Each can be stepped and reset on its own."""

    num_envs: int
    obs_space: gym.Space[Any]
    """Of one robot."""
    action_space: gym.Space[Any]
    """Of one robot."""
    horizon: int
    can_pause: bool = True
    """False: robots that are not stepped may go on by themselves; nobody looks at them until they are reset."""
    can_checkpoint: bool = False
    """Whether it has `state_dict` and `load_state_dict`."""

    @abstractmethod
    def reset(self, robots: Mask, seed: int | None) -> Array:
        """Reset the robots of the mask (N,), at least one: observations (N, ...), of which only those rows matter."""

    @abstractmethod
    def start(self, actions: Array, robots: Mask) -> None:
        """Start one timestep of the robots of the mask (N,) with actions (N, A)."""

    @abstractmethod
    def finish(self) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """What became of it, with N rows each: obs, reward, terminated, truncated, info; other robots' rows are ignored."""

    def picture(self, robot: int) -> Array | None:
        """A picture of one robot, (H, W, 3) uint8, or None."""
        return None

    def state_dict(self) -> dict[str, Any]:
        """Everything of the simulator that is needed to continue bit for bit."""
        raise NotImplementedError

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        raise NotImplementedError

    @abstractmethod
    def close(self) -> None:
        """Free what the simulator holds."""


class AdaptedFleet(Fleet):
    """The robots of a backend as a fleet; see `Fleet` for the contract.

    A robot whose episode ended stands still until it is reset. One that the environment terminated without violation or
    success counts as `truncated` too, so that it starts anew by itself and asks no human for a hard reset.

    Args:
        backend: the robots.
        violation: which robots violated their constraint in a timestep.
        success: which robots completed the task in a timestep; not asked about robots in violation.
    """

    def __init__(self, backend: Backend, violation: Judge, success: Judge) -> None:
        box, seen = backend.action_space, backend.obs_space
        if not isinstance(box, gym.spaces.Box) or len(box.shape) != 1:
            raise ConfigError(f"a fleet needs actions that are vectors of numbers (a Box of shape (A,)), got {box}")
        if not np.isfinite([box.low, box.high]).all():
            raise ConfigError("a fleet needs actions with finite bounds; clip the environment's action space")
        if not isinstance(seen, gym.spaces.Box):
            raise ConfigError(f"a fleet needs array observations, got {seen}; use gymnasium.wrappers.FlattenObservation")
        if backend.horizon < 1:
            raise ConfigError(f"the horizon must be at least 1 timestep, got {backend.horizon}")
        self._backend, self._violates, self._succeeds = backend, violation, success
        self.num_envs, self.horizon = backend.num_envs, backend.horizon
        self.can_pause, self.can_checkpoint = backend.can_pause, backend.can_checkpoint
        self.single_action_space = gym.spaces.Box(box.low.astype(np.float32), box.high.astype(np.float32), dtype=np.float32)
        self.single_observation_space = seen
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(seen, self.num_envs)

        n = self.num_envs
        self._obs = np.zeros((n, *seen.shape), dtype=seen.dtype)
        self._elapsed = np.zeros(n, dtype=np.int64)
        self._return = np.zeros(n)
        self._violation = np.zeros(n, dtype=bool)
        self._over = np.ones(n, dtype=bool)
        self._moving = np.zeros(n, dtype=bool)
        self._started = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Reset all robots, or those of `options["reset_mask"]` (N,) bool."""
        mask = self.reset_mask(options)
        if not (self._started or mask.all()):
            raise ContractError("the first reset of a fleet must reset all robots; call reset() without a mask")
        if mask.any():
            obs = self._backend.reset(mask, seed)
            self._obs = np.where(_rows(mask, obs), obs, self._obs)
            self._elapsed, self._return = np.where(mask, 0, self._elapsed), np.where(mask, 0.0, self._return)
            self._violation, self._over = self._violation & ~mask, self._over & ~mask
            self._started = True
        return self._obs, {"violation": self._violation.copy(), "success": np.zeros(self.num_envs, dtype=bool)}

    def step_async(self, actions: Array, active: Mask | None = None) -> None:
        if not self._started:
            raise ContractError("reset the fleet before its first step")
        actions = np.asarray(actions)
        moving = ~self._over if active is None else ~self._over & active
        if not self.can_pause and (moving != ~self._over).any():
            raise ContractError("this fleet cannot pause robots; step all that are not in violation")
        self.check_actions(actions, moving)
        self._moving = moving
        if moving.any():
            self._backend.start(actions, moving)

    def step_wait(self) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        moving = self._moving
        own: dict[str, Any] = {}
        reward, terminated, truncated = np.zeros(self.num_envs), np.zeros_like(moving), np.zeros_like(moving)
        if moving.any():
            obs, raw_reward, ended, cut, own = self._backend.finish()
            self._obs = np.where(_rows(moving, obs), obs, self._obs)
            reward = np.where(moving, raw_reward, 0.0).astype(np.float64)
            self._elapsed = self._elapsed + moving
            self._return = self._return + reward
            terminated = moving & ended
            truncated = moving & (cut | (self._elapsed >= self.horizon))
        outcome = Outcome(self._obs, reward, terminated, truncated, self._return, self._elapsed, own)
        violation = moving & self._judge("violation", self._violates, outcome)
        success = moving & self._judge("success", self._succeeds, outcome) & ~violation
        self._violation = self._violation | violation
        self._over = self._over | terminated | truncated | violation | success
        info = {
            **own,
            "violation": self._violation.copy(),
            "success": success,
            "return": self._return.copy(),
            "elapsed": self._elapsed.copy(),
        }
        restarts = (truncated | (terminated & ~success)) & ~violation
        return self._obs, reward, self._violation | terminated, restarts, info

    def _judge(self, name: str, judge: Judge, outcome: Outcome) -> Mask:
        verdict = np.asarray(judge(outcome))
        if verdict.shape != (self.num_envs,) or verdict.dtype != bool:
            raise ContractError(f"{name} must return ({self.num_envs},) bool, got {verdict.shape} {verdict.dtype}")
        return verdict

    def render(self) -> tuple[Array, ...] | None:
        """A picture of every robot, (H, W, 3) uint8 each, or None if the environment draws none."""
        pictures = [self._backend.picture(robot) for robot in range(self.num_envs)]
        return None if any(p is None for p in pictures) else tuple(p for p in pictures if p is not None)

    def render_robot(self, robot: int) -> Array:
        """A picture of one robot, (H, W, 3) uint8, of the size that the environment chose.

        Raises:
            ConfigError: the environment was not made to draw.
        """
        picture = self._backend.picture(robot)
        if picture is None:
            raise ConfigError("this environment draws no pictures; make it with render_mode='rgb_array'")
        return picture

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environments."""
        self._backend.close()

    def state_dict(self) -> dict[str, Any]:
        if not self.can_checkpoint:
            raise ConfigError("this fleet cannot be checkpointed: its simulator does not give out its state")
        return {
            "backend": self._backend.state_dict(),
            "obs": self._obs.copy(),
            "elapsed": self._elapsed.copy(),
            "return": self._return.copy(),
            "violation": self._violation.copy(),
            "over": self._over.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if not self.can_checkpoint:
            raise ConfigError("this fleet cannot be checkpointed: its simulator does not take a state")
        self._backend.load_state_dict(state["backend"])
        self._obs = state["obs"].copy()
        self._elapsed, self._return = state["elapsed"].copy(), state["return"].copy()
        self._violation, self._over = state["violation"].copy(), state["over"].copy()
        self._started = True


def _rows(mask: Mask, like: Array) -> Mask:
    """The mask (N,) with as many dimensions as the array."""
    return mask.reshape(-1, *[1] * (like.ndim - 1))
