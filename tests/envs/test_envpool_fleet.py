"""EnvPool's tasks behind the same face."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from tutelage.checks import check_env
from tutelage.envs.registry import make_fleet
from tutelage.errors import ConfigError, MissingExtraError


def make(task: str = "Walker2d-v4", n: int = 4, **kwargs: Any) -> Any:
    pytest.importorskip("envpool")
    from tutelage.envs.envpool_fleet import EnvPoolFleet

    settings = {"violation": lambda o: o.terminated, "success": lambda o: o.truncated, "threads": 1}
    return EnvPoolFleet(task, n, **{**settings, **kwargs})


def test_without_envpool_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "tutelage.envs.envpool_fleet", raising=False)
    monkeypatch.setitem(sys.modules, "envpool", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'tutelage\[envpool\]'"):
        import tutelage.envs.envpool_fleet  # noqa: F401


@pytest.mark.parametrize("task", ["Walker2d-v4", "HalfCheetah-v4", "Ant-v4"])
def test_envpool_keeps_the_contract(task: str) -> None:
    fleet = make(task, violation=lambda o: o.obs[:, 0] < 0.35 if task == "Ant-v4" else np.abs(o.obs[:, 1]) > 0.3, horizon=60)
    check_env(fleet)
    assert not fleet.can_checkpoint
    fleet.close()


def test_robots_that_stand_still_are_not_stepped() -> None:
    fleet = make(horizon=30)
    fleet.reset(seed=0)
    active = np.array([True, False, True, False])
    for _ in range(5):
        info = fleet.step(np.zeros((4, 6)), active=active)[4]
    assert info["elapsed_step"][active].tolist() == [5, 5]
    info = fleet.step(np.zeros((4, 6)))[4]
    assert info["elapsed_step"].tolist() == [6, 1, 6, 1]
    fleet.reset(options={"reset_mask": ~active})
    assert fleet.step(np.zeros((4, 6)))[4]["elapsed"].tolist() == [7, 1, 7, 1]
    fleet.close()


def test_it_is_the_walker_of_gymnasium() -> None:
    """Rewards and falls follow from the observations as Gymnasium says, so rows and robots are not mixed up."""
    fleet = make(n=6, horizon=80)
    fleet.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(60):
        obs, _, terminated, _, info = fleet.step(rng.uniform(-1, 1, (6, 6)))
        healthy = (obs[:, 0] > 0.8) & (obs[:, 0] < 2.0) & (np.abs(obs[:, 1]) < 1.0)
        assert np.array_equal(terminated, ~healthy)
    assert info["violation"].any()
    fleet.close()


def test_the_horizon_is_the_tasks_own_unless_given() -> None:
    fleet = make()
    assert fleet.horizon == 1000
    fleet.close()


def test_mistakes_are_named() -> None:
    with pytest.raises(ConfigError, match="EnvPool has no task 'Walker2dv4'; did you mean Walker2d-v4"):
        make("Walker2dv4")
    with pytest.raises(ConfigError, match="at least one robot"):
        make(n=0)
    fleet = make(n=2)
    fleet.reset(seed=0)
    with pytest.raises(ConfigError, match="seeded for all robots only"):
        fleet.reset(seed=1, options={"reset_mask": np.array([True, False])})
    fleet.close()


# -- tasks by name --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "obs", "actions"),
    [("Go1Joystick", 48, 12), ("SpotJoystick", 81, 12), ("LeapCubeReorient", 57, 16), ("PandaPickCube", 66, 8)],
)
def test_tasks_of_playground_are_fleets_by_name(task: str, obs: int, actions: int) -> None:
    pytest.importorskip("envpool")
    fleet = make_fleet(task, 4, threads=1, horizon=40)
    assert (fleet.single_observation_space.shape, fleet.single_action_space.shape) == ((obs,), (actions,))
    check_env(fleet)
    fleet.close()


def test_a_quadruped_that_is_thrown_about_falls_and_one_that_stands_has_not_followed() -> None:
    pytest.importorskip("envpool")
    fleet = make_fleet("Go1Joystick", 20, threads=2, horizon=150)
    assert fleet.success_return == pytest.approx(0.5 * 1.5 * 0.02 * 150)
    fleet.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(150):
        *_, truncated, info = fleet.step(rng.uniform(-1, 1, (20, 12)))
    assert info["violation"].sum() > 10
    assert not info["success"].any()
    assert not (truncated & info["violation"]).any()
    fleet.reset(seed=1)
    for _ in range(150):
        *_, truncated, info = fleet.step(np.zeros((20, 12)))
    assert (truncated & ~info["violation"]).sum() > 10
    assert not info["success"][info["return"] < fleet.success_return].any()
    fleet.close()
    generous = make_fleet("Go1Joystick", 2, threads=1, horizon=5, success_return=-np.inf)
    generous.reset(seed=0)
    for _ in range(5):
        *_, info = generous.step(np.zeros((2, 12)))
    assert info["success"].all()
    generous.close()


def test_a_hand_that_does_nothing_useful_drops_the_cube() -> None:
    pytest.importorskip("envpool")
    fleet = make_fleet("LeapCubeReorient", 10, threads=2)
    fleet.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(200):
        *_, info = fleet.step(rng.uniform(-1, 1, (10, 16)))
    assert info["violation"].sum() > 5
    assert (info["success_count"] == info["success"]).all()
    fleet.close()


def test_which_observation_must_be_said_where_there_are_several() -> None:
    for task, observe, said in (
        ("Go1JoystickFlatTerrain-v1", None, "observe one of state, privileged_state"),
        ("Go1JoystickFlatTerrain-v1", "pixels", "observe one of state, privileged_state"),
        ("Walker2d-v4", "state", "leave `observe` out"),
    ):
        with pytest.raises(ConfigError, match=said):
            make(task, observe=observe)
