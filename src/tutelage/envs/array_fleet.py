"""N robots whose physics is written as array operations, as a fleet: no simulator, no threads, no waiting."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.disturbance import Disturbance
from tutelage.envs.task_fleet import PIXELS, Result, TaskFleet
from tutelage.envs.tasks.base import Array, ArrayTask, World
from tutelage.fleet.fleet import Mask

UNSTABLE = np.array(["state", ""])
"""`info["unstable"]` of robots whose state is not finite, and of all others."""


class ArrayFleet(TaskFleet):
    """A fleet at an `ArrayTask`; see `Fleet` for the contract.

    A state that is not finite is a violation of that robot alone, which keeps its last good observation; `info["unstable"]`
    (N,) str then says "state" for it.

    Args:
        task: an `ArrayTask` or the name of one ("Navigation").
        num_envs: N robots.
        disturbance, observation: see `TaskFleet`.
        success_return, threads: these tasks have a goal and no threads: taken, so that all fleets are made alike.
    """

    task: ArrayTask

    def __init__(
        self,
        task: ArrayTask | str,
        num_envs: int,
        *,
        disturbance: Disturbance | str | None = None,
        success_return: float = -math.inf,
        threads: int | None = None,
        render_mode: str | None = None,
        observation: Literal["state", "images"] = "state",
    ) -> None:
        super().__init__(
            task, num_envs, disturbance=disturbance, success_return=success_return,
            render_mode=render_mode, observation=observation,
        )  # fmt: skip
        assert self.task.action_low is not None
        assert self.task.action_high is not None
        self.dt = self.task.dt
        self._rest = self.task.initial(np.random.Generator(np.random.PCG64(0)), num_envs)
        self._state = self._next = self._rest
        self._declare(self.task.action_low, self.task.action_high, self._observe().shape[1])

    @property
    def states(self) -> Array:
        """The robots' states (N, S): what their task says. Not to be changed."""
        return self._state

    def put(self, state: Array) -> None:
        """Put the robots into states (N, S), in the middle of their episodes."""
        self._state = np.array(state, dtype=np.float64)
        self._obs = self._observe()
        self._look(np.ones(self.num_envs, dtype=bool))

    def _restart(self, robots: Array) -> None:
        complete = self._complete[robots]
        onward, anew = robots[complete], robots[~complete]
        self._state = self._state.copy()
        if onward.size:
            self._state[onward] = self.task.onward(self._rng, self._state[onward])
        if anew.size:
            self._state[anew] = self.task.initial(self._rng, anew.size)

    def _observe(self) -> Array:
        return self.task.observe(self._state)

    def _start(self, actions: Array, moving: Mask) -> None:
        noise = self._rng.standard_normal((self.num_envs, self.task.noise_size)) if self.disturbance.noise else 0.0
        noise = np.broadcast_to(self.disturbance.noise * noise, (self.num_envs, self.task.noise_size))
        world = World(noise, self._scale[1], self.disturbance.wind)
        self._next = np.where(moving[:, None], self.task.advance(self._state, actions, world), self._state)

    def _finish(self, actions: Array, moving: Mask) -> Result:
        usable = np.asarray(np.isfinite(self._next).all(axis=1))
        self._state = np.where(usable[:, None], self._next, self._rest)  # nothing that is not finite stays behind
        violation = self.task.violation(self._state)
        reached = np.asarray(self.task.success(self._state) & ~violation)
        info = {"unstable": UNSTABLE[usable.astype(np.intp)]}
        return Result(self._observe(), reached.astype(np.float64), violation, reached, usable, info)

    def images(self, robots: Array | None = None) -> NDArray[np.uint8]:
        return self.task.draw(self._state if robots is None else self._state[robots], PIXELS, PIXELS)

    def render_robot(self, robot: int, width: int = 320, height: int = 240) -> NDArray[np.uint8]:
        return np.asarray(self.task.draw(self._state[robot : robot + 1], width, height)[0])

    def _vary(self, scale: Array) -> None:
        self._scale = scale

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "state": self._state.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._state = state["state"].copy()
