"""A fleet: N robots with the same state and action space, stepped together (section 5.3)."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from tutelage.errors import ContractError

Array = NDArray[Any]
Mask = NDArray[np.bool_]


class Fleet(VectorEnv[Any, Any, Any]):
    """N independent MDPs behind Gymnasium's vector interface, with three promises on top.

    * Autoreset is disabled. `reset(options={"reset_mask": mask})` resets the robots of the mask and no other.
    * `info` of `step` and `reset` holds, for every robot: `info["violation"]` (N,) bool, the constraint c(s) of
      section 5.3, and `info["success"]` (N,) bool, true only on the step that completes the task.
    * A robot that violated its constraint stands still, whatever its action, and stays in violation until it is reset.

    An episode that ends without violation ends in `success`, in `truncated`, or in both.

    `step` is `step_async` followed by `step_wait`, so that learning may run while physics does. Robots outside
    `active` are paused: time stops for them, their observation stays, their reward is 0. Fleets that cannot do this
    say `can_pause = False` and are refused where pausing is needed (switching latency).

    Arrays that `step` and `reset` return belong to the caller: a fleet never writes into them again.

    Shapes: observations (N, ...), actions (N, A), reward (N,) float64, terminated, truncated (N,) bool.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.DISABLED}
    can_pause: bool = True
    can_checkpoint: bool = True
    """Whether `state_dict` works. Fleets whose simulator hides its state say False and raise `ConfigError` there."""
    horizon: int
    """Timesteps of an episode; then `truncated` is set."""
    goal_conditioned: bool = False
    """Whether success means reaching a goal state (the goal critic and U.G.C. need one)."""

    @property
    def state(self) -> Array | None:
        """What there is to know of all robots now, (N, D), where they observe something else, such as images; else None.

        For humans who are programs: nobody else looks at it.
        """
        return None

    @abstractmethod
    def step_async(self, actions: Array, active: Mask | None = None) -> None:
        """Start one timestep of the robots in `active` (all by default)."""

    @abstractmethod
    def step_wait(self) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        """Finish the timestep that `step_async` started: (obs, reward, terminated, truncated, info)."""

    def step(self, actions: Array, active: Mask | None = None) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        """One timestep of the robots in `active` (all by default)."""
        self.step_async(actions, active)
        return self.step_wait()

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue bit for bit, as nested dictionaries of arrays and JSON values."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""

    @property
    def action_low(self) -> Array:
        """(A,) float32, the lower bound of each action."""
        return self._action_box.low

    @property
    def action_high(self) -> Array:
        """(A,) float32, the upper bound of each action."""
        return self._action_box.high

    def reset_mask(self, options: dict[str, Any] | None) -> Mask:
        """The robots that `reset(options=...)` is to reset, (N,) bool.

        Raises:
            ContractError: a mask of the wrong shape or type.
        """
        if not options or "reset_mask" not in options:
            return np.ones(self.num_envs, dtype=bool)
        mask = np.asarray(options["reset_mask"])
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ContractError(f"reset_mask must be ({self.num_envs},) bool, got {mask.shape} {mask.dtype}")
        return mask

    def check_actions(self, actions: Array, moving: Mask) -> None:
        """Refuse actions of the wrong shape, and numbers that are not finite for robots that are to move.

        Raises:
            ContractError: naming the first robots concerned.
        """
        if actions.shape != self.action_space.shape:
            raise ContractError(f"actions must have shape {self.action_space.shape}, got {actions.shape}")
        if not np.isfinite(actions[moving]).all():
            bad = np.flatnonzero(moving & ~np.isfinite(actions).all(axis=1))
            raise ContractError(f"actions of robots {bad[:5].tolist()} are not finite; check the policy that made them")

    @property
    def _action_box(self) -> gym.spaces.Box:
        assert isinstance(self.single_action_space, gym.spaces.Box)
        return self.single_action_space
