"""Cube stacking: the arm's published kinematics, Cartesian control of a fleet, real grasps, and four humans who grip differently."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

from tutelage.checks import check_policy
from tutelage.envs import experts
from tutelage.envs.experts.franka_cube_stack import Stacker, team
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.tasks import TASKS, GoalTask, panda
from tutelage.envs.tasks.franka_cube_stack import AWAY, HALF_A, HALF_B, HIGH, LOW, OPEN, STEP, TABLE, TWIST
from tutelage.policies.kinds import kinds_of

CUBE, WAY, GRIP, HEADING, FINGERS = slice(4, 7), slice(7, 10), slice(10, 13), slice(13, 17), slice(17, 19)
HANDS_OFF = np.array([0, 0, 0, 0, 0, 0, -1.0])


@pytest.fixture
def arms() -> Iterator[MujocoFleet]:
    fleet = MujocoFleet("FrankaCubeStack", 4, disturbance="none", threads=1)
    fleet.reset(seed=0)
    yield fleet
    fleet.close()


def put(fleet: MujocoFleet, robot: int, cube: str, place: Any, turn: Any = (1, 0, 0, 0)) -> None:
    """Put a cube somewhere, at rest."""
    data = fleet.physics.datas[robot]
    joint = data.joint(f"cube {cube}")
    joint.qpos[:] = [*place, *turn]
    joint.qvel[:] = 0.0


def drive(fleet: MujocoFleet, actions: Any, steps: int) -> Any:
    for _ in range(steps):
        result = fleet.step(np.broadcast_to(actions, (fleet.num_envs, 7)))
    return result


def work(fleet: MujocoFleet, human: Any, obs: Any, steps: int) -> tuple[Any, Any, int]:
    """The human works until all have succeeded or violated: obs, succeeded, timesteps."""
    complete = np.zeros(fleet.num_envs, dtype=bool)
    for t in range(steps):
        obs, _, _, _, info = fleet.step(human.act(obs))
        complete |= info["success"]
        if (complete | info["violation"]).all():
            return obs, complete, t + 1
    return obs, complete, steps


def yaw_of(obs: Any) -> Any:
    return 2 * np.arctan2(obs[:, HEADING][:, 2], obs[:, HEADING][:, 1])


# -- the arm --------------------------------------------------------------------------------------------------------


def test_the_arm_has_the_published_kinematics(arms: MujocoFleet) -> None:
    """Modified Denavit-Hartenberg parameters of the Panda, chained."""
    right = np.pi / 2
    parameters = [(0, 0, 0.333), (0, -right, 0), (0, right, 0.316), (0.0825, right, 0), (-0.0825, -right, 0.384),
                  (0, right, 0), (0.088, right, 0), (0, 0, 0.107 + 0.1034)]  # fmt: skip
    rng, data = np.random.default_rng(0), mujoco.MjData(arms.physics.model)
    limits = arms.physics.model.jnt_range[:7]
    np.testing.assert_allclose(limits.T, panda.RANGE)
    for joints in rng.uniform(*limits.T, (50, 7)):
        hand = np.eye(4)
        for (a, twist, d), angle in zip(parameters, [*joints, 0.0], strict=True):
            ct, st, ca, sa = np.cos(angle), np.sin(angle), np.cos(twist), np.sin(twist)
            link = [[ct, -st, 0, a], [st * ca, ct * ca, -sa, -sa * d], [st * sa, ct * sa, ca, ca * d], [0, 0, 0, 1]]
            hand = hand @ np.array(link)
        data.qpos[:7] = joints
        mujoco.mj_kinematics(arms.physics.model, data)
        np.testing.assert_allclose(data.site_xpos[0], hand[:3, 3], atol=1e-5)
        np.testing.assert_allclose(data.site_xmat[0].reshape(3, 3), hand[:3, :3], atol=1e-4)


def test_joint_changes_are_those_of_the_jacobian_and_each_arm_is_on_its_own(arms: MujocoFleet) -> None:
    drive(arms, np.array([0.3, 0.5, -0.2, 0.1, 0.1, 0.4, -1]), 10)
    frame = arms.physics.frame
    given = [frame["qpos"][:, :7], frame["site_xpos"][:, 0], frame["xanchor"][:, :7], frame["xaxis"][:, :7]]
    move = np.random.default_rng(0).uniform(-1, 1, (4, 6)) * [*[STEP] * 3, *[TWIST] * 3]
    change = panda.turn(*given, move)
    model = arms.physics.model
    for i, data in enumerate(arms.physics.datas):
        mujoco.mj_forward(model, data)
        jacobian = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], 0)
        np.testing.assert_allclose(jacobian[:, :7] @ change[i], move[i], atol=0.002)
        alone = panda.turn(*[part[i : i + 1] for part in given], move[i : i + 1])
        np.testing.assert_allclose(alone[0], change[i], atol=1e-12)


def test_the_arm_keeps_still_when_nothing_is_wanted(arms: MujocoFleet) -> None:
    drive(arms, HANDS_OFF, 60)
    before = arms._obs.copy()
    after = drive(arms, HANDS_OFF, 50)[0]
    np.testing.assert_allclose(after[:, GRIP], before[:, GRIP], atol=0.003)
    np.testing.assert_allclose(after[:, CUBE], before[:, CUBE], atol=1e-4)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [1, -1])
def test_an_action_moves_or_turns_the_gripper_by_a_step(arms: MujocoFleet, axis: int, sign: int) -> None:
    action = HANDS_OFF.copy()
    drive(arms, action, 5)
    action[axis] = sign * 0.6
    drive(arms, action, 3)
    rotations = [data.site_xmat[0].reshape(3, 3).copy() for data in arms.physics.datas]
    places = arms._obs[:, GRIP].copy()
    drive(arms, action, 5)
    for i, data in enumerate(arms.physics.datas):
        turned = data.site_xmat[0].reshape(3, 3) @ rotations[i].T
        vector = 0.5 * np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
        moved = np.concatenate([(arms._obs[i, GRIP] - places[i]) / STEP, vector / TWIST]) / 5
        np.testing.assert_allclose(moved, 0.6 * sign * (np.arange(6) == axis), atol=0.12)


def test_the_gripper_stays_in_its_box_even_where_the_arm_is_stretched(arms: MujocoFleet) -> None:
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    for _ in range(150):
        obs, _, _, _, info = arms.step(np.concatenate([corners, np.zeros((4, 3)), -np.ones((4, 1))], axis=1))
    moving = ~info["violation"]
    assert (obs[moving][:, GRIP] > LOW - 0.03).all()
    assert (obs[moving][:, GRIP] < HIGH + 0.03).all()
    assert max(np.abs(data.qvel[:7]).max() for data in arms.physics.datas) < 2
    assert not np.any(info["unstable"] != "")


# -- observations, goal, violation ----------------------------------------------------------------------------------


def test_observations_are_what_the_task_says(arms: MujocoFleet) -> None:
    obs, _, _ = work(arms, Stacker(0.0), arms.reset(seed=1)[0], 40)
    assert obs.shape == (4, 19)
    for data, row in zip(arms.physics.datas, obs, strict=True):
        mujoco.mj_forward(arms.physics.model, data)  # sites lag by one physics step
        a, b = data.body("cube A"), data.body("cube B")
        np.testing.assert_allclose(np.abs(row[:4] @ a.xquat), 1, atol=1e-6)
        np.testing.assert_allclose(row[CUBE], a.xpos, atol=1e-6)
        np.testing.assert_allclose(row[WAY], b.xpos - a.xpos, atol=1e-6)
        np.testing.assert_allclose(row[GRIP], data.site_xpos[0], atol=0.006)
        np.testing.assert_allclose(np.abs(row[HEADING] @ data.body("hand").xquat), 1, atol=1e-3)
        np.testing.assert_allclose(row[FINGERS], data.qpos[7:9])
        assert row[0] >= 0
        assert row[14] >= 0 or row[13] >= 0


def test_the_goal_is_a_cube_on_the_other_one_that_nobody_holds(arms: MujocoFleet) -> None:
    task = arms.task
    assert isinstance(task, GoalTask)
    good = np.zeros(23)
    good[9:12], good[16:19] = [0.5, 0.1, 2 * HALF_B + HALF_A], [0.5, 0.1, HALF_B]
    beside, high, below = good.copy(), good.copy(), good.copy()
    beside[9] += 0.025
    high[11] += 0.01
    below[9:12] = [0.5, 0.1, HALF_A]
    states = np.stack([good, good, beside, high, below])
    grip = states[:, 9:12] + [0, 0, AWAY + 0.01]
    grip[1] = states[1, 9:12] + [0, 0, AWAY - 0.01]
    frame = {"qpos": states, "site_xpos": grip[:, None]}
    assert task.success(frame).tolist() == [True, False, False, False, False]
    reward = task.reward(frame, np.zeros(5), np.zeros((5, 7)))
    assert reward[0] == 16
    assert reward[1] > reward[2] > reward[4] > 0


def test_a_cube_that_leaves_the_table_is_a_violation(arms: MujocoFleet) -> None:
    put(arms, 1, "A", (TABLE[1, 0] + 0.1, 0.0, 0.1))
    put(arms, 2, "B", (0.5, TABLE[0, 1] - 0.05, -0.1))
    _, _, _, _, info = drive(arms, HANDS_OFF, 2)
    assert info["violation"].tolist() == [False, True, True, False]


def test_cubes_begin_on_the_table_apart_and_turned_any_way() -> None:
    fleet = MujocoFleet("FrankaCubeStack", 300, disturbance="none", threads=1)
    obs, info = fleet.reset(seed=0)
    assert not info["violation"].any()
    assert (np.linalg.norm(obs[:, WAY][:, :2], axis=1) > 0.1).all()
    np.testing.assert_allclose(obs[:, CUBE][:, 2], HALF_A)
    yaw = 2 * np.arctan2(obs[:, 3], obs[:, 0])
    assert np.histogram(yaw, bins=6, range=(-np.pi, np.pi))[0].min() > 25
    before = fleet._obs
    after = drive(fleet, HANDS_OFF, 10)[0]
    np.testing.assert_allclose(after[:, CUBE], before[:, CUBE], atol=0.002)
    fleet.close()


# -- grasps ---------------------------------------------------------------------------------------------------------


def test_nothing_is_lifted_without_closing_the_fingers(arms: MujocoFleet) -> None:
    human, obs = Stacker(0.0), arms.reset(seed=0)[0]
    for _ in range(120):
        action = human.act(obs)
        action[:, 6] = -1
        obs, _, _, _, info = arms.step(action)
    assert not info["success"].any()
    assert (obs[:, CUBE][:, 2] < HALF_A + 0.01).all()


def test_a_cube_is_held_by_friction_and_falls_when_the_fingers_open(arms: MujocoFleet) -> None:
    human, obs = Stacker(0.0), arms.reset(seed=0)[0]
    while (obs[:, CUBE][:, 2] < 0.08).all():
        obs = arms.step(human.act(obs))[0]
    up = obs[:, CUBE][:, 2] > 0.07
    hold = np.array([0, 0, 0, 0, 0, 0, 1.0])
    before, after = drive(arms, hold, 5)[0], drive(arms, hold, 40)[0]
    np.testing.assert_allclose(after[up][:, CUBE], before[up][:, CUBE], atol=0.006)
    assert (np.abs(after[up][:, FINGERS] - HALF_A) < 0.004).all()
    assert (drive(arms, HANDS_OFF, 25)[0][up][:, CUBE][:, 2] < HALF_A + 0.005).all()


# -- the humans -----------------------------------------------------------------------------------------------------


def test_the_four_humans_stack_alike_and_differ_in_how_they_turn_the_gripper() -> None:
    """The symmetry of the four: same faces or the other ones, each half a turn apart, and all succeed."""
    grips, lengths = [], []
    for human in kinds_of(team()):
        fleet = MujocoFleet("FrankaCubeStack", 8, disturbance="none", threads=1)
        obs, _ = fleet.reset(seed=2)
        face = 2 * np.arctan2(obs[:, 3], obs[:, 0]) % (np.pi / 2)
        first, complete, steps = np.full(8, np.nan), np.zeros(8, dtype=bool), np.zeros(8)
        for _ in range(200):
            obs, _, _, _, info = fleet.step(human.act(obs))
            lifted = (obs[:, CUBE][:, 2] > 0.04) & np.isnan(first)
            first[lifted] = yaw_of(obs)[lifted]
            complete |= info["success"]
            steps += ~complete
        assert complete.all()
        inner = np.minimum(face, np.pi / 2 - face) > 0.15
        assert inner.sum() >= 4
        np.testing.assert_allclose(first[inner], (face + human.grasp)[inner], atol=0.15)
        grips.append(first)
        lengths.append(steps.mean())
        fleet.close()
    straight, opposite, left, right = (np.exp(1j * np.array(yaw)) for yaw in grips)
    for one, other, quarter in ((straight, opposite, -1), (straight, left, -1j), (straight, right, 1j)):
        assert (np.abs(other - quarter * one) < 0.3).mean() > 0.7
    assert max(lengths) < 1.6 * min(lengths)


@pytest.mark.parametrize("kind", range(4))
def test_each_human_takes_over_what_others_began(kind: int) -> None:
    """Whatever the others were about to do; a cube that lies on its side, one that was let go on the way."""
    fleet = MujocoFleet("FrankaCubeStack", 6, disturbance="none", threads=1)
    obs, _ = fleet.reset(seed=4)
    put(fleet, 4, "A", (0.55, 0.1, 0.03), (0.6, 0.6, 0.37, 0.37))
    others, early = team(), np.zeros(6, dtype=bool)
    for t in range(60):
        action = others.act(obs)
        if t > 45:
            action[5] = HANDS_OFF
        obs, _, _, _, info = fleet.step(action)
        early |= info["success"]
    _, complete, _ = work(fleet, kinds_of(others)[kind], obs, 400)
    assert (early | complete).all()
    fleet.close()


def test_the_humans_succeed_at_the_tasks_level() -> None:
    fleet = MujocoFleet("FrankaCubeStack", 8, threads=1)
    assert fleet.disturbance.noise > 0
    _, complete, _ = work(fleet, team(), fleet.reset(seed=11)[0], fleet.horizon)
    assert complete.mean() >= 0.85
    fleet.close()


def test_the_task_names_its_humans_and_what_they_score(arms: MujocoFleet) -> None:
    actor, card = experts.load("FrankaCubeStack")
    assert [human.grasp for human in kinds_of(actor)] == [0.0, -np.pi, -np.pi / 2, np.pi / 2]
    for human in kinds_of(actor):
        check_policy(human, arms)
    assert card["scores"]["none"]["success"] == 1
    assert card["scores"][TASKS["FrankaCubeStack"].disturbance]["success"] > 0.9
    assert OPEN > HALF_A
