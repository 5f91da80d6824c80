"""Peg insertion: real contacts, a goal that ends the episode, and a human who can take over in any state."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

from tutelage.checks import check_policy
from tutelage.envs import experts
from tutelage.envs.experts.peg_insertion import PegInserter
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.tasks import TASKS, GoalTask, arm
from tutelage.envs.tasks.peg_insertion import OPEN, PEG, PEG_HEIGHT, STEP, TABLE, TWIST
from tutelage.errors import ConfigError, TutelageError
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import ExpertConfig, RunConfig
from tutelage.experiments.prepare import demonstrations
from tutelage.experiments.train_expert import train

GRIP, HEADING, FINGER, RING, HANDLE, AXIS = slice(18, 21), slice(21, 23), 23, slice(25, 28), slice(28, 31), slice(31, 34)


@pytest.fixture
def arms() -> Iterator[MujocoFleet]:
    fleet = MujocoFleet("PegInsertion", 4, disturbance="none", threads=1)
    fleet.reset(seed=0)
    yield fleet
    fleet.close()


def work(fleet: MujocoFleet, obs: Any, steps: int, until: Any = lambda obs: False) -> tuple[Any, Any, int]:
    """The human works until all have succeeded or violated, or until something holds for all: obs, succeeded, timesteps."""
    human, complete = PegInserter(), np.zeros(fleet.num_envs, dtype=bool)
    for t in range(steps):
        obs, _, _, _, info = fleet.step(human.act(obs))
        complete |= info["success"]
        if (complete | info["violation"]).all() or np.all(until(obs)):
            return obs, complete, t + 1
    return obs, complete, steps


def place(fleet: MujocoFleet, robot: int, position: Any, turn: Any = (1, 0, 0, 0)) -> None:
    """Put a robot's ring somewhere, at rest."""
    data = fleet.physics.datas[robot]
    data.qpos[8:15] = [*position, *turn]
    data.qvel[8:14] = 0.0


def settle(fleet: MujocoFleet, steps: int = 3) -> Any:
    """Let go of everything and wait: the last step's result."""
    for _ in range(steps):
        result = fleet.step(np.tile([0, 0, 0, 0, -1.0], (fleet.num_envs, 1)))
    return result


# -- the arm --------------------------------------------------------------------------------------------------------


def test_the_arm_reaches_every_point_above_the_table(arms: MujocoFleet) -> None:
    rng, data = np.random.default_rng(0), mujoco.MjData(arms.physics.model)
    low, high = [*TABLE[0], arm.LOW[2]], [*TABLE[1], arm.HIGH[2]]
    corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T
    points = np.concatenate([rng.uniform(low, high, (200, 3)), corners])
    yaws = rng.uniform(-arm.TURN, arm.TURN, len(points))
    limits = arms.physics.model.jnt_range[: arm.JOINTS]
    for point, yaw, joints in zip(points, yaws, arm.joints(points, yaws), strict=True):
        assert ((joints > limits[:, 0]) & (joints < limits[:, 1])).all()
        data.qpos[: arm.JOINTS] = joints
        mujoco.mj_kinematics(arms.physics.model, data)
        hand = data.site_xmat[0].reshape(3, 3)
        np.testing.assert_allclose(data.site_xpos[0], point, atol=1e-6)
        np.testing.assert_allclose(hand[:, 2], [0, 0, 1], atol=1e-6)
        np.testing.assert_allclose(hand[:2, 0], [np.cos(yaw), np.sin(yaw)], atol=1e-6)


@pytest.mark.parametrize("axis", range(4))
def test_an_action_moves_the_gripper_by_a_step(arms: MujocoFleet, axis: int) -> None:
    before = settle(arms)[0]
    action = np.zeros((4, 5))
    action[:, axis] = 1.0
    after = arms.step(action)[0]
    moved = np.zeros((4, 4))
    moved[:, :3] = (after - before)[:, GRIP]
    yaw = np.arctan2(after[:, HEADING][:, 1], after[:, HEADING][:, 0]) - np.arctan2(before[:, 22], before[:, 21])
    moved[:, 3] = yaw
    expected = np.array([STEP, STEP, STEP, TWIST]) * (np.arange(4) == axis)
    np.testing.assert_allclose(moved, np.tile(expected, (4, 1)), atol=0.0015)


def test_the_gripper_stays_in_its_box_and_does_not_wind_up_at_its_border(arms: MujocoFleet) -> None:
    for _ in range(40):
        obs = arms.step(np.tile([0, 0, -1.0, 0, -1], (4, 1)))[0]
    assert (obs[:, GRIP][:, 2] > 0.005).all()
    low = obs[:, GRIP][:, 2].copy()
    up = arms.step(np.tile([0, 0, 1.0, 0, -1], (4, 1)))[0][:, GRIP][:, 2]
    np.testing.assert_allclose(up - low, STEP, atol=0.002)


# -- observations and states ----------------------------------------------------------------------------------------


def test_observations_are_what_the_task_says(arms: MujocoFleet) -> None:
    obs, _, _ = work(arms, arms.reset(seed=1)[0], 30)
    for data, row in zip(arms.physics.datas, obs, strict=True):
        mujoco.mj_forward(arms.physics.model, data)  # sites lag by one physics step
        ring = data.body("ring")
        matrix, hand = ring.xmat.reshape(3, 3), data.site_xmat[0].reshape(3, 3)
        close = {"atol": 1e-3}
        np.testing.assert_allclose(row[:12], [*np.sin(data.qpos[:6]), *np.cos(data.qpos[:6])], **close)
        np.testing.assert_allclose(row[12:18], data.qvel[:6])
        np.testing.assert_allclose(row[GRIP], data.site_xpos[0], **close)
        np.testing.assert_allclose(row[HEADING], hand[:2, 0], **close)
        assert row[FINGER] == pytest.approx(data.qpos[6:8].mean())
        np.testing.assert_allclose(row[RING], ring.xpos)
        np.testing.assert_allclose(row[HANDLE], matrix[:, 0], **close)
        np.testing.assert_allclose(row[AXIS], matrix[:, 2], **close)
        np.testing.assert_allclose(row[34:37], hand.T @ (ring.xpos - data.site_xpos[0]), **close)
        np.testing.assert_allclose(row[37:40], hand.T @ matrix[:, 0], **close)
        assert row[40] == pytest.approx(ring.xpos[2] - PEG_HEIGHT)


def test_the_ring_starts_in_robosuites_ranges_turned_any_way() -> None:
    fleet = MujocoFleet("PegInsertion", 300, disturbance="none", threads=1)
    obs, info = fleet.reset(seed=0)
    x, y, z = obs[:, RING].T
    turn = np.arctan2(obs[:, HANDLE][:, 1], obs[:, HANDLE][:, 0])
    assert not info["violation"].any()
    assert x.min() > -0.1151
    assert x.max() < -0.1099
    assert (-0.226 < y.min() < -0.22) & (-0.115 < y.max() < -0.109)
    assert np.ptp(z) == 0
    assert np.histogram(turn, bins=6, range=(-np.pi, np.pi))[0].min() > 25
    assert 0.01 < np.arcsin(obs[:, :6]).std(axis=0).mean() < 0.03, "joints start a little off"
    fleet.close()


def test_a_ring_that_leaves_the_table_is_a_violation(arms: MujocoFleet) -> None:
    for robot, position in enumerate([(0.2, 0.28, 0.01), (0.4, 0.0, 0.1), (0.0, -0.4, 0.05), (0.0, 0.0, 0.01)]):
        place(arms, robot, position)
    _, _, terminated, truncated, info = settle(arms)
    assert info["violation"].tolist() == [False, True, True, False]
    assert terminated.tolist() == info["violation"].tolist()
    assert not truncated.any()
    corners = np.array([[0.0, 0.0, 0.0], [*TABLE[1], 0.1]])
    frame = {"qpos": np.zeros((2, 15))}
    frame["qpos"][:, 8:11] = corners
    assert TASKS["PegInsertion"]().violation(frame).tolist() == [False, True]


# -- success --------------------------------------------------------------------------------------------------------


def test_the_goal_is_a_ring_around_the_peg_low_flat_and_let_go(arms: MujocoFleet) -> None:
    task = arms.task
    assert isinstance(task, GoalTask)
    good = np.zeros(15)
    good[6:8], good[8:11], good[11:15] = OPEN, [*PEG, 0.03], [1, 0, 0, 0]
    beside, high, gripped, upright, flipped = (good.copy() for _ in range(5))
    beside[8] += 0.03
    high[10] = 0.06
    gripped[6:8] = 0.01
    upright[11:15] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    flipped[11:15] = [0, 1, 0, 0]
    states = np.stack([good, beside, high, gripped, upright, flipped])
    assert task.success({"qpos": states}).tolist() == [True, False, False, False, False, True]


def test_success_ends_the_episode_and_the_robot_stands_still_until_it_is_reset(arms: MujocoFleet) -> None:
    assert arms.goal_conditioned
    place(arms, 1, [*PEG, 0.015])
    obs, reward, terminated, truncated, info = settle(arms, 1)
    assert info["success"].tolist() == [False, True, False, False]
    assert reward.tolist() == [0, 1, 0, 0]
    assert not (terminated | truncated).any()
    actions = np.tile([1.0, 0, 0, 0, -1], (4, 1))
    actions[1] = np.nan
    after, reward, _, truncated, info = arms.step(actions)
    assert np.array_equal(obs[1], after[1])
    assert not np.array_equal(obs[0], after[0])
    assert not info["success"].any(), "a task is completed once"
    assert (reward == 0).all()
    other = MujocoFleet("PegInsertion", 4, disturbance="none", threads=1)
    other.load_state_dict(arms.state_dict())
    actions[1] = 1.0
    assert np.array_equal(other.step(actions)[0], arms.step(actions)[0]), "also in a new fleet"
    other.close()
    arms.reset(options={"reset_mask": np.array([False, True, False, False])})
    moved = [arms.step(actions)[0] for _ in range(2)]
    assert not np.array_equal(moved[0][1], moved[1][1])


def test_whoever_does_nothing_times_out_and_never_succeeds() -> None:
    fleet = MujocoFleet("PegInsertion", 2, disturbance="severe", threads=1)
    fleet.reset(seed=0)
    ends = []
    for _ in range(fleet.horizon):
        _, _, _, truncated, info = fleet.step(np.zeros((2, 5)))
        ends.append(truncated)
        assert not info["success"].any()
    assert np.array(ends).sum(axis=0).tolist() == [1, 1]
    assert ends[-1].all()
    fleet.close()


def test_nothing_is_lifted_without_closing_the_fingers(arms: MujocoFleet) -> None:
    human, obs = PegInserter(), arms.reset(seed=0)[0]
    for _ in range(60):
        action = human.act(obs)
        action[:, 4] = -1.0
        obs, _, _, _, info = arms.step(action)
    assert not info["success"].any()
    assert (np.abs(obs[:, RING][:, 2] - 0.01) < 0.004).all(), "the ring lies on the table"


def test_a_ring_that_is_carried_hangs_from_the_fingers_and_falls_when_they_open(arms: MujocoFleet) -> None:
    obs, _, _ = work(arms, arms.reset(seed=0)[0], 90, until=lambda obs: obs[:, RING][:, 2] > 0.06)
    high = obs[:, RING][:, 2] > 0.05
    assert high.sum() >= 3
    assert ((obs[:, FINGER] > 0.007) & (obs[:, FINGER] < 0.012))[high].all(), "the handle is between the fingers"
    obs = settle(arms)[0]
    assert (obs[:, RING][:, 2] < 0.02).all()


def test_the_peg_is_solid(arms: MujocoFleet) -> None:
    for robot in range(4):
        place(arms, robot, [PEG[0] + 0.04, PEG[1], PEG_HEIGHT + 0.03])  # its tube is over the peg, its hole is not
    _, _, _, _, info = settle(arms, 4)
    assert not info["success"].any()


# -- the human ------------------------------------------------------------------------------------------------------


def test_the_human_succeeds_at_the_tasks_level() -> None:
    fleet = MujocoFleet("PegInsertion", 8, threads=1)
    assert fleet.disturbance.noise > 0
    _, complete, steps = work(fleet, fleet.reset(seed=11)[0], fleet.horizon)
    assert complete.all()
    assert 60 < steps < 140, "about as long as the demonstrations of the dissertation"
    fleet.close()


def test_the_human_recovers_whatever_happened() -> None:
    """Let go high over the peg or on the way, shut too early, dragged about, a ring upside down, a ring beside the peg."""
    fleet = MujocoFleet("PegInsertion", 6, disturbance="none", threads=1)
    fleet.horizon = 400
    obs, _ = fleet.reset(seed=5)
    place(fleet, 4, [0.0, 0.1, 0.03], (0, 1, 0, 0))
    place(fleet, 5, [PEG[0] - 0.084, PEG[1] - 0.009, 0.01], (0.972, 0, 0, -0.234))  # open fingers do not fit there
    human, rng, early = PegInserter(), np.random.default_rng(0), np.zeros(6, dtype=bool)
    for t in range(72):
        action = human.act(obs)
        if t >= 64:
            action[0] = [0, 0, 0, 0, -1]
        if 45 <= t < 50:
            action[1] = [0, 0, 0, 0, -1]
        if t < 12:
            action[2] = [0, 0, -1, 0, 1]
        if 40 <= t < 55:
            action[3] = [*rng.uniform(-1, 1, 4), 1]
        obs, _, _, _, info = fleet.step(action)
        early |= info["success"]
    _, complete, _ = work(fleet, obs, 230)
    assert (early | complete).all()
    assert not early[[0, 1, 2, 3]].any(), "they had to recover"
    fleet.close()


def test_the_human_looks_at_each_row_alone(arms: MujocoFleet) -> None:
    check_policy(PegInserter(), arms)


def test_a_task_names_its_human() -> None:
    actor, card = experts.load("PegInsertion")
    assert isinstance(actor, PegInserter)
    assert card["scores"][TASKS["PegInsertion"].disturbance]["success"] > 0.95
    assert card["scores"]["none"]["episodes"] >= 100
    score = experts.evaluate(actor, "PegInsertion", "none", episodes=2, threads=1)
    assert (score.success, score.mean, score.survived) == (1.0, 1.0, 1.0)
    with pytest.raises(ConfigError, match=r"cannot|unknown|no module"):
        experts.run_program("no_such_module:Human")


# -- pictures -------------------------------------------------------------------------------------------------------


@pytest.mark.render
def test_the_picture_shows_arm_ring_and_peg(arms: MujocoFleet) -> None:
    try:
        picture = arms.render_robot(0, 160, 120).astype(int)
    except TutelageError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))
    red, green, blue = picture[..., 0], picture[..., 1], picture[..., 2]
    assert ((red > blue + 60) & (red > green + 30)).sum() > 20, "the ring"
    assert ((green > red + 25) & (green > blue + 10)).sum() > 20, "the peg"
    assert (blue > red + 60).sum() > 100, "the arm's joints"


# -- runs -----------------------------------------------------------------------------------------------------------


def test_a_demonstration_ends_with_its_success_and_the_next_one_begins_anew() -> None:
    config = RunConfig("PegInsertion", disturbance="none", offline_pairs=450, threads=1)
    actor = PegInserter()
    obs, actions = demonstrations(config, actor, 175)[:2]
    assert obs.shape == (450, 41)
    np.testing.assert_allclose(actions, actor.act(obs), atol=1e-3)
    jumps = np.linalg.norm(np.diff(obs[:, GRIP], axis=0), axis=1) > 2 * STEP  # from the peg back to the start
    ends = np.flatnonzero(jumps)
    assert 4 <= len(ends) <= 6
    lengths = np.diff([-1, *ends])
    assert (lengths > 60).all()
    assert (lengths < 120).all()
    assert (obs[ends][:, RING][:, 2] < 0.05).all(), "around the peg, about to be let go"
    assert (np.linalg.norm(obs[ends][:, RING][:, :2] - PEG, axis=1) < 0.015).all()
    assert (actions[ends, 4] < 0).all()


class Idle:
    """A human who does nothing."""

    def act(self, obs: Any) -> Any:
        return np.zeros((len(obs), 5), dtype=np.float32)


def test_a_human_who_does_not_reach_the_goal_cannot_demonstrate() -> None:
    config = RunConfig("PegInsertion", disturbance="none", offline_pairs=10, threads=1)
    with pytest.raises(ConfigError, match="the expert did not reach the goal in 3 of 3 demonstrations"):
        demonstrations(config, Idle(), 175)


def test_the_run_of_a_goal_task_needs_no_return_and_its_human_is_not_trained() -> None:
    assembly = assemble(RunConfig("PegInsertion", priority="U.G.C.", robots=2, humans=1, threads=1, torch_threads=1))
    assert isinstance(assembly.actor, PegInserter)
    assert (assembly.config.offline_pairs, assembly.config.disturbance) == (2687, TASKS["PegInsertion"].disturbance)
    assert list(assembly.learner.critics) == ["goal"]
    assembly.fleet.close()
    with pytest.raises(ConfigError, match="is a program, .*PegInserter: nothing to train"):
        train(ExpertConfig("PegInsertion"))
