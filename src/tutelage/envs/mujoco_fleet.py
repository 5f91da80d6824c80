"""N robots on batched MuJoCo physics, as a fleet."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tutelage.envs.disturbance import Disturbance, Pusher
from tutelage.envs.engine import BAD_POSITION, BAD_VELOCITY, STABLE, Physics
from tutelage.envs.task_fleet import PIXELS, Result, TaskFleet
from tutelage.envs.tasks.base import Array, GoalTask, MujocoTask
from tutelage.errors import ConfigError
from tutelage.fleet.fleet import Mask

BAD_OBSERVATION = 3
UNSTABLE = np.array([""] * 4, dtype="<U11")
"""`info["unstable"]`: which of a robot's numbers became unusable in this step; "" for all others."""
UNSTABLE[[BAD_POSITION, BAD_VELOCITY, BAD_OBSERVATION]] = "position", "velocity", "observation"


class MujocoFleet(TaskFleet):
    """A fleet of MuJoCo robots; see `Fleet` for the contract.

    A robot whose simulation diverges (a number that is not finite, or larger than any robot's) is in violation, like one
    that fell, and keeps its last good observation; `info["unstable"]` (N,) str of that step says what diverged: "position",
    "velocity" or "observation". The other robots do not notice.

    Args:
        task: a `MujocoTask` or the name of one ("Walker2d").
        num_envs: N robots.
        disturbance, success_return: see `TaskFleet`.
        threads: physics threads; default: all cores of the process.
        observation: "state" or "images", see `TaskFleet`. Images are drawn in the thread that calls `reset` and
            `step_wait`, which must be the same.
    """

    task: MujocoTask

    def __init__(
        self,
        task: MujocoTask | str,
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
        task = self.task
        if self.disturbance.wind:
            raise ConfigError(f"no wind blows in {task.name}; use push")
        self.physics = Physics(
            task.xml_path, num_envs, task.fields,
            push_body=task.push_body, contact_forces=task.contact_forces, threads=threads,
        )  # fmt: skip
        model = self.physics.model
        self.dt = float(model.opt.timestep) * task.frame_skip
        own = model.body_rootid == model.body_rootid[model.body(task.push_body).id]
        weight = float(np.where(own, model.body_mass, 0.0).sum()) * float(np.linalg.norm(model.opt.gravity))
        self._pusher = Pusher(self.disturbance, weight, self.dt, num_envs, task.planar)
        self._body_mass = np.tile(model.body_mass, (num_envs, 1))
        self._position = np.zeros(num_envs)
        self._renderers: dict[tuple[int, int], Any] = {}
        self._moves: Any = None

        low, high = model.actuator_ctrlrange.astype(np.float32).T
        if task.action_low is not None and task.action_high is not None:
            low, high = task.action_low, task.action_high
        self._declare(low, high, self._observe().shape[1])

    def _restart(self, robots: Array) -> None:
        if isinstance(self.task, GoalTask) and self.task.goes_on:
            onward, robots = robots[self._complete[robots]], robots[~self._complete[robots]]
            if onward.size:
                self.physics.place(onward, self.task.onward(self._rng, self.physics.frame["qpos"][onward]))
            if not robots.size:
                return
        qpos, qvel = self.task.initial(self._rng, robots.size, self.physics.qpos0, self.physics.qvel0)
        self.physics.restart(robots, qpos, qvel)
        self._pusher.calm(robots)
        self._position[robots] = self.task.forward(self.physics.frame, self._body_mass)[robots]

    def _observe(self) -> Array:
        return self.task.observe(self.physics.frame)

    def _start(self, actions: Array, moving: Mask) -> None:
        if self.disturbance.noise:
            half = (self.action_high - self.action_low) / 2
            noisy = actions + self.disturbance.noise * half * self._rng.standard_normal(actions.shape)
            actions = np.where(moving[:, None], np.clip(noisy, self.action_low, self.action_high), 0.0)
        ctrl = self.task.control(self.physics.frame, actions)
        push = self._pusher.step(self._rng, moving) if self.disturbance.push else None
        self._moves = self.physics.advance_async(np.flatnonzero(moving), ctrl, push, self.task.frame_skip)

    def _finish(self, actions: Array, moving: Mask) -> Result:
        self._moves.results()
        frame, obs = self.physics.frame, self._observe()
        unstable = np.where(moving, self.physics.unstable, STABLE)
        unstable[moving & (unstable == STABLE) & ~np.isfinite(obs).all(axis=1)] = BAD_OBSERVATION
        usable = unstable == STABLE
        position = self.task.forward(frame, self._body_mass)
        reward = self.task.reward(frame, (position - self._position) / self.dt, actions)
        self._position = np.where(moving & usable, position, self._position)
        reached = self.task.success(frame) if isinstance(self.task, GoalTask) else np.zeros_like(moving)
        return Result(obs, reward, self.task.violation(frame), reached, usable, {"unstable": UNSTABLE[unstable]})

    # -- pictures -----------------------------------------------------------------------------------------------

    def images(self, robots: Array | None = None) -> NDArray[np.uint8]:
        robots = np.arange(self.num_envs) if robots is None else np.asarray(robots)
        pictures = np.zeros((len(robots), PIXELS, PIXELS, 3), dtype=np.uint8)
        for picture, robot in zip(pictures, robots, strict=True):
            picture[:] = self.render_robot(robot, PIXELS, PIXELS)
        return pictures

    def render_robot(self, robot: int, width: int = 320, height: int = 240) -> NDArray[np.uint8]:
        """A picture of one robot, (height, width, 3) uint8, from the task's camera or one that follows it."""
        from tutelage.envs.rendering import Renderer

        key = (width, height)
        if key not in self._renderers:
            torso = self.physics.model.body(self.task.push_body).id
            self._renderers[key] = Renderer(self.physics.model, width, height, body=torso, camera=self.task.camera)
        return self._renderers[key].picture(self.physics.datas[robot])  # type: ignore[no-any-return]

    def close_extras(self, **kwargs: Any) -> None:
        """Free the renderers."""
        for renderer in self._renderers.values():
            renderer.close()

    # -- state --------------------------------------------------------------------------------------------------

    def _vary(self, scale: Array) -> None:
        self._scale = scale
        if self.disturbance.mass or self.disturbance.friction:
            self.physics.vary(*scale)
            self._body_mass = self.physics.model.body_mass * scale[0][:, None]

    def state_dict(self) -> dict[str, Any]:
        return {
            **super().state_dict(),
            "physics": self.physics.get_state(),
            "frame": self.physics.raw_frame.copy(),
            "position": self._position.copy(),
            "push_left": self._pusher.left.copy(),
            "push_wrench": self._pusher.wrench.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.physics.set_state(state["physics"])
        self.physics.raw_frame[:] = state["frame"]
        self._position = state["position"].copy()
        self._pusher.left[:] = state["push_left"]
        self._pusher.wrench[:] = state["push_wrench"]
