"""Which commands a robot executes: the newest, while the observation that it answers is younger than the watchdog."""

from __future__ import annotations

import numpy as np
import pytest

from tutelage.remote.gate import CommandGate
from tutelage.remote.messages import Command, Order
from tutelage.remote.wire import pack_command

BOOT, SERVER, WATCHDOG = 7, 70, 0.5


def command(
    number: int, answers: int, *, boot: int = BOOT, server: int = SERVER, order: Order = Order.ACT, width: int = 2
) -> bytes:
    action = np.full(width if order & Order.ACT else 0, number, np.float32)
    return pack_command(Command(server, number, boot, answers, order, 0, 0.1, action))


@pytest.fixture
def gate() -> CommandGate:
    """Of a robot that sent observation k at k tenths of a second, ten of them."""
    made = CommandGate(BOOT, 2, WATCHDOG)
    for number in range(1, 11):
        made.observed(number, number / 10)
    return made


def test_a_command_is_fresh_while_its_observation_is(gate: CommandGate) -> None:
    assert gate.take(command(1, 10), 1.1)
    assert gate.until == 1.5  # half a second after the observation, however late the command came
    found = gate.current(1.49)
    assert found is not None
    assert found.number == 1
    assert gate.current(1.5) is None


def test_the_newest_wins(gate: CommandGate) -> None:
    assert gate.take(command(2, 10), 1.1)
    assert not gate.take(command(1, 9), 1.1)  # overtaken
    assert not gate.take(command(2, 10), 1.1)  # twice
    assert gate.counts["replaced"] == 2
    assert gate.take(command(3, 10, order=Order(0)), 1.2)  # hold
    assert not gate.current(1.2).order & Order.ACT


@pytest.mark.parametrize(
    ("late", "reason"),
    [
        (command(1, 5), "stale"),  # answers what the robot saw half a second ago
        (command(1, 10, boot=8), "other_start"),  # meant for the robot before it was switched off and on
        (command(1, 99), "unknown"),  # answers what the robot never sent
        (command(1, 10, width=3), "shape"),
        (command(1, 10)[:-1], "malformed"),
        (b"", "malformed"),
    ],
)
def test_what_is_no_fresh_command_for_this_robot_is_dropped_and_counted(gate: CommandGate, late: bytes, reason: str) -> None:
    assert not gate.take(late, 1.1)
    assert gate.counts[reason] == 1
    assert gate.current(1.1) is None


def test_commands_for_the_episode_before_are_dropped(gate: CommandGate) -> None:
    assert gate.take(command(1, 10), 1.1)
    gate.observed(11, 1.2, new_episode=True)
    assert gate.current(1.2) is None
    assert not gate.take(command(2, 10), 1.2)
    assert gate.counts["other_episode"] == 1
    assert gate.take(command(3, 11), 1.3)


def test_a_server_that_started_again_is_followed_and_the_one_before_is_not(gate: CommandGate) -> None:
    assert gate.take(command(500, 9), 1.0)
    assert gate.take(command(1, 10, server=71), 1.1)
    assert (gate.server, gate.heard) == (71, 1)
    assert not gate.take(command(501, 9), 1.1)  # still on its way when its server ended
    assert gate.current(1.1).server == 71


def test_memory_is_bounded() -> None:
    gate = CommandGate(BOOT, 2, WATCHDOG)
    for number in range(1, 5000):
        gate.observed(number, number / 10)
        gate.take(command(number, number, server=number), number / 10)
    assert len(gate._observed) < 60
    assert len(gate._newest) <= 16
