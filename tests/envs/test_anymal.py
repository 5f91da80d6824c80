"""Anymal: a model that obeys mechanics and its own symmetry, commands, contacts that count, and a trot that follows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

from tutelage.checks import check_env, check_policy
from tutelage.envs import experts
from tutelage.envs.experts.anymal import CYCLE, Trotter, leg
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.tasks.anymal import ACTION, COMMAND, CONTACT, PERIOD, SCALE, STANDING, STIFFNESS, Anymal, commands
from tutelage.envs.tasks.base import Array

STILL = np.zeros((4, 12), dtype=np.float32)
JOINTS, DIALS = slice(7, 19), slice(19, 22)


@pytest.fixture
def fleet() -> Iterator[MujocoFleet]:
    fleet = MujocoFleet("Anymal", 4, disturbance="none", threads=1)
    fleet.reset(seed=0)
    yield fleet
    fleet.close()


def put(fleet: MujocoFleet, height: float, quaternion: tuple[float, ...] = (1, 0, 0, 0), joints: Array = STANDING) -> None:
    """All robots at rest, with their middle at this height."""
    physics = fleet.physics
    qpos, qvel = np.tile(physics.qpos0, (fleet.num_envs, 1)), np.zeros((fleet.num_envs, physics.model.nv))
    qpos[:, 2], qpos[:, 3:7], qpos[:, JOINTS] = height, quaternion, joints
    physics.restart(np.arange(fleet.num_envs), qpos, qvel)


def test_the_task_has_the_sizes_of_the_benchmark(fleet: MujocoFleet) -> None:
    assert fleet.single_observation_space.shape == (48,)
    assert fleet.single_action_space.shape == (12,)
    assert fleet.horizon * fleet.dt == pytest.approx(50.0)
    assert (fleet.action_low == -1).all()
    assert (fleet.action_high == 1).all()
    robot = fleet.physics.model.body_rootid == fleet.physics.model.body("base").id
    assert fleet.physics.model.body_mass[robot].sum() == pytest.approx(45, abs=1)


@pytest.mark.filterwarnings("ignore:check_env. no robot:UserWarning")
def test_the_fleet_and_its_human_keep_their_contracts(fleet: MujocoFleet) -> None:
    fleet.horizon = 100
    check_env(fleet, steps=250)
    check_policy(Trotter(), fleet)


def test_an_observation_says_what_the_base_sees(fleet: MujocoFleet) -> None:
    half = np.sqrt(0.5)
    physics = fleet.physics
    qpos, qvel = np.tile(physics.qpos0, (4, 1)), np.zeros((4, physics.model.nv))
    qpos[:, 2], qpos[:, JOINTS] = 2.0, STANDING
    qpos[1, 3:7] = half, 0, 0, half  # turned to the left by 90 degrees
    qpos[2, 3:7] = half, half, 0, 0  # rolled onto its right side
    qvel[:, 0], qvel[:, 5], qvel[:, 6] = 1.0, 0.4, 3.0
    physics.restart(np.arange(4), qpos, qvel)
    seen = fleet.task.observe(physics.frame) / SCALE
    np.testing.assert_allclose(seen[:3, :3], [[1, 0, 0], [0, -1, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(seen[:3, 6:9], [[0, 0, -1], [0, 0, -1], [0, -1, 0]], atol=1e-12)
    np.testing.assert_allclose(seen[:, 3:6], [[0, 0, 0.4]] * 4)
    np.testing.assert_allclose(seen[:, 12:24], 0, atol=1e-12)
    np.testing.assert_allclose(seen[:, 24], 3.0)


def test_the_last_actions_are_observed(fleet: MujocoFleet) -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 12)).astype(np.float32)
    obs, *_ = fleet.step(actions)
    np.testing.assert_allclose(obs[:, 36:], actions)


def test_actions_move_position_targets_with_the_stated_stiffness() -> None:
    model = mujoco.MjModel.from_xml_path(str(Anymal().xml_path))
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], STIFFNESS * ACTION)
    np.testing.assert_allclose(model.actuator_biasprm[:, 0], STIFFNESS * STANDING)
    np.testing.assert_allclose(model.actuator_biasprm[:, 1], -STIFFNESS)


# -- mechanics ------------------------------------------------------------------------------------------------------


def test_a_robot_that_does_nothing_stands_and_its_feet_bear_its_weight(fleet: MujocoFleet) -> None:
    for _ in range(250):
        _, _, terminated, _, _ = fleet.step(STILL)
        assert not terminated.any()
    model, data = fleet.physics.model, fleet.physics.datas[0]
    assert data.ncon == 4
    assert (fleet.physics.frame["qpos"][:, 2] > 0.5).all()
    weight = model.body_subtreemass[model.body("base").id] * 9.81
    # The robot is at rest, so what the ground adds to the forces on the base's vertical axis is the weight.
    assert data.qfrc_constraint[2] == pytest.approx(weight, rel=0.01)


def test_a_robot_in_the_air_falls_freely_and_violates_nothing(fleet: MujocoFleet) -> None:
    put(fleet, 3.0)
    for _ in range(10):
        _, _, terminated, _, _ = fleet.step(STILL)
    assert not terminated.any()
    np.testing.assert_allclose(fleet.physics.frame["qvel"][:, 2], -9.81 * 10 * fleet.dt, rtol=0.02)


FOLDED = np.array([0, 2.4, -2.8, 0, -2.4, 2.8] * 2)
KNEELING = np.array([0, 0, -2.4, 0, 0, 2.4] * 2)


@pytest.mark.parametrize(
    ("height", "quaternion", "joints", "touches"),
    [
        (0.088, (1, 0, 0, 0), FOLDED, [0]),  # on its belly
        (0.088, (0, 1, 0, 0), STANDING, [0]),  # on its back
        (0.343, (1, 0, 0, 0), KNEELING, [1, 2, 3, 4]),
    ],
)
def test_what_lies_on_its_base_or_a_knee_has_violated(
    fleet: MujocoFleet, height: float, quaternion: tuple[float, ...], joints: Array, touches: list[int]
) -> None:
    put(fleet, height, quaternion, joints)
    assert np.flatnonzero(fleet.physics.frame["sensordata"][0] > CONTACT).tolist() == touches
    assert fleet.task.violation(fleet.physics.frame).all()


@pytest.mark.parametrize(("height", "quaternion"), [(0.3, (0, 1, 0, 0)), (0.4, (0.5**0.5, -(0.5**0.5), 0, 0))])
def test_a_robot_that_falls_on_its_back_or_its_side_violates(
    fleet: MujocoFleet, height: float, quaternion: tuple[float, ...]
) -> None:
    put(fleet, height, quaternion)
    ended = [fleet.step(STILL)[2].all() for _ in range(25)]
    assert not ended[0]
    assert ended[-1]


LEFT_RIGHT = np.array([6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5])
FRONT_HIND = np.array([3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8])


@pytest.mark.parametrize(
    ("legs", "joint_sign", "mirror"),
    [
        (LEFT_RIGHT, np.array([-1.0, 1, 1] * 4), np.array([1.0, -1, 1])),
        (FRONT_HIND, np.array([1.0, -1, -1] * 4), np.array([-1.0, 1, 1])),
    ],
)
def test_a_mirrored_robot_moves_as_the_mirror_image(
    fleet: MujocoFleet, legs: Array, joint_sign: Array, mirror: Array
) -> None:
    turn = mirror.prod() * mirror  # of vectors along an axis of rotation
    sign = np.concatenate([mirror, turn, mirror, mirror[:2], turn[2:], joint_sign, joint_sign, joint_sign])
    order = np.concatenate([np.arange(12), 12 + legs, 24 + legs, 36 + legs])
    rng, physics = np.random.default_rng(0), fleet.physics
    qpos, qvel = fleet.task.initial(rng, 4, physics.qpos0, physics.qvel0)
    qpos[1, JOINTS] = STANDING + joint_sign * (qpos[0, JOINTS] - STANDING)[legs]
    qvel[1, :3], qvel[1, 3:6], qvel[1, 6:18] = mirror * qvel[0, :3], turn * qvel[0, 3:6], joint_sign * qvel[0, 6:18][legs]
    qpos[1, DIALS], qvel[1, 18:] = sign[9:12] * qpos[0, DIALS], sign[9:12] * qvel[0, 18:]
    physics.restart(np.arange(4), qpos, qvel)
    for _ in range(40):
        actions = STILL.copy()
        actions[0] = rng.uniform(-0.5, 0.5, 12)
        actions[1] = joint_sign * actions[0][legs]
        obs, reward, _, _, _ = fleet.step(actions)
        np.testing.assert_allclose(obs[1], sign * obs[0][order], atol=1e-5)
        assert reward[1] == pytest.approx(reward[0], abs=1e-6)


# -- commands -------------------------------------------------------------------------------------------------------


def test_commands_stay_within_bounds_use_them_evenly_and_change_slowly() -> None:
    fleet = MujocoFleet("Anymal", 64, disturbance="strong", threads=1)  # of robots of many masses
    fleet.reset(seed=3)
    speed = fleet.physics.frame["qvel"][:, 18:].copy()
    before, seen = commands(fleet.physics.frame), []
    for _ in range(100):
        fleet.step(np.zeros((64, 12), dtype=np.float32))
        now = commands(fleet.physics.frame)
        assert (np.abs(now - before) <= COMMAND * 4 / PERIOD[0] * fleet.dt + 1e-9).all()
        before = now
        seen.append(now)
    drawn = np.concatenate(seen) / COMMAND
    assert (np.abs(drawn) <= 1).all()
    assert np.abs(np.abs(drawn).mean() - 0.5) < 0.1
    moving = fleet.physics.unstable == 0
    np.testing.assert_allclose(fleet.physics.frame["qvel"][moving, 18:], speed[moving])
    fleet.close()


def test_following_the_command_is_worth_more_than_standing_still(fleet: MujocoFleet) -> None:
    frame = {name: values.copy() for name, values in fleet.physics.frame.items()}
    for name in ("qacc", "actuator_force"):
        frame[name][:] = 0.0
    frame["qpos"][:, 3:7], frame["qvel"][:] = (1, 0, 0, 0), 0.0
    frame["qpos"][:, DIALS] = np.pi / 2  # the largest command
    actions, speed = np.zeros((4, 12)), np.zeros(4)
    still = fleet.task.reward(frame, speed, actions)
    frame["qvel"][:, [0, 1, 5]] = COMMAND
    np.testing.assert_allclose(fleet.task.reward(frame, speed, actions), 1.5 * fleet.dt)
    assert (still < 0.1 * 1.5 * fleet.dt).all()


# -- the human ------------------------------------------------------------------------------------------------------


def test_the_leg_reaches_where_it_is_told_and_bears_what_it_should() -> None:
    model = mujoco.MjModel.from_xml_path(str(Anymal().xml_path))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.15, 0.15, 4), np.array([1, 1, -1, -1]) * rng.uniform(0.15, 0.3, 4)
    z, load = rng.uniform(-0.55, -0.4, 4), np.full(4, 100.0)
    angles, torques = leg(x, y, z, load)
    data.qpos[JOINTS] = angles.ravel()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    for k, name in enumerate(["LF", "LH", "RF", "RH"]):
        foot = model.geom(f"{name} foot").id
        hip = model.body(f"{name} hip").pos
        axis = [hip[0] + model.body(f"{name} thigh").pos[0] + x[k], hip[1] + y[k], hip[2] + z[k]]
        np.testing.assert_allclose(data.geom_xpos[foot] - data.xpos[1], axis, atol=1e-9)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacGeom(model, data, jacobian, None, foot)
        np.testing.assert_allclose(torques[k], -load[k] * jacobian[2, 6 + 3 * k : 9 + 3 * k], rtol=0.1)


def test_the_trot_follows_its_commands_under_disturbances() -> None:
    fleet = MujocoFleet("Anymal", 8, threads=1)
    obs, _ = fleet.reset(seed=1)
    total: Any = 0.0
    for _ in range(300):
        obs, reward, terminated, _, _ = fleet.step(Trotter().act(obs))
        total += reward
        assert not terminated.any()
    assert (total / (300 * fleet.dt) > 0.8).all()  # of 1.5; a robot that stands gets about 0.5
    fleet.close()


def test_diagonal_legs_step_together_once_in_a_cycle(fleet: MujocoFleet) -> None:
    obs, _ = fleet.reset(seed=0)
    feet = [fleet.physics.model.geom(f"{name} foot").id for name in ("LF", "LH", "RF", "RH")]
    heights = []
    for _ in range(20 * CYCLE):
        obs, *_ = fleet.step(Trotter().act(obs))
        heights.append(fleet.physics.datas[0].geom_xpos[feet, 2].copy())
    up = np.array(heights[CYCLE * 4 :])
    correlation = np.corrcoef(up.T)
    assert correlation[0, 3] > 0.5
    assert correlation[1, 2] > 0.5
    assert correlation[0, 1] < -0.3
    spectrum = np.abs(np.fft.rfft(up[:, 0] - up[:, 0].mean()))
    assert spectrum.argmax() == len(up) // CYCLE


def test_the_human_catches_a_robot_that_another_policy_drove(fleet: MujocoFleet) -> None:
    obs, _ = fleet.reset(seed=2)
    rng = np.random.default_rng(0)
    for _ in range(25):
        obs, _, terminated, _, _ = fleet.step(rng.uniform(-0.4, 0.4, (4, 12)).astype(np.float32))
    assert not terminated.any()
    for _ in range(200):
        obs, _, terminated, _, _ = fleet.step(Trotter().act(obs))
    assert not terminated.any()


def test_the_card_of_the_human_says_that_it_succeeds_at_the_level_of_the_task() -> None:
    _, card = experts.load("Anymal")
    score = card["scores"][Anymal.disturbance]
    assert score["episodes"] == 100
    assert score["success"] > 0.9
    assert card["scores"]["none"]["survived"] > 0.99
