"""What a robot can do, as `tutelage robot` needs it, and the two drivers that simulate one.

    class Arm:
        observation_space = gym.spaces.Box(-np.inf, np.inf, (7,), np.float32)
        action_space = gym.spaces.Box(-1, 1, (7,), np.float32)

        def get_observation(self): return self.joints.read()
        def send_action(self, action): self.joints.move(action)
        def hold(self): self.joints.brake()

That is a driver. `tutelage robot HOME --env my_package:Arm` puts it on the fleet. `check_driver` tries it out.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tutelage.envs.registry import find_task, make_fleet, task_names
from tutelage.errors import ConfigError, ContractError, TutelageError
from tutelage.fleet.fleet import Fleet
from tutelage.objects import make_object
from tutelage.remote.messages import MAX_CAMERAS, Description, Malformed
from tutelage.remote.simulated import FleetDriver, GymnasiumDriver
from tutelage.remote.telling import told

Array = NDArray[Any]

__all__ = [
    "Driver",
    "DriverFailed",
    "FleetDriver",
    "GymnasiumDriver",
    "check_driver",
    "describe",
    "make_driver",
    "observation_of",
]


class DriverFailed(TutelageError):
    """A driver that raises something of its own, and goes on to; the robot was told to hold."""


@runtime_checkable
class Driver(Protocol):
    """One robot. All methods but `stop` are called from one thread, and should return within a timestep.

    A driver may have more:

    * `reset(hard: bool, seed: int | None) -> None`: bring the robot into an initial state; hard: after a violation, which
      may need a person on the spot. May take its time; returns when the robot is ready. Without it, the fleet can only
      begin new episodes where the robot stands.
    * `stop() -> None`: the emergency stop. Called at once, from another thread, also while `send_action` runs; and again
      after that, many times. Without it, `hold` is called.
    * `release() -> None`: the emergency stop was cleared.
    * `violation()`, `success()`, `truncated() -> bool`: see `Fleet`. What ended an episode is said until the next reset.
    * `reward() -> float`: of the last step.
    * `cameras() -> Mapping[str, Callable[[], rgb]]`: what takes a picture, (height, width, 3) uint8, by name.
    * `close() -> None`.
    * attributes `task` (a name), `horizon` (timesteps of an episode), `goal` (whether success means reaching a goal state).

    Attributes:
        observation_space: a Box of at most four dimensions; float32, float64 or uint8.
        action_space: a Box (A,) with finite bounds. Actions are float32 and within them.
    """

    observation_space: gym.spaces.Box
    action_space: gym.spaces.Box

    def get_observation(self) -> Array:
        """What the robot sees now. An array that the driver does not write into again."""
        ...

    def send_action(self, action: Array) -> None:
        """Do this, and go on doing it until the next call."""
        ...

    def hold(self) -> None:
        """Stand still, safely, until the next action. May be called many times in a row."""
        ...


def make_driver(name: str, *, render: bool = True, size: tuple[int, int] = (320, 240)) -> Driver:
    """The driver that a name stands for.

    Args:
        name: "module:callable" that returns a `Driver`, a Gymnasium environment or a fleet of one; a task of ours
            ("Navigation"); or the id of a registered Gymnasium environment ("Pendulum-v1").
        render: make simulators draw pictures.
        size: of the pictures of our tasks, width and height.

    Raises:
        ConfigError: nothing of that name, or it makes something else.
        DriverFailed: what makes it raises something of its own.
    """
    try:
        return _make_driver(name, render, size)
    except TutelageError:
        raise
    except Exception as error:
        raise DriverFailed(f"the driver {name} cannot be made: {told(error)}") from error


def _make_driver(name: str, render: bool, size: tuple[int, int]) -> Driver:
    if ":" in name:
        made = make_object(name, "robot")
        if isinstance(made, gym.Env):
            return GymnasiumDriver(made)
        if isinstance(made, Fleet):
            return FleetDriver(made, name.rpartition(":")[2], *size)
        if not isinstance(made, Driver):
            wanted = "a driver (get_observation, send_action, hold, and the two spaces)"
            raise ConfigError(f"robot {name!r} must make {wanted}, a Gymnasium environment or a fleet of one")
        return made
    if name in task_names():
        if render:
            with contextlib.suppress(ConfigError):
                return FleetDriver(make_fleet(name, 1, threads=1, render_mode="rgb_array"), name, *size)
        return FleetDriver(make_fleet(name, 1, threads=1), name, *size)
    try:
        gym.spec(name)
    except gym.error.Error:
        find_task(name)  # raises, and knows what else may have been meant
    more: dict[str, Any] = {"render_mode": "rgb_array"} if render else {}
    return GymnasiumDriver(name, **more)


def describe(driver: Driver, dt: float, cameras: tuple[str, ...] = ()) -> Description:
    """What a driver says of itself, for the server.

    Args:
        dt: seconds of a timestep.
        cameras: names of those whose pictures are sent.

    Raises:
        ContractError: spaces that a fleet cannot have.
    """
    seen, box = driver.observation_space, driver.action_space
    kind = type(driver).__name__
    for space, what in ((seen, "observation_space"), (box, "action_space")):
        if not isinstance(space, gym.spaces.Box):
            raise ContractError(f"{kind}.{what} must be a Box, got {space}")
    if len(box.shape) != 1 or not np.isfinite([box.low, box.high]).all():
        raise ContractError(f"{kind}.action_space must have shape (A,) and finite bounds, got {box}")
    try:
        return Description.from_json(
            Description(
                shape=tuple(int(size) for size in seen.shape),
                dtype=np.dtype(seen.dtype).name,
                action_low=tuple(map(float, box.low.astype(np.float32))),
                action_high=tuple(map(float, box.high.astype(np.float32))),
                horizon=int(getattr(driver, "horizon", 1000)),
                task=str(getattr(driver, "task", "")),
                goal=bool(getattr(driver, "goal", False)),
                dt=float(dt),
                cameras=cameras,
            ).to_json()
        )
    except Malformed as error:
        raise ContractError(f"{kind} cannot be put on a fleet: {error}") from None


def check_driver(driver: Driver, *, seed: int = 0, steps: int = 50) -> None:
    """Check that a driver keeps the promises of `Driver`. It moves the robot: random actions within the bounds!

    Args:
        driver: it is reset, if it can be, and gets `steps` actions, until an episode ends.
        seed: of the reset and of the actions.

    Raises:
        ContractError: naming the broken clause.
        DriverFailed: it raises something of its own.
    """
    try:
        _check_driver(driver, seed, steps)
    except TutelageError:
        raise
    except Exception as error:
        with contextlib.suppress(Exception):
            driver.hold()
        raise DriverFailed(f"the driver {type(driver).__name__} failed: {told(error)}") from error


def _check_driver(driver: Driver, seed: int, steps: int) -> None:
    name = type(driver).__name__
    _demand(isinstance(driver, Driver), f"{name} is no driver; it needs get_observation, send_action, hold and the spaces")
    describe(driver, 0.1)
    reset, rng = getattr(driver, "reset", None), np.random.default_rng(seed)
    if reset is not None:
        reset(False, seed)
        for flag in ("violation", "success", "truncated"):
            _demand(not _flag(driver, name, flag), f"{name}.{flag}() must be False after a reset")
    box = driver.action_space
    _check_observation(driver, name)
    for _ in range(steps):
        action = rng.uniform(box.low, box.high).astype(np.float32)
        kept = action.copy()
        driver.send_action(action)
        _demand(np.array_equal(action, kept), f"{name}.send_action changes the action that it is given; work on a copy")
        _check_observation(driver, name)
        flags = [_flag(driver, name, flag) for flag in ("violation", "success", "truncated")]
        _demand(not (flags[0] and flags[1]), f"{name}: a robot in violation cannot be a success")
        reward = getattr(driver, "reward", float)()
        _demand(bool(np.isfinite(reward)), f"{name}.reward() must be a finite number, got {reward!r}")
        if any(flags):
            driver.send_action(action)
            again = [_flag(driver, name, flag) for flag in ("violation", "success", "truncated")]
            _demand(again == flags, f"{name}: what ended an episode must be said until the next reset")
            break
    for _ in range(3):
        driver.hold()
        _check_observation(driver, name)
    if hasattr(driver, "stop"):
        driver.stop()
        driver.stop()
        _check_observation(driver, name)
        getattr(driver, "release", lambda: None)()
    cameras: Any = getattr(driver, "cameras", dict)()
    _demand(isinstance(cameras, Mapping) and len(cameras) <= MAX_CAMERAS, f"{name}.cameras() must be at most {MAX_CAMERAS}")
    for camera, grab in cameras.items():
        picture = grab()
        good = isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
        _demand(good, f"{name}: camera {camera!r} must give (height, width, 3) uint8")
    if reset is not None:
        reset(True, None)
        _demand(not _flag(driver, name, "violation"), f"{name}: a hard reset must end a violation")
        _check_observation(driver, name)


def observation_of(driver: Driver) -> Array:
    """What it sees, checked.

    Raises:
        ContractError: another shape or type than the space says, or a number that is not finite.
    """
    obs = np.asarray(driver.get_observation())
    space = driver.observation_space
    if obs.shape != space.shape or obs.dtype != space.dtype:
        kind = type(driver).__name__
        raise ContractError(f"{kind} must observe {space.shape} {space.dtype}, got {obs.shape} {obs.dtype}")
    if obs.dtype.kind == "f" and not np.isfinite(obs).all():
        raise ContractError(f"{type(driver).__name__} observed a number that is not finite")
    return obs


def _check_observation(driver: Driver, name: str) -> None:
    first = observation_of(driver)
    kept = first.copy()
    observation_of(driver)
    _demand(np.array_equal(first, kept), f"{name}.get_observation overwrites what it returned before; return new arrays")


def _flag(driver: Driver, name: str, flag: str) -> bool:
    value = getattr(driver, flag, bool)()
    _demand(isinstance(value, bool | np.bool_), f"{name}.{flag}() must be a bool, got {value!r}")
    return bool(value)


def _demand(clause: bool, message: str) -> None:
    if not clause:
        raise ContractError(message)
