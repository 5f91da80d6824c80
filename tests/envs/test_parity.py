"""The tasks that come from Gymnasium are its v5, number for number. Gymnasium computes control costs in the type of the actions
that it is given, so both sides get float64."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.tasks import MUJOCO
from tutelage.envs.tasks.base import GYMNASIUM

THEIRS = [name for name, task in MUJOCO.items() if task.assets == GYMNASIUM]
ROBOTS, STEPS, TOLERANCE = 3, 120, 1e-9


def put(env: Any, fleet: MujocoFleet, robot: int) -> Any:
    """Bring a Gymnasium environment to the state in which our robot was just reset; returns its observation."""
    data = fleet.physics.datas[robot]
    mujoco.mj_resetData(env.model, env.data)
    env.set_state(data.qpos, data.qvel)
    return env._get_obs()


def on_its_back(env: Any) -> bool:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, env.data.qpos[3:7])
    return bool(rotation[8] <= 0.0)


@pytest.mark.parametrize("name", THEIRS)
def test_a_task_is_gymnasiums_to_the_last_digits(name: str) -> None:
    fleet = MujocoFleet(name, ROBOTS, disturbance="none", threads=1)
    envs = [gym.make(f"{name}-v5").unwrapped for _ in range(ROBOTS)]
    obs, _ = fleet.reset(seed=1)
    for i, env in enumerate(envs):
        env.reset()
        np.testing.assert_allclose(put(env, fleet, i), obs[i], rtol=0, atol=TOLERANCE)

    rng = np.random.default_rng(2)
    falls = 0
    for t in range(STEPS):
        actions = rng.uniform(fleet.action_low, fleet.action_high, (ROBOTS, len(fleet.action_low)))
        obs, reward, terminated, truncated, info = fleet.step(actions)
        for i, env in enumerate(envs):
            theirs, their_reward, their_end, _, _ = env.step(actions[i])
            np.testing.assert_allclose(obs[i], theirs, rtol=0, atol=TOLERANCE, err_msg=f"{name}, step {t}, robot {i}")
            assert reward[i] == pytest.approx(their_reward, rel=0, abs=TOLERANCE)
            if name != "HalfCheetah":  # which Gymnasium never ends
                assert terminated[i] == (their_end or (name == "Ant" and on_its_back(env)))
        assert not truncated.any()
        falls += info["violation"].sum()
        mask = info["violation"] | (np.array([True, False, True]) & (t % 50 == 25))
        if mask.any():
            obs, _ = fleet.reset(options={"reset_mask": mask})
            for i in np.flatnonzero(mask):
                np.testing.assert_allclose(put(envs[i], fleet, i), obs[i], rtol=0, atol=TOLERANCE)
    if name != "HalfCheetah":
        assert falls, "this test should see a fall"
    fleet.close()


@pytest.mark.parametrize("name", THEIRS)
def test_spaces_are_gymnasiums(name: str) -> None:
    fleet, env = MujocoFleet(name, 2, threads=1), gym.make(f"{name}-v5")
    assert fleet.single_action_space == env.action_space
    assert fleet.single_observation_space.shape == env.observation_space.shape
    assert fleet.dt == pytest.approx(env.unwrapped.dt)  # type: ignore[attr-defined]
    assert env.spec is not None
    assert fleet.horizon == env.spec.max_episode_steps
    fleet.close()


@pytest.mark.parametrize("name", THEIRS)
def test_initial_states_are_distributed_as_gymnasiums(name: str) -> None:
    n = 400
    fleet, env = MujocoFleet(name, n, disturbance="none", threads=1), gym.make(f"{name}-v5")
    ours, _ = fleet.reset(seed=0)
    theirs = np.array([env.reset(seed=s)[0] for s in range(n)])
    pose = slice(0, fleet.physics.model.nq + fleet.physics.model.nv - 2)
    spread = theirs[:, pose].std(axis=0) + 1e-12
    assert (np.abs(ours[:, pose].mean(axis=0) - theirs[:, pose].mean(axis=0)) < 6 * spread / np.sqrt(n)).all()
    np.testing.assert_allclose(ours[:, pose].std(axis=0) + 1e-12, spread, rtol=0.25)
    fleet.close()
