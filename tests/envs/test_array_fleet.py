"""What a fleet promises whose physics is written as array operations: seeds, resets of some, pausing, exact resume, bad input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tutelage.checks import check_env, check_policy
from tutelage.envs import experts
from tutelage.envs.array_fleet import ArrayFleet
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.registry import make_fleet
from tutelage.envs.tasks import TASKS, ArrayTask
from tutelage.errors import ConfigError
from tutelage.policies.kinds import kinds_of
from tutelage.store import load_tree, save_tree

NAMES = [name for name, task in TASKS.items() if issubclass(task, ArrayTask)]
LEVEL = "noise=0.3,friction=0.3,wind=0.75"


def drive(fleet: Any, steps: int, seed: int = 0) -> list[Any]:
    """Random actions; whoever is done or violated starts again at every third step."""
    rng, out = np.random.default_rng(seed), []
    for t in range(steps):
        *result, info = fleet.step(rng.uniform(fleet.action_low, fleet.action_high, fleet.action_space.shape))
        out += [*result, info["success"], info["violation"], info["return"]]
        if t % 3 == 2:
            again = info["success"] | info["violation"] | result[3]
            out.append(fleet.reset(options={"reset_mask": again})[0])
    return out


def alike(a: list[Any], b: list[Any]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("observation", ["state", "images"])
@pytest.mark.parametrize("level", ["none", LEVEL])
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.filterwarnings("ignore:check_env")
def test_fleets_keep_the_contract(name: str, level: str, observation: Any) -> None:
    check_env(ArrayFleet(name, 5, disturbance=level, observation=observation))


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_run_and_another_one_another(name: str) -> None:
    runs = []
    for seed in (3, 3, 4):
        fleet = ArrayFleet(name, 7, disturbance=LEVEL)
        fleet.reset(seed=seed)
        runs.append(drive(fleet, 60))
    assert alike(runs[0], runs[1])
    assert not alike(runs[0], runs[2])


@pytest.mark.parametrize("observation", ["state", "images"])
@pytest.mark.parametrize("name", NAMES)
def test_a_saved_fleet_continues_bit_for_bit_in_a_new_one(name: str, observation: Any, tmp_path: Path) -> None:
    fleet, other = (ArrayFleet(name, 6, disturbance=LEVEL, observation=observation) for _ in range(2))
    fleet.reset(seed=7)
    drive(fleet, 33)
    save_tree(tmp_path / "fleet", fleet.state_dict())
    other.load_state_dict(load_tree(tmp_path / "fleet"))
    assert alike(drive(fleet, 40, seed=1), drive(other, 40, seed=1))


@pytest.mark.parametrize("name", NAMES)
def test_robots_do_not_depend_on_how_many_there_are(name: str) -> None:
    few, many = (ArrayFleet(name, n, disturbance="none") for n in (3, 9))
    few.reset(seed=0)
    many.reset(seed=0)
    many.put(np.concatenate([few.states] * 3))
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 3, len(few.action_low)))
    for action in actions:
        obs, violation = few.step(action)[0], few.step(action, active=np.zeros(3, dtype=bool))[4]["violation"]
        theirs = many.step(np.concatenate([action] * 3))
        assert np.array_equal(np.concatenate([obs] * 3), theirs[0])
        assert np.array_equal(np.concatenate([violation] * 3), theirs[4]["violation"])


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", NAMES)
def test_a_state_that_is_not_finite_is_a_violation_of_that_robot_alone(name: str, value: float) -> None:
    fleet = ArrayFleet(name, 3, disturbance="none")
    before, _ = fleet.reset(seed=0)
    fleet._state = fleet.states.copy()
    fleet._state[1] = value
    with np.errstate(invalid="ignore"):
        obs, reward, _, truncated, info = fleet.step(np.zeros((3, len(fleet.action_low))))
    assert info["violation"].tolist() == [False, True, False]
    assert info["unstable"].tolist() == ["", "state", ""]
    assert np.array_equal(obs[1], before[1])
    assert np.isfinite(obs).all()
    assert not truncated.any()
    assert (reward == 0).all()
    obs, info = fleet.reset(options={"reset_mask": info["violation"]})
    assert np.isfinite(obs).all()
    assert not info["violation"].any()
    assert not fleet.step(np.zeros((3, len(fleet.action_low))))[4]["violation"].any()


@pytest.mark.parametrize("name", NAMES)
def test_every_kind_of_human_succeeds_and_looks_at_each_row_alone(name: str) -> None:
    actor, card = experts.load(name)
    for level in {"none", TASKS[name].disturbance}:
        assert card["scores"][level]["episodes"] >= 100
        for human in kinds_of(actor):
            score = experts.evaluate(human, name, level, episodes=50)
            assert score.success >= 0.9
            assert score.survived >= 0.9
    for human in kinds_of(actor):
        check_policy(human, make_fleet(name, 6))


@pytest.mark.parametrize("name", NAMES)
def test_pictures_have_the_asked_for_size(name: str) -> None:
    fleet = ArrayFleet(name, 3, render_mode="rgb_array")
    fleet.reset(seed=0)
    pictures = fleet.render()
    assert pictures is not None
    assert [p.shape for p in pictures] == [(240, 320, 3)] * 3
    assert fleet.render_robot(1, 50, 40).shape == (40, 50, 3)
    assert fleet.images().shape == (3, 64, 64, 3)
    assert fleet.images().dtype == np.uint8
    assert np.array_equal(fleet.images(np.array([2]))[0], fleet.images()[2])


def test_a_task_belongs_to_its_kind_of_fleet() -> None:
    with pytest.raises(ConfigError, match="Walker2d is no task for a ArrayFleet; use make_fleet"):
        ArrayFleet("Walker2d", 2)
    with pytest.raises(ConfigError, match="Navigation is no task for a MujocoFleet; use make_fleet"):
        MujocoFleet("Navigation", 2)
    with pytest.raises(ConfigError, match="no wind blows in Walker2d; use push"):
        MujocoFleet("Walker2d", 2, disturbance="wind=1")
    with pytest.raises(ConfigError, match="disturbance wind must be a number >= 0"):
        make_fleet("Navigation", 2, disturbance="wind=-1")
