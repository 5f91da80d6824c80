"""Event logs as random walks through the table of modes, and their replay, one event at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from tutelage.fleet.events import Events
from tutelage.fleet.metrics import EventLog
from tutelage.fleet.modes import END_OF_STEP, INVALID, TABLE, Event, Mode

Array = NDArray[Any]
Row = tuple[int, int, int, Event, Mode]
A, S, T, V, R, O = Mode  # noqa: E741 - as in the table of modes


def make_log(rows: list[Row], robots: int, humans: int, steps: int) -> EventLog:
    """The log of these events: t, robot, human, event, mode."""
    columns = np.array(rows, dtype=np.int64).reshape(-1, 5).T
    return EventLog(Events(*columns), robots, humans, steps)


@st.composite
def logs(draw: st.DrawFn) -> EventLog:
    """Random walks through the table of modes: several events a step, before it and at its end."""
    robots, humans, steps = draw(st.integers(1, 4)), draw(st.integers(1, 3)), draw(st.integers(0, 12))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    mode = [A] * robots
    rows: list[Row] = []
    for t in range(steps):
        for late in (False, True):
            for robot in rng.permutation(robots):
                for _ in range(rng.integers(0, 2 if late else 4)):
                    possible = [e for e in Event if TABLE[mode[robot], e] != INVALID and (e in END_OF_STEP) == late]
                    if possible:
                        event = possible[rng.integers(len(possible))]
                        mode[robot] = Mode(TABLE[mode[robot], event])
                        rows.append((t, int(robot), int(rng.integers(-1, humans)), event, mode[robot]))
    return make_log(rows, robots, humans, steps)


def replay(log: EventLog) -> tuple[Array, Array]:
    """The mode and the violation of each robot during each step, (T, N), one event at a time."""
    rows = list(zip(*(column.tolist() for column in log.events), strict=True))
    mode, violated = [A] * log.num_robots, [False] * log.num_robots
    modes, broken = np.empty((log.steps, log.num_robots), int), np.empty((log.steps, log.num_robots), bool)
    for t in range(log.steps):
        for late in (False, True):
            if late:
                modes[t], broken[t] = mode, violated
            for when, robot, _, event, after in rows:
                if when == t and (event in END_OF_STEP) == late:
                    mode[robot] = Mode(after)
                    # c(s) = 1 begins with a violation; resets, and all that leads back to autonomy, end it
                    violated[robot] = after in (V, R) or (after == S and violated[robot])
    return modes, broken
