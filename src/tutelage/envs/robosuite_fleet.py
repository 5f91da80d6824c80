"""Peg insertion as the dissertation ran it: robosuite's NutAssemblyRound with a UR5e (section 3.5, appendix B.3).

One robosuite environment serves all robots: each has a state of its own, which is put into the simulator for its turn. So
N robots need the memory of one (about 200 MB), and what is saved in a checkpoint is what every turn begins with.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tutelage.envs.adapter import AdaptedFleet, Backend, Outcome
from tutelage.envs.experts.nut_assembly import TABLE_HEIGHT
from tutelage.errors import ConfigError, MissingExtraError
from tutelage.fleet.fleet import Mask
from tutelage.seeding import derive

Array = NDArray[Any]


@contextmanager
def _quietly() -> Iterator[None]:
    """robosuite warns of what it lacks for other robots, and decides for the whole process how pictures are drawn."""
    chosen, silent = os.environ.get("MUJOCO_GL"), logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(silent)
        os.environ.pop("MUJOCO_GL", None)
        if chosen is not None:
            os.environ["MUJOCO_GL"] = chosen


try:
    with _quietly():
        import mujoco
        import robosuite
        from robosuite.controllers import load_composite_controller_config
except ImportError as error:
    raise MissingExtraError(error.name or "robosuite", "robosuite") from error

TABLE_HALF = 0.4  # m
"""Half the length of the table's sides around the origin."""
FREQUENCY = 20
"""Of robosuite's controller, Hz."""
OBSERVED = (
    "RoundNut_pos", "RoundNut_quat", "RoundNut_to_robot0_eef_pos", "RoundNut_to_robot0_eef_quat",
    "robot0_joint_pos_cos", "robot0_joint_pos_sin", "robot0_joint_vel",
    "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos", "robot0_gripper_qvel",
)  # fmt: skip
"""robosuite's names of what is observed, in this order: 51 numbers."""
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class NutAssemblyRound(AdaptedFleet):
    """N UR5e arms that put a round nut over a peg; see `Fleet` for the contract.

    Observations: position (3, m) and quaternion (4, x y z w) of the nut, both likewise as the gripper sees them, cosine (6),
    sine (6) and velocity (6, rad/s) of the arm's joints, position (3, m) and quaternion (4) of the gripper, angles (6, rad)
    and velocities (6, rad/s) of its joints.

    Actions: the wished step along x, y and z and the turn around z, each as a fraction of what robosuite's controller takes
    (5 cm, 0.5 rad; in the twentieth of a second that it is given, the arm gets about 1.2 cm and 0.1 rad far), and above 0
    "shut", else "open". robosuite executes it in one step of its controller (operational space control with fixed impedance,
    20 Hz); in the rest of the decision the arm holds still and the fingers go on.

    Goal: robosuite's own. The nut is within 3 cm of the peg along x and y, lower than 5 cm above the table, and more than
    4.2 cm from the grip. Violation: the nut is no longer over the table, which robosuite knows nothing of.

    Args:
        num_envs: N robots. They take turns in the thread that calls `step_wait`.
        control_steps: steps of robosuite's controller in a decision, and before the first one of an episode.
        horizon: decisions of an episode.
    """

    expert: ClassVar[str] = "tutelage.envs.experts.nut_assembly:NutInserter"
    offline_pairs: ClassVar[int] = 2687
    goal_conditioned = True

    def __init__(self, num_envs: int, *, control_steps: int = 10, horizon: int = 175) -> None:
        if num_envs < 1:
            raise ConfigError(f"a fleet needs at least one robot, got {num_envs}")
        if control_steps < 1:
            raise ConfigError(f"a decision needs at least one step of the controller, got {control_steps}")
        super().__init__(_Robosuite(num_envs, control_steps, horizon), _off_the_table, lambda o: o.info["placed"])
        self.render_mode = "rgb_array"


def _off_the_table(outcome: Outcome) -> Array:
    x, y, z = outcome.obs[:, :3].T
    return (z < TABLE_HEIGHT - 0.02) | (np.maximum(np.abs(x), np.abs(y)) > TABLE_HALF)  # type: ignore[no-any-return]


class _Robosuite(Backend):
    """One environment of robosuite, and the states of N robots."""

    can_checkpoint = True

    def __init__(self, num_envs: int, control_steps: int, horizon: int) -> None:
        self.num_envs, self.horizon, self._steps = num_envs, horizon, control_steps
        with _quietly():
            self._env: Any = robosuite.make(
                "NutAssemblyRound",
                robots="UR5e",
                controller_configs=load_composite_controller_config(controller=None, robot="UR5e"),
                control_freq=FREQUENCY,
                has_renderer=False,
                has_offscreen_renderer=False,
                use_camera_obs=False,
                ignore_done=True,
                hard_reset=False,
                seed=0,
            )
        self._model, self._data = self._env.sim.model._model, self._env.sim.data._data
        # From 3.8 on MuJoCo finds several contacts between two meshes. The gripper's links then jam against one another,
        # and its fingers never shut; robosuite's model was made for one.
        self._model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
        self._arm, self._gripper = self._env.robots[0].arms[0], self._env.robots[0].gripper["right"]
        self.obs_space = gym.spaces.Box(-np.inf, np.inf, self._observe().shape, dtype=np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (5,), dtype=np.float32)
        # What robosuite carries from one step of its controller to the next, by robot: the physics, the posture to which the
        # arm's spare freedom is drawn, and the command of the fingers. The seeds are those of the resets.
        self._physics = np.zeros((num_envs, mujoco.mj_stateSize(self._model, _STATE)))
        self._posture = np.zeros((num_envs, len(self._controller.initial_joint)))
        self._fingers = np.zeros((num_envs, len(self._gripper.actuators)))
        self._seeds, self._episodes = np.zeros(num_envs, dtype=np.int64), np.zeros(num_envs, dtype=np.int64)
        self._seeded = False
        self._wanted: tuple[Array, Mask] | None = None
        self._renderer: Any = None

    @property
    def _controller(self) -> Any:
        """robosuite makes a new one in each reset."""
        return self._env.robots[0].part_controllers[self._arm]

    def reset(self, robots: Mask, seed: int | None) -> Array:
        if seed is not None or not self._seeded:
            root = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
            for robot in np.flatnonzero(robots):
                self._seeds[robot], self._episodes[robot] = derive(root, f"robosuite/{robot}"), 0
            self._seeded = True
        obs = self._rows()
        for robot in np.flatnonzero(robots):
            fresh = np.random.PCG64(derive(int(self._seeds[robot]), f"episode {self._episodes[robot]}"))
            self._env.rng.bit_generator.state = fresh.state
            self._episodes[robot] += 1
            with _quietly():
                self._env.reset()
            self._hold(-1.0, self._steps)  # the nut falls on the table, and the fingers open
            obs[robot] = self._observe()
            self._leave(robot)
        return obs

    def start(self, actions: Array, robots: Mask) -> None:
        self._wanted = np.array(actions, dtype=np.float64), robots.copy()

    def finish(self) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        assert self._wanted is not None
        actions, robots = self._wanted
        obs, placed, never = self._rows(), np.zeros(self.num_envs, dtype=bool), np.zeros(self.num_envs, dtype=bool)
        for robot in np.flatnonzero(robots):
            self._enter(robot)
            x, y, z, turn, fingers = actions[robot]
            self._env.step(np.array([x, y, z, 0.0, 0.0, turn, fingers]))
            self._hold(fingers, self._steps - 1)
            obs[robot], placed[robot] = self._observe(), bool(self._env._check_success())
            self._leave(robot)
        return obs, placed.astype(np.float64), never, never, {"placed": placed}

    def _hold(self, fingers: float, steps: int) -> None:
        """Steps of the controller in which the arm wishes to stay where it is."""
        for _ in range(steps):
            self._env.step(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, fingers]))

    def _rows(self) -> Array:
        return np.zeros((self.num_envs, *(self.obs_space.shape or ())))

    def _observe(self) -> Array:
        """(51,) of the robot whose turn it is."""
        self._env._update_observables(force=True)  # once more: what the gripper sees of the nut comes from where it was last
        seen = self._env._get_observations(force_update=True)
        return np.concatenate([seen[name] for name in OBSERVED])

    def _enter(self, robot: int | np.intp) -> None:
        mujoco.mj_setState(self._model, self._data, self._physics[robot], _STATE)
        self._controller.initial_joint = self._posture[robot].copy()
        self._gripper.current_action = self._fingers[robot].copy()
        for controller in self._env.robots[0].part_controllers.values():
            controller.new_update = True  # what it noted of the robot before is another robot's

    def _leave(self, robot: int | np.intp) -> None:
        mujoco.mj_getState(self._model, self._data, self._physics[robot], _STATE)
        self._posture[robot], self._fingers[robot] = self._controller.initial_joint, self._gripper.current_action

    def picture(self, robot: int) -> Array:
        from tutelage.envs.rendering import Renderer

        if self._renderer is None:
            self._renderer = Renderer(self._model, 320, 240, camera="agentview")
        self._enter(robot)
        mujoco.mj_forward(self._model, self._data)
        picture: Array = self._renderer.picture(self._data)
        return picture

    def state_dict(self) -> dict[str, Any]:
        return {
            "physics": self._physics.copy(),
            "posture": self._posture.copy(),
            "fingers": self._fingers.copy(),
            "seeds": self._seeds.copy(),
            "episodes": self._episodes.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, own in self.state_dict().items():
            getattr(self, f"_{name}")[...] = state[name].reshape(own.shape)
        self._seeded = True

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self._env.close()
