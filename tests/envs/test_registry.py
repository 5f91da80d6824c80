"""From a string to a fleet."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import pytest
from fakes import PointFleet

from tutelage.envs import registry
from tutelage.envs.registry import ON_EXTRAS, make_fleet, task_names
from tutelage.envs.task_fleet import TaskFleet
from tutelage.envs.tasks import TASKS, Walker2d
from tutelage.errors import ConfigError, ContractError


class Stroll(Walker2d):
    """A task of somebody else's."""

    horizon = 7


def points(num_envs: int, *, bound: float = 1.0) -> PointFleet:
    return PointFleet(num_envs, bound=bound)


def threaded(num_envs: int, *, threads: int = 1) -> PointFleet:
    return PointFleet(num_envs, bound=float(threads))


def anything(num_envs: int, **settings: Any) -> PointFleet:
    return PointFleet(num_envs, bound=float(settings["threads"]))


def nothing(num_envs: int) -> None:
    return None


def nobody() -> None:
    return None


@pytest.mark.parametrize("name", TASKS)
def test_built_in_tasks(name: str) -> None:
    fleet = make_fleet(name, 3, disturbance="mild", threads=1, success_return=10.0)
    assert isinstance(fleet, TaskFleet)
    assert (fleet.task.name, fleet.num_envs, fleet.disturbance.noise, fleet.success_return) == (name, 3, 0.1, 10.0)
    fleet.close()


def test_a_function_of_a_module() -> None:
    fleet = make_fleet(f"{__name__}:points", 4, bound=2.0)
    assert isinstance(fleet, PointFleet)
    assert (fleet.num_envs, fleet.bound) == (4, 2.0)


@pytest.mark.parametrize(("name", "bound"), [("points", 1.0), ("threaded", 3.0), ("anything", 3.0)])
def test_a_function_gets_threads_only_if_it_takes_them(name: str, bound: float) -> None:
    fleet = make_fleet(f"{__name__}:{name}", 2, threads=3)
    assert isinstance(fleet, PointFleet)
    assert fleet.bound == bound


def test_a_task_class_of_a_module_takes_what_a_built_in_one_takes() -> None:
    fleet = make_fleet(f"{__name__}:Stroll", 2, disturbance="none", threads=1)
    assert fleet.horizon == 7
    fleet.close()


def test_tasks_of_installed_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("Points", f"{__name__}:points", registry.GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == registry.GROUP else [])
    assert task_names() == [*TASKS, *ON_EXTRAS, "Points"]
    assert make_fleet("Points", 2).num_envs == 2
    with pytest.raises(ConfigError, match=r"unknown task 'Point' \(did you mean Points\?\); tasks: HalfCheetah, .*, Points"):
        make_fleet("Point", 2)


@pytest.mark.parametrize(
    ("task", "settings", "error", "message"),
    [
        ("walker", {}, ConfigError, r"unknown task 'walker' \(did you mean Walker2d\?\); tasks: HalfCheetah, Walker2d"),
        ("Quux", {}, ConfigError, r"unknown task 'Quux'; tasks: HalfCheetah"),
        ("no_such_module:make", {}, ConfigError, "no module 'no_such_module'"),
        ("tutelage.envs.nowhere:make", {}, ConfigError, "no module 'tutelage.envs.nowhere'"),
        (":make", {}, ConfigError, "write module:callable"),
        ("math:nothing", {}, ConfigError, "has no callable 'nothing'"),
        ("math:pi", {}, ConfigError, "has no callable 'pi'"),
        ("{here}:points", {"speed": 3}, ConfigError, "unexpected keyword argument 'speed'"),
        ("{here}:points", {"name": "x"}, ConfigError, "unexpected keyword argument 'name'"),
        ("{here}:points", {"disturbance": "mild"}, ConfigError, "unexpected keyword argument 'disturbance'"),
        ("Walker2d", {"gravity": 3}, ConfigError, "unexpected keyword argument 'gravity'"),
        ("{here}:nobody", {"threads": 2}, ConfigError, "task '.*:nobody' cannot be made: too many positional arguments"),
        ("{here}:nothing", {}, ContractError, "must return a tutelage.fleet.fleet.Fleet, got NoneType"),
    ],
)
def test_mistakes_are_named(task: str, settings: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make_fleet(task.replace("{here}", __name__), 2, **settings)
