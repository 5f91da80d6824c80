"""BallBalance: a ball that rolls as balls do, a mechanism that tilts as the human believes, and a human who catches every ball."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

from tutelage.checks import check_policy
from tutelage.envs import experts
from tutelage.envs.experts.ball_balance import DT, ROLLING, Balancer, gains
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.tasks import TASKS
from tutelage.envs.tasks.ball_balance import BALL, BEARINGS, HIPS, LOST, RISE, SPEED, SURFACE

KNEES, PLACE, VELOCITY = slice(0, 3), slice(6, 9), slice(9, 12)


@pytest.fixture
def trays() -> Iterator[MujocoFleet]:
    fleet = MujocoFleet("BallBalance", 4, disturbance="none", threads=1)
    fleet.reset(seed=0)
    yield fleet
    fleet.close()


def put(fleet: MujocoFleet, places: Any, velocity: Any = (0.0, 0.0, 0.0)) -> None:
    """Balls at rest, or with one velocity, on trays at rest, at places (4, 2), m."""
    physics = fleet.physics
    qpos, qvel = np.tile(physics.qpos0, (4, 1)), np.tile(physics.qvel0, (4, 1))
    qpos[:, 13:15], qpos[:, 15] = places, SURFACE + BALL
    qvel[:, 12:15] = velocity
    physics.restart(np.arange(4), qpos, qvel)


def slopes(fleet: MujocoFleet) -> Any:
    """How steeply each tray rises along x and y, (4, 2)."""
    normals = np.array([data.body("tray").xmat.reshape(3, 3)[:, 2] for data in fleet.physics.datas])
    return -normals[:, :2] / normals[:, 2:]


def drive(fleet: MujocoFleet, actions: Any, steps: int) -> Any:
    for _ in range(steps):
        result = fleet.step(np.broadcast_to(actions, (4, 3)))
    return result


def test_at_rest_the_ball_lies_still_and_earns_nearly_everything(trays: MujocoFleet) -> None:
    put(trays, np.zeros((4, 2)))
    obs, reward, _, _, info = drive(trays, 0.0, 100)
    assert not info["violation"].any()
    np.testing.assert_allclose(obs[:, PLACE], 0, atol=0.003)
    np.testing.assert_allclose(obs[:, VELOCITY], 0, atol=0.001)
    assert (reward > 0.99).all()
    assert trays.dt == pytest.approx(DT)


@pytest.mark.parametrize("leg", range(3))
def test_the_mechanism_tilts_as_the_human_believes(trays: MujocoFleet, leg: int) -> None:
    put(trays, np.zeros((4, 2)))
    drive(trays, 0.2 * np.eye(3)[leg], 10)
    obs = drive(trays, 0.0, 5)[0]
    heights = RISE * obs[:, KNEES]
    assert heights[:, leg].min() > 0.5 * RISE * SPEED * 0.2 * 10 * DT, "the knee opened"
    around = np.stack([np.cos(BEARINGS), np.sin(BEARINGS)])
    np.testing.assert_allclose(slopes(trays), 2 / (3 * HIPS) * heights @ around.T, atol=0.004)
    lifted = [data.body("tray").xpos[2] - SURFACE + 0.01 for data in trays.physics.datas]
    np.testing.assert_allclose(lifted, heights.mean(axis=1), atol=0.003)


def test_a_ball_on_a_slope_rolls_as_a_solid_ball_does(trays: MujocoFleet) -> None:
    put(trays, np.zeros((4, 2)))
    drive(trays, np.array([0.3, 0.0, -0.3]), 6)  # a slope of about 0.03
    before = drive(trays, 0.0, 4)[0]
    slope = slopes(trays)
    assert np.linalg.norm(slope, axis=1).min() > 0.02
    after = drive(trays, 0.0, 20)[0]
    np.testing.assert_allclose((after - before)[:, VELOCITY][:, :2] / (20 * DT), ROLLING * slope, rtol=0.06, atol=0.005)


def test_feet_stay_where_they_are_and_nothing_gains_energy(trays: MujocoFleet) -> None:
    rng = np.random.default_rng(0)
    model = trays.physics.model
    for _ in range(100):
        trays.step(rng.uniform(-1, 1, (4, 3)))
        for data in trays.physics.datas:
            for leg, bearing in enumerate(BEARINGS):
                lower = data.body(f"lower {leg}")
                foot = lower.xpos + lower.xmat.reshape(3, 3) @ [-0.18, 0, -0.18]
                np.testing.assert_allclose(foot, [HIPS * np.cos(bearing), HIPS * np.sin(bearing), 0], atol=0.01)
    put(trays, np.tile([0.1, 0.0], (4, 1)), (0.3, 0.2, 0.0))
    data, energies = trays.physics.datas[0], []
    for _ in range(40):
        trays.step(np.zeros((4, 3)))
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        energies.append(data.energy.sum())
    assert np.diff(energies).max() < 0.01, "J, of about 17"


def test_observations_are_what_the_task_says(trays: MujocoFleet) -> None:
    obs = drive(trays, np.array([0.5, -0.2, 0.1]), 15)[0]
    assert obs.shape == (4, 24)
    for data, row in zip(trays.physics.datas, obs, strict=True):
        np.testing.assert_allclose(row[KNEES], [data.joint(f"knee {i}").qpos[0] for i in range(3)])
        np.testing.assert_allclose(row[3:6], [data.joint(f"knee {i}").qvel[0] for i in range(3)])
        np.testing.assert_allclose(row[PLACE], data.joint("ball").qpos[:3] - [0, 0, SURFACE + BALL])
        np.testing.assert_allclose(row[VELOCITY], data.joint("ball").qvel[:3])
    put(trays, np.array([[0.3, 0], [-0.15, 0.26], [-0.15, -0.26], [0, 0]]))
    loads = drive(trays, 0.0, 3)[0][:, 12:15]
    assert (np.abs(loads[:3]).argmax(axis=1) == np.arange(3)).all(), "the leg below the ball bears most"


def test_a_ball_that_falls_off_is_a_violation(trays: MujocoFleet) -> None:
    put(trays, np.array([[0.0, 0.0], [0.45, 0.0], [0.0, 0.2], [0.0, -0.45]]), (0.0, 0.0, 0.0))
    for data in (trays.physics.datas[1], trays.physics.datas[3]):
        data.qvel[12:14] = 2.0 * data.qpos[13:15] / 0.45
    _, _, _, _, info = drive(trays, 0.0, 40)
    assert info["violation"].tolist() == [False, True, False, True]
    assert (trays._obs[[1, 3], 8] < LOST - SURFACE - BALL).all()


def test_the_reward_falls_with_distance_and_speed(trays: MujocoFleet) -> None:
    put(trays, np.array([[0.0, 0.0], [0.1, 0.0], [0.3, 0.0], [0.0, 0.3]]))
    obs, reward, *_ = trays.step(np.zeros((4, 3)))
    expected = 1 / ((1 + np.linalg.norm(obs[:, PLACE], axis=1)) * (1 + np.linalg.norm(obs[:, VELOCITY], axis=1)))
    np.testing.assert_allclose(reward, expected)
    assert (np.diff(reward[:3]) < 0).all()


def test_the_regulator_is_stable_and_optimal() -> None:
    a = np.array([[1, DT, ROLLING * DT**2 / 2], [0, 1, ROLLING * DT], [0, 0, 1]])
    b = np.array([[ROLLING * DT**3 / 6], [ROLLING * DT**2 / 2], [DT]])
    assert np.abs(np.linalg.eigvals(a - b @ gains()[None])).max() < 0.99

    def cost(gain: Any) -> float:
        from tutelage.envs.experts.ball_balance import COST, EFFORT

        state, total = np.array([0.3, -0.2, 0.05]), 0.0
        for _ in range(2000):
            effort = -gain @ state
            total += state @ COST @ state + EFFORT * effort**2
            state = a @ state + b[:, 0] * effort
        return float(total)

    best = cost(gains())
    for k in range(3):
        for scale in (0.97, 1.03):
            assert cost(gains() * np.where(np.arange(3) == k, scale, 1)) > best


def test_the_human_catches_the_balls_and_keeps_them_in_the_middle() -> None:
    fleet = MujocoFleet("BallBalance", 12, disturbance="none", threads=1)
    obs, _ = fleet.reset(seed=3)
    assert (obs[:, 8] > 0.04).all(), "balls begin in the air"
    human = Balancer()
    for _ in range(250):
        obs, reward, _, _, info = fleet.step(human.act(obs))
    assert not info["violation"].any()
    assert (np.linalg.norm(obs[:, PLACE], axis=1) < 0.02).all()
    assert (reward > 0.95).all()
    fleet.close()


def test_the_human_can_take_over_a_ball_that_others_let_roll(trays: MujocoFleet) -> None:
    human = Balancer()
    obs = trays.reset(seed=1)[0]
    rng = np.random.default_rng(0)
    for _ in range(25):
        obs = trays.step(0.5 * rng.uniform(-1, 1, (4, 3)))[0]
    for _ in range(300):
        obs, _, _, _, info = trays.step(human.act(obs))
    caught = ~info["violation"]
    assert caught.sum() >= 3
    assert (np.linalg.norm(obs[caught][:, PLACE], axis=1) < 0.02).all()


def test_the_task_names_its_human_and_what_it_scores(trays: MujocoFleet) -> None:
    actor, card = experts.load("BallBalance")
    assert isinstance(actor, Balancer)
    check_policy(actor, trays)
    level = TASKS["BallBalance"].disturbance
    assert card["scores"][level]["success"] > 0.9
    assert card["scores"]["none"]["mean"] > 450
    assert experts.success_return("BallBalance", level) == pytest.approx(0.95 * card["scores"][level]["mean"])
