"""What a robot is doing, and the one table of what may happen next.

`TABLE[mode, event]` is the mode after the event, or `INVALID`. The loop, the event log and the metrics use nothing else.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ContractError

Array = NDArray[Any]


class Mode(IntEnum):
    """The state of a robot during a timestep."""

    AUTONOMOUS = 0
    """Executes its own policy."""
    SWITCHING = 1
    """A human is assigned and on the way (switching latency L, or a person who has not accepted yet); it is paused."""
    TELEOPERATED = 2
    """Executes the human's actions."""
    VIOLATED = 3
    """c(s) = 1: stands still until a human resets it."""
    RESETTING = 4
    """A human is performing the hard reset R, which takes t_R timesteps."""
    OFFLINE = 5
    """Not reachable."""


class Event(IntEnum):
    """What happens to a robot: at the end of the step if it is one of `END_OF_STEP`, otherwise before the step."""

    ASSIGN = 0
    """The allocation gives the robot to a human."""
    TAKE_OVER = 1
    """The human starts to teleoperate."""
    START_RESET = 2
    """The human starts a hard reset."""
    RELEASE = 3
    """The allocation takes the human away from a robot that can go on by itself."""
    DISCONNECT = 4
    """The robot cannot be reached, or is stopped; whoever was with it is free."""
    CONNECT = 5
    """It can be reached again and goes on by itself."""
    VIOLATE = 6
    """The step ended in c(s) = 1."""
    HARD_RESET = 7
    """The hard reset is complete; the robot is back in an initial state."""
    SUCCESS = 8
    """The task was completed; the robot starts a new episode by itself (soft reset)."""
    TIMEOUT = 9
    """The horizon was reached without success; likewise."""
    ABANDON = 10
    """The allocation takes the human away from a robot in violation, before its hard reset is complete."""
    CONNECT_VIOLATED = 11
    """It can be reached again, and c(s) = 1."""


END_OF_STEP = (Event.VIOLATE, Event.HARD_RESET, Event.SUCCESS, Event.TIMEOUT)
"""Events at the end of step t, whose mode holds from t + 1."""

INVALID = -1
A, S, T, V, R, O = Mode  # noqa: E741 - a table is read by its shape
_ROWS: dict[Mode, dict[Event, Mode]] = {
    A: {Event.ASSIGN: S, Event.VIOLATE: V, Event.SUCCESS: A, Event.TIMEOUT: A, Event.DISCONNECT: O},
    # Whether c(s) = 1 decides between TAKE_OVER and START_RESET, RELEASE and ABANDON, CONNECT and CONNECT_VIOLATED: who has
    # fallen never acts. A person may also reset a robot that has not fallen and is stuck.
    S: {Event.TAKE_OVER: T, Event.START_RESET: R, Event.RELEASE: A, Event.ABANDON: V, Event.VIOLATE: V, Event.DISCONNECT: O},
    T: {Event.RELEASE: A, Event.START_RESET: R, Event.VIOLATE: V, Event.SUCCESS: T, Event.TIMEOUT: T, Event.DISCONNECT: O},
    V: {Event.ASSIGN: S, Event.DISCONNECT: O},
    R: {Event.HARD_RESET: A, Event.ABANDON: V, Event.DISCONNECT: O},
    O: {Event.CONNECT: A, Event.CONNECT_VIOLATED: V},
}
TABLE: NDArray[np.int8] = np.full((len(Mode), len(Event)), INVALID, dtype=np.int8)
for _mode, _row in _ROWS.items():
    for _event, _next in _row.items():
        TABLE[_mode, _event] = _next

HELPED = np.isin(np.arange(len(Mode)), [S, T, R])
"""`HELPED[mode]`: whether a human's time is spent on a robot in that mode (alpha = 1 in eq. 5.1)."""
MOVING = np.isin(np.arange(len(Mode)), [A, T])
"""`MOVING[mode]`: whether physics goes on for a robot in that mode."""
IDLE = np.isin(np.arange(len(Mode)), [V, R])
"""`IDLE[mode]`: whether the robot waits for a hard reset or for its end."""


def transition(modes: Array, robots: Array, event: Event) -> Array:
    """The modes of the given robots (indices) after the event.

    Raises:
        ContractError: the event is not possible in a robot's present mode.
    """
    after: Array = TABLE[modes[robots], event]
    if (after == INVALID).any():
        robot = int(robots[np.argmax(after == INVALID)])
        raise ContractError(f"robot {robot} is {Mode(modes[robot]).name}: {event.name} cannot happen to it")
    return after
