"""EnvPool's tasks behind the same face."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from tutelage.checks import check_env
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
