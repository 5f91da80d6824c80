"""The messages between robots and server, as objects; `wire` turns them into bytes and back.

No field is a time of day. A robot finds out how old a command is from the number of the observation that it answers, which
the robot sent itself, and a server how long a robot takes to answer from the number of the command that it last heard. So
clocks need not agree.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import Any

from numpy.typing import NDArray

from tutelage.errors import TutelageError

Array = NDArray[Any]

MAX_ARRAY = 16 << 20
"""Bytes of the largest array."""
MAX_PICTURE = 4 << 20
"""Bytes of the largest picture, compressed."""
MAX_WEIGHTS = 128 << 20
"""Bytes of the weights of a policy."""
MAX_SIDE = 8192
"""Pixels of the longest side of a picture."""
MAX_CAMERAS = 16
MAX_TEXT = 64 << 10


class Malformed(TutelageError):
    """Bytes that are no message of this protocol."""


class Flag(IntFlag):
    """The state of a robot, in its observations. All of them last until the episode ends or the state changes, so none is
    missed when a message is."""

    VIOLATION = 1  # c(s) = 1; stands still until it is reset
    SUCCESS = 2  # the task is complete; stands still until it is reset
    TRUNCATED = 4  # the episode has ended otherwise; likewise
    HELD = 8  # stands still, as there is no fresh command
    STOPPED = 16  # the emergency stop is latched
    RESETTING = 32  # a reset is going on, and this is not yet the observation after it
    FAULT = 64  # the driver failed lately


class Order(IntFlag):
    """What a command says beside the action."""

    ACT = 1  # execute the action; without it: hold
    HUMAN = 2  # the action is a human's
    OWN = 4  # execute what the policy on the robot says


class Operation(IntEnum):
    """What a robot's service is asked to do."""

    DESCRIBE = 0
    SOFT_RESET = 1
    HARD_RESET = 2


class StopOperation(IntEnum):
    """What the emergency stop's lane says."""

    STOP = 1
    CLEAR = 2


@dataclass(frozen=True, slots=True)
class Observation:
    """What a robot sees, and how it is.

    Attributes:
        boot: 64 random bits of this start of the robot.
        number: of this observation, counted from 1 since the start.
        episode: counted from 1 since the start.
        step: timesteps of the episode so far.
        flags: the robot's state.
        server, heard: start and number of the newest command that arrived, whether it was executed or not; 0: none.
        executed: number of the newest command of that start that decided what the robot does, moving or holding; 0: none.
        waited: seconds from the arrival of that command to the sending of this, on the robot's clock.
        episode_return: sum of the rewards of the episode.
        stale, refused: commands that came too late, and messages that were no commands for this robot; since the start.
        policy: version of the policy on the robot; 0: none.
        obs: what is observed, of the described shape and type.
        proposal: (A,) float32, what the policy on the robot would do, if there is one.
    """

    boot: int
    number: int
    episode: int
    step: int
    flags: Flag
    server: int
    heard: int
    executed: int
    waited: float
    episode_return: float
    stale: int
    refused: int
    policy: int
    obs: Array
    proposal: Array | None = None


@dataclass(frozen=True, slots=True)
class Command:
    """What a robot shall do until its next command.

    Attributes:
        server: 64 random bits of this start of the server.
        number: of this command, counted from 1 since the start.
        boot, answers: start of the robot and number of the observation that this answers; the robot drops it when that
            observation is too old.
        order: what kind of command. watch: a bit for each camera whose pictures are wanted.
        period: seconds until the next command is to be expected.
        action: (A,) float32; empty where there is nothing to execute.
    """

    server: int
    number: int
    boot: int
    answers: int
    order: Order
    watch: int
    period: float
    action: Array


@dataclass(frozen=True, slots=True)
class Stop:
    """The emergency stop, or its end. Repeated until the robot's observations show it."""

    server: int
    number: int
    operation: StopOperation


@dataclass(frozen=True, slots=True)
class Ask:
    """A request to a robot. The same server and number again is the same request.

    Attributes:
        seed: for the new episode, or None.
    """

    server: int
    number: int
    operation: Operation
    seed: int | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """A robot's answer: a reset is accepted, and will end in an episode later than this one.

    Attributes:
        accepted: False: not now (the emergency stop is latched).
    """

    accepted: bool
    boot: int
    episode: int


@dataclass(frozen=True, slots=True)
class Picture:
    """What a camera sees, as JPEG.

    Attributes:
        camera: index in the description. width, height: pixels.
    """

    boot: int
    number: int
    camera: int
    width: int
    height: int
    jpeg: bytes


@dataclass(frozen=True, slots=True)
class Weights:
    """Weights of the policy, from the server; and, without data, the question of a robot that has this version (0: none).

    Attributes:
        data: a safetensors file; empty: the robot has the newest already.
    """

    version: int
    data: bytes


@dataclass(frozen=True)
class Description:
    """What a robot is; all robots of a fleet are alike.

    Attributes:
        shape, dtype: of an observation; dtype is float32, float64 or uint8.
        action_low, action_high: bounds of an action.
        horizon: timesteps of an episode.
        task: its name, "" for none.
        goal: whether success means reaching a goal state.
        dt: seconds of a timestep of the robot.
        cameras: names.
    """

    shape: tuple[int, ...]
    dtype: str
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    horizon: int = 1000
    task: str = ""
    goal: bool = False
    dt: float = 0.1
    cameras: tuple[str, ...] = ()

    def matches(self, other: Description) -> bool:
        """Can the two be in one fleet: same observations, same actions, same task?"""
        return (self.shape, self.dtype, self.action_low, self.action_high, self.task) == (
            other.shape, other.dtype, other.action_low, other.action_high, other.task
        )  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """As plain values; `from_json` reads them."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()}

    @classmethod
    def from_json(cls, table: Any) -> Description:
        """Read and check.

        Raises:
            Malformed: naming the field.
        """
        if not isinstance(table, Mapping) or set(table) != set(cls.__dataclass_fields__):
            raise Malformed("a description with other fields")

        def check(name: str, good: bool) -> None:
            if not good:
                raise Malformed(f"a description whose {name} is impossible")

        def numbers(name: str, least: int, most: int, *kinds: type) -> tuple[Any, ...]:
            value = table[name]
            check(name, isinstance(value, list) and least <= len(value) <= most and all(type(x) in kinds for x in value))
            return tuple(value)

        shape = numbers("shape", 1, 4, int)
        check("shape", all(0 < size <= MAX_ARRAY for size in shape) and math.prod(shape) <= MAX_ARRAY // 8)
        check("dtype", table["dtype"] in ("float32", "float64", "uint8"))
        low, high = (tuple(map(float, numbers(name, 1, 4096, int, float))) for name in ("action_low", "action_high"))
        finite = all(map(math.isfinite, (*low, *high)))
        check("action_low", finite and len(low) == len(high) and all(map(float.__lt__, low, high)))
        check("horizon", type(table["horizon"]) is int and 0 < table["horizon"] < 1 << 31)
        check("task", isinstance(table["task"], str) and len(table["task"]) <= 200)
        check("goal", isinstance(table["goal"], bool))
        check("dt", type(table["dt"]) in (int, float) and 0 < table["dt"] < 1e4)
        cameras = numbers("cameras", 0, MAX_CAMERAS, str)
        check("cameras", all(0 < len(name) <= 40 for name in cameras) and len(set(cameras)) == len(cameras))
        return cls(
            shape, table["dtype"], low, high, table["horizon"], table["task"], table["goal"], float(table["dt"]), cameras
        )


@dataclass
class Counts:
    """How often something was refused, by reason; for one thread, or where a lost count does no harm."""

    by_reason: Counter[str] = field(default_factory=Counter)

    def add(self, reason: str) -> None:
        """Count."""
        self.by_reason[reason] += 1

    def __getitem__(self, reason: str) -> int:
        return self.by_reason[reason]

    def total(self) -> int:
        """All of them."""
        return self.by_reason.total()
