"""robosuite's peg insertion behind the same face: its physics, its observations, its success, robots that take turns."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from tutelage.checks import check_env, check_policy
from tutelage.envs.registry import make_fleet, task_names
from tutelage.errors import ConfigError, MissingExtraError

STILL = [0.0, 0.0, 0.0, 0.0, -1.0]


def make(n: int = 1, seed: int | None = 0, **settings: Any) -> Any:
    pytest.importorskip("robosuite", reason="needs pip install 'tutelage[robosuite]' (make robosuite)")
    fleet: Any = make_fleet("NutAssemblyRound", n, **settings)
    if seed is not None:
        fleet.reset(seed=seed)
    return fleet


def put_nut(fleet: Any, robot: int, position: Any) -> None:
    """Put a robot's nut somewhere, at rest and flat."""
    backend = fleet._backend
    backend._enter(robot)
    joint = backend._data.joint("RoundNut_joint0")
    joint.qpos, joint.qvel = [*position, 1, 0, 0, 0], np.zeros(6)
    backend._leave(robot)


def test_without_robosuite_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "NutAssemblyRound" in task_names()
    monkeypatch.delitem(sys.modules, "tutelage.envs.robosuite_fleet", raising=False)
    monkeypatch.setitem(sys.modules, "robosuite", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'tutelage\[robosuite\]'"):
        make_fleet("NutAssemblyRound", 1)


def test_it_keeps_the_contract_of_a_fleet() -> None:
    fleet = make(2, seed=None, control_steps=1, horizon=12)
    with pytest.warns(UserWarning, match="no robot of NutAssemblyRound violated"):
        check_env(fleet, steps=26)
    assert fleet.can_checkpoint
    fleet.close()


def test_observations_are_robosuites_object_state_and_proprioception() -> None:
    """51 numbers, in the order in which robosuite's GymWrapper had them when the dissertation was written."""
    fleet = make()
    obs = fleet.step(np.array([[0.5, -0.5, -1.0, 1.0, -1.0]]))[0]
    seen = fleet._backend._env._get_observations(force_update=True)
    parts = {"nut": slice(0, 3), "cos": slice(14, 20), "sin": slice(20, 26), "eef": slice(32, 35), "fingers": slice(39, 45)}
    assert obs.shape == (1, 51)
    assert np.array_equal(obs[0, parts["nut"]], seen["RoundNut_pos"])
    assert np.array_equal(obs[0, parts["cos"]], seen["robot0_joint_pos_cos"])
    assert np.array_equal(obs[0, parts["sin"]], seen["robot0_joint_pos_sin"])
    assert np.array_equal(obs[0, parts["eef"]], seen["robot0_eef_pos"])
    assert np.array_equal(obs[0, parts["fingers"]], seen["robot0_gripper_qpos"])
    np.testing.assert_allclose(np.linalg.norm(obs[0, [3, 4, 5, 6]]), 1.0)
    np.testing.assert_allclose(np.linalg.norm(obs[0, 35:39]), 1.0)
    x, y, z = obs[0, :3]
    assert (-0.12 < x < -0.105) & (-0.23 < y < -0.105) & (0.825 < z < 0.835), "robosuite's ranges, and at rest"
    fleet.close()


def test_turns_are_what_an_environment_of_ones_own_would_do() -> None:
    """Robot 0 among others, beside others that stand still, and alone in a simulator that runs through."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (4, 2, 5)).astype(np.float32)
    two, paused, one = make(2), make(2), make(1)
    backend = one._backend
    for step in actions:
        first = two.step(step)[0][0]
        assert np.array_equal(first, paused.step(step, active=np.array([True, False]))[0][0])
        x, y, z, turn, fingers = step[0]
        backend._env.step(np.array([x, y, z, 0, 0, turn, fingers], dtype=np.float64))
        for _ in range(9):
            backend._env.step(np.array([0, 0, 0, 0, 0, 0, fingers], dtype=np.float64))
        assert np.array_equal(first, backend._observe())
    for fleet in (two, paused, one):
        fleet.close()


def test_the_controller_is_operational_space_control_with_fixed_impedance() -> None:
    fleet = make()
    controller, env = fleet._backend._controller, fleet._backend._env
    assert (controller.name, controller.impedance_mode, controller.input_type) == ("OSC_POSE", "fixed", "delta")
    assert (env.control_freq, env.single_object_mode, type(env.robots[0].robot_model).__name__) == (20, 2, "UR5e")
    assert fleet.horizon == 175
    before = env.sim.data.time
    fleet.step(np.array([STILL]))
    assert env.sim.data.time - before == pytest.approx(0.5), "ten steps of 20 Hz"
    fleet.close()


@pytest.mark.parametrize("axis", range(4))
def test_an_action_moves_the_gripper(axis: int) -> None:
    fleet = make(control_steps=6)
    before = fleet.step(np.array([STILL]))[0]
    action = np.array([STILL])
    action[0, axis] = 1.0
    after = fleet.step(action)[0]
    yaw = [
        np.arctan2(2 * (q[0] * q[1] + q[3] * q[2]), 1 - 2 * (q[1] ** 2 + q[2] ** 2))
        for q in (before[0, 35:39], after[0, 35:39])
    ]
    moved = np.array([*(after - before)[0, 32:35] / 0.0125, (yaw[1] - yaw[0]) / 0.11])
    np.testing.assert_allclose(moved, np.arange(4) == axis, atol=0.25)
    fleet.close()


def test_the_fingers_shut_and_open_again() -> None:
    """With the contacts that MuJoCo finds between meshes by default they jam half way, and then break."""
    fleet = make()
    angles = []
    for fingers in (1, 1, 1, 1, -1, -1):
        action = np.array([STILL])
        action[0, 4] = fingers
        angles.append(fleet.step(action)[0][0, [39, 42]])
    assert (np.array(angles[1:4]) > 0.48).all()
    assert (np.abs(np.array(angles[5]) + 0.027) < 0.01).all()
    fleet.close()


def test_success_is_robosuites_and_a_nut_off_the_table_is_a_violation() -> None:
    fleet = make(4, control_steps=4)
    put_nut(fleet, 1, [0.23, -0.1, 0.84])
    put_nut(fleet, 2, [0.5, 0.0, 0.84])
    put_nut(fleet, 3, [0.1, -0.1, 0.84])
    _, reward, terminated, truncated, info = fleet.step(np.tile(STILL, (4, 1)))
    assert info["success"].tolist() == [False, True, False, False]
    assert reward.tolist() == [0, 1, 0, 0]
    assert info["violation"].tolist() == terminated.tolist() == [False, False, True, False]
    assert not truncated.any()
    assert fleet.goal_conditioned
    info = fleet.step(np.tile([1.0, 0, 0, 0, -1], (4, 1)))[4]
    assert not info["success"].any(), "a task is completed once"
    fleet.close()


def test_a_checkpoint_continues_bit_for_bit_in_a_new_fleet() -> None:
    rng = np.random.default_rng(1)
    first, second = make(2, control_steps=2, horizon=4), make(2, seed=None, control_steps=2, horizon=4)
    first.step(rng.uniform(-1, 1, (2, 5)))
    second.load_state_dict(first.state_dict())
    for _ in range(4):
        action = rng.uniform(-1, 1, (2, 5))
        one, other = first.step(action), second.step(action)
        assert np.array_equal(one[0], other[0])
        assert np.array_equal(one[3], other[3])
        if one[3].any():
            mask = {"reset_mask": one[3]}
            assert np.array_equal(first.reset(options=mask)[0], second.reset(options=mask)[0])
    first.close()
    second.close()


def test_the_human_succeeds() -> None:
    from tutelage.envs.experts.nut_assembly import NutInserter

    fleet, human = make(1, seed=3), NutInserter()
    obs = fleet.reset(seed=3)[0]
    for _ in range(110):
        obs, _, _, _, info = fleet.step(human.act(obs))
        if info["success"].any():
            break
    assert info["success"].all()
    assert info["elapsed"][0] > 40, "about as long as on our own bench"
    fleet.close()


def test_the_human_looks_at_each_row_alone() -> None:
    from tutelage.envs.experts.nut_assembly import NutInserter

    fleet = make(2, seed=None, control_steps=1)
    check_policy(NutInserter(), fleet)
    fleet.close()


def test_a_run_needs_nothing_but_the_name() -> None:
    pytest.importorskip("robosuite")
    from tutelage.experiments.assemble import assemble
    from tutelage.experiments.config import RunConfig

    assembly = assemble(RunConfig("NutAssemblyRound", "U.G.C.", robots=2, humans=1, torch_threads=1))
    assembly.loop()
    assert assembly.config.offline_pairs == 2687
    assert assembly.fleet.can_checkpoint
    assembly.fleet.close()


def test_mistakes_are_named() -> None:
    pytest.importorskip("robosuite")
    for settings, message in (
        ({"num_envs": 0}, "at least one robot, got 0"),
        ({"num_envs": 1, "control_steps": 0}, "at least one step of the controller, got 0"),
        ({"num_envs": 1, "horizon": 0}, "the horizon must be at least 1 timestep, got 0"),
        ({"num_envs": 1, "disturbance": "mild"}, "cannot be made with"),
    ):
        with pytest.raises(ConfigError, match=message):
            make_fleet("NutAssemblyRound", **settings)
