"""Which command a robot may execute, and until when. Bookkeeping without clock, threads or network: time is passed in.

A command says which observation it answers, and the robot knows when it sent that one. A command is fresh while that
observation is younger than the watchdog, so whatever is slow on the way (network, server, a person) counts, and no two
clocks are compared.
"""

from __future__ import annotations

from collections import OrderedDict

from tutelage.remote.messages import Command, Counts, Malformed, Order
from tutelage.remote.wire import unpack_command

SERVERS = 16
"""Starts of servers that are remembered."""


class CommandGate:
    """Takes what arrives on the command lane, gives the newest command that is fresh. Times in seconds of one clock.

    Attributes:
        counts: commands that were dropped, by reason: malformed, shape, other_start, unknown, other_episode, replaced,
            stale.
        server, heard, heard_at: start and number of the newest genuine command, and when it came; 0: none.
        period: seconds until the server's next command, as it says.
        watch: the cameras that it wants, a bit each.
    """

    def __init__(self, boot: int, width: int, watchdog: float) -> None:
        """
        Args:
            boot: this start of the robot.
            width: A, numbers of an action.
            watchdog: seconds.
        """
        self.counts = Counts()
        self.server = self.heard = 0
        self.heard_at = float("-inf")
        self.period, self.watch = 0.0, 0
        self._boot, self._width, self._watchdog = boot, width, watchdog
        self._observed: OrderedDict[int, float] = OrderedDict()
        self._first = 1  # observation of the present episode
        self._answered = 0
        self._newest: OrderedDict[int, int] = OrderedDict()  # server -> number
        self._command: Command | None = None
        self._until = float("-inf")

    def observed(self, number: int, now: float, new_episode: bool = False) -> None:
        """The robot observes, and will send this number; commands for an earlier episode are worth nothing now."""
        self._observed[number] = now
        if new_episode:
            self._first, self._command = number, None
        while len(self._observed) > 2 and now - next(iter(self._observed.values())) > 10 * self._watchdog:
            self._observed.popitem(last=False)

    def take(self, data: bytes, now: float) -> bool:
        """A message came on the lane. Is it a command to be executed (or a fresh order to hold)?"""
        try:
            command = unpack_command(data)
        except Malformed:
            return self._drop("malformed")
        if command.boot != self._boot:
            return self._drop("other_start")
        sent = self._observed.get(command.answers)
        if sent is None:
            return self._drop("stale" if 0 < command.answers < next(iter(self._observed), 0) else "unknown")
        if len(command.action) != (self._width if command.order & Order.ACT and not command.order & Order.OWN else 0):
            return self._drop("shape")
        if command.number <= self._newest.get(command.server, 0) or command.answers < self._answered:
            return self._drop("replaced")
        self._newest[command.server], self._answered = command.number, command.answers
        self._newest.move_to_end(command.server)
        while len(self._newest) > SERVERS:
            self._newest.popitem(last=False)
        self.server, self.heard, self.heard_at = command.server, command.number, now
        self.period, self.watch = command.period, command.watch
        if command.answers < self._first:
            return self._drop("other_episode")
        if now - sent >= self._watchdog:
            return self._drop("stale")
        self._command, self._until = command, sent + self._watchdog
        return True

    def current(self, now: float) -> Command | None:
        """The newest command, while it is fresh."""
        return self._command if now < self._until else None

    @property
    def until(self) -> float:
        """When the command stops being fresh."""
        return self._until if self._command is not None else float("-inf")

    def _drop(self, reason: str) -> bool:
        self.counts.add(reason)
        return False
