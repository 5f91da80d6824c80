"""Tasks by name: the one way from a string to a fleet."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from tutelage.envs.disturbance import Disturbance
from tutelage.envs.tasks import TASKS
from tutelage.envs.tasks.base import Task
from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.fleet import Fleet
from tutelage.objects import check_call, load_object, takes

EXTRAS = {
    "robosuite": {"NutAssemblyRound": "tutelage.envs.robosuite_fleet:NutAssemblyRound"},
    "envpool": {
        name: f"tutelage.envs.envpool_tasks:{name}"
        for name in ("Go1Joystick", "SpotJoystick", "LeapCubeReorient", "PandaPickCube")
    },
}
"""Tasks on simulators that come with an extra, which need not be installed: what makes their fleets, by extra."""
ON_EXTRAS = {name: made_by for tasks in EXTRAS.values() for name, made_by in tasks.items()}

GROUP = "tutelage.tasks"
"""Entry points of this group are tasks. Each names what "module:callable" may name; see `make_fleet`."""


def task_names() -> list[str]:
    """The tasks that `make_fleet` knows by name: built in, on extras, and of installed packages."""
    own = [*TASKS, *ON_EXTRAS]
    return [*own, *(name for name in _installed() if name not in own)]


def make_fleet(
    task: str,
    num_envs: int,
    *,
    disturbance: Disturbance | str | None = None,
    threads: int | None = None,
    **kwargs: Any,
) -> Fleet:
    """A fleet of `num_envs` robots.

    Args:
        task: a built-in task ("Walker2d"), one on an extra ("NutAssemblyRound", "Go1Joystick"), the name of an entry point
            of the group "tutelage.tasks", or "module:callable". The callable is a subclass of `Task`, or is called as
            `callable(num_envs, **kwargs)` and returns a `Fleet`.
        num_envs: N robots.
        disturbance: for the built-in tasks, see `TaskFleet`. Handed to a callable only when given.
        threads: physics threads, on which no result depends. Handed to a callable only when given, and only to one
            that takes it.
        kwargs: further arguments of the fleet, such as `success_return`.

    Raises:
        ConfigError: an unknown task, or arguments that it does not take.
        ContractError: the callable returned something that is no `Fleet`.
    """
    given = {"disturbance": disturbance, "threads": threads}
    settings = {name: value for name, value in given.items() if value is not None} | kwargs
    make: Any = find_task(task)
    if isinstance(make, type) and issubclass(make, Task):
        kind = make.fleet_type()
        check_call(kind, f"task {task!r}", make, num_envs, **settings)
        return kind(make(), num_envs, **settings)
    if not takes(make, "threads"):
        settings.pop("threads", None)
    check_call(make, f"task {task!r}", num_envs, **settings)
    fleet = make(num_envs, **settings)
    if not isinstance(fleet, Fleet):
        raise ContractError(f"task {task!r} must return a tutelage.fleet.fleet.Fleet, got {type(fleet).__name__}")
    return fleet


def find_task(task: str) -> Callable[..., Any]:
    """What makes the fleets of a task.

    Raises:
        ConfigError: an unknown task.
        MissingExtraError: its simulator is not installed.
    """
    if task in TASKS:
        return TASKS[task]
    if task in ON_EXTRAS:
        return load_object(ON_EXTRAS[task], "task")
    if ":" in task:
        return load_object(task, "task")
    installed = _installed()
    if task in installed:
        return load_object(f"{installed[task].module}:{installed[task].attr}", "task")
    names = task_names()
    close = difflib.get_close_matches(task.lower(), [name.lower() for name in names])
    meant = [name for name in names if name.lower() in close]
    hint = f" (did you mean {' or '.join(meant)}?)" if meant else ""
    if re.search(r"-v\d+$", task):
        hint = ", which looks like an environment of Gymnasium: see `GymnasiumFleet` in docs/extending.md"
    raise ConfigError(f"unknown task {task!r}{hint}; tasks: {', '.join(names)}, or your own as module:callable")


def _installed() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}
