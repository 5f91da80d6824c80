"""The event log: what happened to which robot, when, and by whom. Every metric is a function of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tutelage.fleet.modes import Event

Array = NDArray[Any]


class Events(NamedTuple):
    """n events as columns, in the order in which they happened.

    t: timestep; robot; human: index, or -1 for none; event: an `Event`; mode: the robot's `Mode` after it. All (n,) int.
    """

    t: Array
    robot: Array
    human: Array
    event: Array
    mode: Array

    @classmethod
    def concatenate(cls, parts: list[Events]) -> Events:
        """All events of the parts, in order."""
        if not parts:
            return cls(*(np.empty(0, dtype=np.int64) for _ in cls._fields))
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def of(self, *events: Event) -> Events:
        """The events of the given kinds."""
        mask = np.isin(self.event, events)
        return Events(*(column[mask] for column in self))


@dataclass
class Journal:
    """Collects the events of a step."""

    t: int = 0
    parts: list[Events] = field(default_factory=list)

    def add(self, event: Event, robots: Array, humans: Array | int, modes: Array) -> None:
        """Note an event of some robots (indices)."""
        n = len(robots)
        if n:
            self.parts.append(
                Events(np.full(n, self.t), np.asarray(robots), np.full(n, humans, dtype=np.int64),
                       np.full(n, int(event)), np.asarray(modes, dtype=np.int64))
            )  # fmt: skip

    def take(self) -> Events:
        """The events so far; the journal is empty afterwards."""
        events, self.parts = Events.concatenate(self.parts), []
        return events
