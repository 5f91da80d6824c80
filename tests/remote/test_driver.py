"""Drivers: tasks of ours, Gymnasium's environments, and one's own; and what `check_driver` finds wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from remote.point import Point

from tutelage.envs import experts
from tutelage.envs.registry import make_fleet
from tutelage.errors import ConfigError, ContractError
from tutelage.remote.driver import Driver, DriverFailed, FleetDriver, GymnasiumDriver, check_driver, describe, make_driver


class Lamp(gym.Env[np.ndarray, np.ndarray]):
    """An environment that draws; it ends after an action above 0.5, which its info may call a success."""

    observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)
    render_mode = "rgb_array"

    def __init__(self, success: bool = False) -> None:
        self.good = success

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert action.dtype == np.float64
        over = bool(action[0] > 0.5)
        return np.full(3, action[0], np.float32), 1.0, over, False, {"success": over and self.good}

    def render(self) -> np.ndarray:
        return np.full((32, 32, 3), 9, np.uint8)


@pytest.fixture
def point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Point:
    monkeypatch.setenv("POINT_LOG", str(tmp_path / "log"))
    return Point()


@pytest.mark.parametrize("name", ["Navigation", "BlockPushing", "remote.test_driver:Lamp"])
def test_what_a_name_stands_for_keeps_the_contract(name: str) -> None:
    driver = make_driver(name)
    check_driver(driver)
    assert isinstance(driver, Driver)
    assert list(driver.cameras()) == ["front"]  # type: ignore[attr-defined]
    driver.close()  # type: ignore[attr-defined]


def test_an_environment_of_gymnasium_by_its_id() -> None:
    driver = make_driver("Pendulum-v1", render=False)
    check_driver(driver)
    described = describe(driver, 0.05)
    assert (described.task, described.shape, described.horizon) == ("Pendulum-v1", (3,), 200)
    assert described.action_low == (-2.0,)


def test_ones_own_driver_keeps_the_contract(point: Point) -> None:
    check_driver(point)


@pytest.mark.parametrize("good", [False, True])
def test_the_end_of_an_environment_is_a_violation_unless_it_calls_it_a_success(good: bool) -> None:
    driver = GymnasiumDriver(Lamp(good))
    driver.reset(False, 0)
    driver.send_action(np.array([0.2], np.float32))
    assert (driver.violation(), driver.success(), driver.truncated()) == (False, False, False)
    driver.send_action(np.array([0.9], np.float32))
    assert (driver.violation(), driver.success()) == (not good, good)
    seen = driver.get_observation()
    driver.send_action(np.array([0.1], np.float32))
    assert np.array_equal(driver.get_observation(), seen)  # stands still until it is reset
    driver.reset(True, None)
    assert (driver.violation(), driver.success()) == (False, False)


def test_what_is_a_violation_can_be_said() -> None:
    driver = GymnasiumDriver(Lamp(), violation=lambda obs, reward, terminated, info: obs[0] < -0.5)
    driver.reset(False, 0)
    driver.send_action(np.array([0.9], np.float32))
    assert not driver.violation()
    assert driver.truncated()
    driver.reset(False, 0)
    driver.send_action(np.array([-0.9], np.float32))
    assert driver.violation()


def test_a_stopped_simulation_takes_no_action() -> None:
    driver = make_driver("Navigation", render=False)
    driver.reset(False, 1)  # type: ignore[attr-defined]
    before = driver.get_observation()
    driver.stop()  # type: ignore[attr-defined]
    driver.send_action(np.ones(2, np.float32))
    assert np.array_equal(driver.get_observation(), before)
    driver.release()  # type: ignore[attr-defined]
    driver.send_action(np.ones(2, np.float32))
    assert not np.array_equal(driver.get_observation(), before)


def test_an_expert_of_ours_completes_its_task_on_a_robot() -> None:
    driver = FleetDriver(make_fleet("Navigation", 1), "Navigation")
    expert = experts.load("Navigation")[0]
    driver.reset(False, 0)
    for _ in range(driver.horizon):
        driver.send_action(expert.act(driver.get_observation()[None])[0])
        if driver.success():
            return
    raise AssertionError("the expert did not get there")


class Overwrites(Point):
    def get_observation(self) -> np.ndarray:
        self.at += 0.001
        return self.at


class Unbounded(Point):
    action_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)


class WrongShape(Point):
    def get_observation(self) -> np.ndarray:
        return np.zeros(3, np.float32)


class NotANumber(Point):
    def get_observation(self) -> np.ndarray:
        return np.full(2, np.nan, np.float32)


class Greedy(Point):
    def send_action(self, action: np.ndarray) -> None:
        action += 1


class Fickle(Point):
    """Says once that it fell, and forgets."""

    fell = False

    def send_action(self, action: np.ndarray) -> None:
        self.fell = not self.fell

    def violation(self) -> bool:
        return self.fell


class BadCamera(Point):
    def cameras(self) -> dict[str, object]:
        return {"front": lambda: np.zeros((4, 4), np.uint8)}


@pytest.mark.parametrize(
    ("kind", "clause"),
    [
        (Overwrites, "get_observation overwrites what it returned before"),
        (Unbounded, "finite bounds"),
        (WrongShape, r"must observe \(2,\) float32, got \(3,\) float32"),
        (NotANumber, "not finite"),
        (Greedy, "send_action changes the action"),
        (Fickle, "said until the next reset"),
        (BadCamera, r"camera 'front' must give \(height, width, 3\) uint8"),
    ],
)
def test_a_broken_clause_is_named(point: Point, kind: type[Point], clause: str) -> None:
    with pytest.raises(ContractError, match=clause):
        check_driver(kind())


@pytest.mark.parametrize("method", ["reset", "get_observation", "send_action", "hold", "violation", "cameras"])
def test_a_driver_that_raises_is_told_to_hold_and_named_with_the_place(
    point: Point, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    def fails(*given: object) -> None:
        raise OSError("unplugged")

    monkeypatch.setattr(point, method, fails)
    held = len(point.log.read_text())
    with pytest.raises(DriverFailed, match=r"^the driver Point failed: OSError: unplugged \(test_driver.py:\d+\)$"):
        check_driver(point)
    assert method == "hold" or "hold" in point.log.read_text()[held:]


class Missing(Point):
    def __init__(self) -> None:
        raise OSError("no /dev/arm")


def test_what_cannot_be_made_says_why_in_one_line() -> None:
    with pytest.raises(
        DriverFailed, match=r"the driver remote.test_driver:Missing cannot be made: OSError: no /dev/arm \(test_driv"
    ):
        make_driver("remote.test_driver:Missing")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("Navigatoin", "unknown task 'Navigatoin' .did you mean Navigation?"),
        ("remote.point:Nothing", "has no callable 'Nothing'"),
        ("builtins:dict", "must make a driver"),
        ("CartPole-v1", "a robot needs arrays as observations and actions"),
    ],
)
def test_what_cannot_be_a_robot_is_refused_in_one_line(name: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        make_driver(name, render=False)
