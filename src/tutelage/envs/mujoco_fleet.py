"""N robots on batched MuJoCo physics, as a fleet."""

from __future__ import annotations

import math
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tutelage.envs.disturbance import Disturbance, Pusher, parse
from tutelage.envs.engine import BAD_POSITION, BAD_VELOCITY, STABLE, Physics, wait
from tutelage.envs.tasks import TASKS
from tutelage.envs.tasks.base import Array, GoalTask, MujocoTask
from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.fleet import Fleet, Mask
from tutelage.seeding import rng_state, set_rng_state

PIXELS = 64
"""Height and width of the images that a policy sees (section 3.5)."""
BAD_OBSERVATION = 3
UNSTABLE = np.array([""] * 4, dtype="<U11")
"""`info["unstable"]`: which of a robot's numbers became unusable in this step; "" for all others."""
UNSTABLE[[BAD_POSITION, BAD_VELOCITY, BAD_OBSERVATION]] = "position", "velocity", "observation"


class MujocoFleet(Fleet):
    """A fleet of MuJoCo robots; see `Fleet` for the contract.

    A robot whose simulation diverges (a number that is not finite, or larger than any robot's) is in violation, like one
    that fell, and keeps its last good observation; `info["unstable"]` (N,) str of that step says what diverged: "position",
    "velocity" or "observation". The other robots do not notice.

    Args:
        task: a `MujocoTask` or the name of one ("Walker2d").
        num_envs: N robots.
        disturbance: a level name, "name=value,..." or a `Disturbance`; default: the task's own level.
        success_return: the return an episode must reach, without violation, to be a success (section 5.6: 95 % of
            the expert's). Default: reaching the horizon is enough. A `GoalTask` says itself what success is.
        threads: physics threads; default: all cores of the process.
        observation: "state", the task's vector; or "images", what the task's camera sees, (N, 64, 64, 3) uint8. Then the
            vector is in `info["state"]`, (N, D) float64, for humans that are programs. Images are drawn in the thread that
            calls `reset` and `step_wait`, which must be the same.
    """

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
        if isinstance(task, str):
            if task not in TASKS:
                raise ConfigError(f"unknown task {task!r}; known tasks: {', '.join(TASKS)}")
            task = TASKS[task]()
        if num_envs < 1:
            raise ConfigError(f"a fleet needs at least one robot, got {num_envs}")
        if observation not in ("state", "images"):
            raise ConfigError(f'observation must be "state" or "images", got {observation!r}')
        self.task = task
        level = task.disturbance if disturbance is None else disturbance
        self.disturbance = parse(level) if isinstance(level, str) else level
        self.success_return = success_return
        self.horizon = task.horizon
        self.goal_conditioned = isinstance(task, GoalTask)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.physics = Physics(
            task.xml_path, num_envs, task.fields,
            push_body=task.push_body, contact_forces=task.contact_forces, threads=threads,
        )  # fmt: skip
        model = self.physics.model
        self.dt = float(model.opt.timestep) * task.frame_skip
        self.metadata = {**self.metadata, "render_modes": ["rgb_array"], "render_fps": round(1 / self.dt)}
        own = model.body_rootid == model.body_rootid[model.body(task.push_body).id]
        weight = float(np.where(own, model.body_mass, 0.0).sum()) * float(np.linalg.norm(model.opt.gravity))
        self._pusher = Pusher(self.disturbance, weight, self.dt, num_envs, task.planar)
        self._body_mass = np.tile(model.body_mass, (num_envs, 1))

        low, high = model.actuator_ctrlrange.astype(np.float32).T
        if task.action_low is not None and task.action_high is not None:
            low, high = task.action_low, task.action_high
        width = task.observe(self.physics.frame).shape[1]
        self.single_action_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (width,), dtype=np.float64)
        if observation == "images":
            self.single_observation_space = gym.spaces.Box(0, 255, (PIXELS, PIXELS, 3), dtype=np.uint8)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

        self._rng = np.random.Generator(np.random.PCG64(0))
        self._scale = np.ones((2, num_envs))
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._return = np.zeros(num_envs)
        self._position = np.zeros(num_envs)
        self._violation = np.zeros(num_envs, dtype=bool)
        self._complete = np.zeros(num_envs, dtype=bool)
        self._obs = np.zeros((num_envs, width))
        self._images = np.zeros((num_envs, PIXELS, PIXELS, 3), dtype=np.uint8) if observation == "images" else None
        self._renderers: dict[tuple[int, int], Any] = {}
        self._pending: Any = None
        self._seeded = False

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
            spread = np.array([[self.disturbance.mass], [self.disturbance.friction]])
            self._vary(np.where(mask, 1 + self._rng.uniform(-1, 1, (2, self.num_envs)) * spread, self._scale))
        robots = np.flatnonzero(mask)
        if robots.size:
            qpos, qvel = self.task.initial(self._rng, robots.size, self.physics.qpos0, self.physics.qvel0)
            self.physics.restart(robots, qpos, qvel)
            self._pusher.calm(mask)
            self._elapsed[mask], self._return[mask], self._violation[mask], self._complete[mask] = 0, 0.0, False, False
            self._obs = np.where(mask[:, None], self.task.observe(self.physics.frame), self._obs)
            self._position = np.where(mask, self.task.forward(self.physics.frame, self._body_mass), self._position)
            self._look(mask)
        return self._seen({"violation": self._violation.copy(), "success": np.zeros(self.num_envs, dtype=bool)})

    def step_async(self, actions: Array, active: Mask | None = None) -> None:
        actions = np.asarray(actions, dtype=np.float64)
        if not self._seeded:
            raise ContractError("reset the fleet before its first step")
        moving = ~(self._violation | self._complete)
        moving = moving if active is None else moving & active
        self.check_actions(actions, moving)
        ctrl = actions
        if self.disturbance.noise:
            half = (self.action_high - self.action_low) / 2
            ctrl = actions + self.disturbance.noise * half * self._rng.standard_normal(actions.shape)
            ctrl = np.clip(ctrl, self.action_low, self.action_high)
        ctrl = self.task.control(self.physics.frame, np.where(moving[:, None], ctrl, 0.0))
        push = self._pusher.step(self._rng, moving) if self.disturbance.push else None
        futures = self.physics.advance_async(np.flatnonzero(moving), ctrl, push, self.task.frame_skip)
        self._pending = futures, moving, actions

    def step_wait(self) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        futures, moving, actions = self._pending
        wait(futures)
        frame = self.physics.frame
        obs = self.task.observe(frame)
        # A simulation that diverged is a violation, and its numbers are nobody's.
        unstable = np.where(moving, self.physics.unstable, STABLE)
        unstable[moving & (unstable == STABLE) & ~np.isfinite(obs).all(axis=1)] = BAD_OBSERVATION
        sane = unstable == STABLE
        fell = self.task.violation(frame) | ~sane
        position = self.task.forward(frame, self._body_mass)
        reward = np.where(moving & sane, self.task.reward(frame, (position - self._position) / self.dt, actions), 0.0)
        self._obs = np.where((moving & sane)[:, None], obs, self._obs)
        self._look(moving & sane)
        self._position = np.where(moving & sane, position, self._position)
        self._violation = self._violation | (moving & fell)
        self._elapsed += moving
        self._return += reward
        truncated = moving & (self._elapsed >= self.horizon) & ~self._violation
        if isinstance(self.task, GoalTask):
            success = moving & ~self._violation & self.task.success(frame)
            self._complete = self._complete | success  # it stands still until it is reset
        else:
            success = truncated & (self._elapsed == self.horizon) & (self._return >= self.success_return)
        info = {
            "violation": self._violation.copy(),
            "success": success,
            "return": self._return.copy(),
            "elapsed": self._elapsed.copy(),
            "unstable": UNSTABLE[unstable],
        }
        seen, info = self._seen(info)
        return seen, reward, self._violation.copy(), truncated, info

    @property
    def state(self) -> Array | None:
        """The task's vectors, (N, D) float64, where images are observed."""
        return None if self._images is None else self._obs

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

    def images(self, robots: Array | None = None) -> NDArray[np.uint8]:
        """What the task's camera sees of the given robots (n indices; default: all), (n, 64, 64, 3) uint8."""
        robots = np.arange(self.num_envs) if robots is None else np.asarray(robots)
        pictures = np.zeros((len(robots), PIXELS, PIXELS, 3), dtype=np.uint8)
        for picture, robot in zip(pictures, robots, strict=True):
            picture[:] = self.render_robot(robot, PIXELS, PIXELS)
        return pictures

    def render(self) -> tuple[Array, ...] | None:
        """A picture of every robot, (H, W, 3) uint8 each, when `render_mode` is "rgb_array"."""
        return tuple(self.render_robot(i) for i in range(self.num_envs)) if self.render_mode else None

    def render_robot(self, robot: int, width: int = 320, height: int = 240) -> NDArray[np.uint8]:
        """A picture of one robot, (height, width, 3) uint8, from the task's camera or one that follows it."""
        from tutelage.envs.rendering import Renderer

        key = (width, height)
        if key not in self._renderers:
            torso = self.physics.model.body(self.task.push_body).id
            self._renderers[key] = Renderer(self.physics.model, width, height, body=torso, camera=self.task.camera)
        return self._renderers[key].picture(self.physics.datas[robot])  # type: ignore[no-any-return]

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the physics threads and free the renderers."""
        self.physics.close()
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
            "physics": self.physics.get_state(),
            "frame": self.physics.raw_frame.copy(),
            "scale": self._scale,
            "elapsed": self._elapsed.copy(),
            "return": self._return.copy(),
            "position": self._position.copy(),
            "violation": self._violation.copy(),
            "complete": self._complete.copy(),
            "obs": self._obs.copy(),
            **({} if self._images is None else {"images": self._images.copy()}),
            "push_left": self._pusher.left.copy(),
            "push_wrench": self._pusher.wrench.copy(),
            "rng": rng_state(self._rng),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._vary(state["scale"])
        self.physics.set_state(state["physics"])
        self.physics.raw_frame[:] = state["frame"]
        self._elapsed[:] = state["elapsed"]
        self._return[:] = state["return"]
        self._position = state["position"].copy()
        self._violation = state["violation"].copy()
        self._complete = state["complete"].copy()
        self._obs = state["obs"].copy()
        if self._images is not None:
            self._images = state["images"].copy()
        self._pusher.left[:] = state["push_left"]
        self._pusher.wrench[:] = state["push_wrench"]
        set_rng_state(self._rng, state["rng"])
        self._seeded = True
