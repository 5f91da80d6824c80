"""What the server's terminal says of its robots."""

from __future__ import annotations

from typing import Any

import numpy as np

from tutelage.console.states import Notice, Snapshot, Stepped
from tutelage.console.terminal import Terminal

NAMES = [f"robot-{k + 1}" for k in range(6)]


def look(time: float, gone: tuple[int, ...] = (), stopped: tuple[int, ...] = ()) -> Stepped:
    some: Any = np.zeros(6)
    online, stop = (np.isin(np.arange(6), robots) for robots in (gone, stopped))
    return Stepped(
        None, Snapshot(0, time, some, some, some, ("",) * 6, some, ~online, stop, some, (), {}, 0, 0.0, 0.0)
    )  # fmt: skip


def test_robots_out_of_reach_are_named_when_it_has_settled() -> None:
    said: list[str] = []
    terminal = Terminal(NAMES, said.append)
    for time, gone in ((0.0, ()), (0.5, (1,)), (1.0, ()), (1.2, (1,)), (2.0, (1,))):
        terminal.hear(look(time, gone))
    assert said == []
    for time, gone in ((2.3, (1,)), (3.0, (1,)), (3.1, ()), (4.2, ())):
        terminal.hear(look(time, gone))
    assert said == ["robot-2: out of reach", "robot-2: in reach again"]


def test_a_stopped_robot_is_not_called_out_of_reach() -> None:
    said: list[str] = []
    terminal = Terminal(NAMES, said.append)
    for time, robots in ((0.0, (1,)), (1.0, (1,)), (2.0, ()), (3.0, ())):
        terminal.hear(look(time, gone=robots, stopped=robots))
    assert said == ["robot-2: emergency stop", "robot-2: the stop is cleared"]


def test_many_robots_are_counted() -> None:
    said: list[str] = []
    terminal = Terminal(NAMES, said.append)
    for time in (0.0, 1.0, 2.0):
        terminal.hear(look(time, gone=(0, 1, 2, 3), stopped=(4, 5)))
    assert said == ["4 robots: out of reach", "robot-5: emergency stop", "robot-6: emergency stop"]


def test_troubles_are_said_and_news_are_not() -> None:
    said: list[str] = []
    terminal = Terminal(NAMES, said.append)
    terminal.hear(Notice(None, "error", "robots are held"))
    terminal.hear(Notice(None, "info", "robots go on"))
    assert said == ["robots are held"]
