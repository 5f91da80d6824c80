"""What the terminal of `tutelage serve` says while it runs: robots out of reach, emergency stops, troubles."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tutelage.console.states import Notice, Snapshot, Stepped, Told

SETTLED = 1.0
"""Seconds for which something must be so before it is said: links that come and go would fill the terminal."""
ONE_BY_ONE = 3
"""Robots that are named; of more that change at once their number is said."""


class Terminal:
    """Listens to what happens and says what somebody at the server should know.

    Args:
        names: of the robots.
        say: takes a line.
    """

    def __init__(self, names: Sequence[str], say: Callable[[str], None]) -> None:
        self._names, self._say = names, say
        self._reached = _Settled(True, len(names))
        self._stopped = _Settled(False, len(names))

    def hear(self, event: Told) -> None:
        """A listener of the herald's."""
        if isinstance(event, Stepped):
            self._look(event.snapshot)
        elif isinstance(event, Notice) and event.level != "info":
            self._say(event.text)

    def _look(self, now: Snapshot) -> None:
        # A robot that is stopped is not online to the loop, though it may well be in reach.
        for changed, yes, no in (
            (self._reached.changes((now.online | now.stopped).tolist(), now.time), "in reach again", "out of reach"),
            (self._stopped.changes(now.stopped.tolist(), now.time), "emergency stop", "the stop is cleared"),
        ):
            for value, what in ((True, yes), (False, no)):
                robots = [self._names[k] for k, new in changed if new is value]
                if len(robots) > ONE_BY_ONE:
                    robots = [f"{len(robots)} robots"]
                for name in robots:
                    self._say(f"{name}: {what}")


class _Settled:
    """Values of robots, and which of them are others for a while already."""

    def __init__(self, value: bool, robots: int) -> None:
        self._values = [value] * robots
        self._since: dict[int, float] = {}

    def changes(self, values: Sequence[bool], now: float) -> list[tuple[int, bool]]:
        """Robots with a new value that has settled."""
        found = []
        for k, value in enumerate(values):
            if value == self._values[k]:
                self._since.pop(k, None)
            elif now - self._since.setdefault(k, now) >= SETTLED:
                self._values[k] = value
                found.append((k, value))
        return found
