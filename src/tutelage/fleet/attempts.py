"""Episodes one by one: who acted in each, how often a human stepped in, and how it ended (sections 3.3 and 3.5)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tutelage.fleet.metrics import EventLog, intervals, switches_to_human
from tutelage.fleet.modes import Event, Mode

Array = NDArray[Any]

ENDS = (Event.SUCCESS, Event.TIMEOUT, Event.VIOLATE)
"""What ends an episode."""


class Attempts(NamedTuple):
    """n episodes that ended, in the order in which they did. All (n,) int64, `outcome` an `Event` of `ENDS`.

    robot: index. start: first timestep; end: the timestep after the last. interventions: stretches of human control.
    human_actions, robot_actions: timesteps with an action of the human, and of the robot's policy.
    """

    robot: Array
    start: Array
    end: Array
    outcome: Array
    interventions: Array
    human_actions: Array
    robot_actions: Array

    def where(self, mask: Array) -> Attempts:
        """The episodes of the mask (n,) bool."""
        return Attempts(*(column[mask] for column in self))


def attempts(log: EventLog) -> Attempts:
    """The episodes of a log that ended. One begins at 0, after a success or a timeout, or after a hard reset."""
    events = log.events.of(*ENDS, Event.HARD_RESET)
    order = np.lexsort((events.t, events.robot))
    robot, t, kind = events.robot[order], events.t[order] + 1, events.event[order]
    first = np.diff(robot, prepend=-1) != 0
    start = np.where(first, 0, np.roll(t, 1))
    ended = kind != Event.HARD_RESET
    robot, start, end, kind = robot[ended], start[ended], t[ended], kind[ended]

    spans = intervals(log)
    human, own = (spans.where(spans.mode == mode) for mode in (Mode.TELEOPERATED, Mode.AUTONOMOUS))
    counts = np.zeros((3, len(robot)), dtype=np.int64)
    for k in range(log.num_robots):
        mine = np.flatnonzero(robot == k)
        for row, part in ((1, human), (2, own)):
            one = part.where(part.robot == k)
            overlap = _overlap(start[mine], end[mine], one.start, one.end)
            counts[row, mine] = overlap.sum(axis=1)
            if row == 1:
                counts[0, mine] = (overlap > 0).sum(axis=1)
    order = np.lexsort((robot, end))
    return Attempts(*(column[order] for column in (robot, start, end, kind, *counts)))


def request_rate(log: EventLog) -> float:
    """Interventions per timestep in which a robot acted by itself: what alpha_h of section 3.4 is a budget for."""
    spans = intervals(log)
    own = int(spans.length[spans.mode == Mode.AUTONOMOUS].sum())
    return switches_to_human(log) / own if own else 0.0


def _overlap(start: Array, end: Array, other_start: Array, other_end: Array) -> Array:
    """Timesteps that stretches (n,) and others (m,) have in common, (n, m)."""
    common = np.minimum(end[:, None], other_end) - np.maximum(start[:, None], other_start)
    return np.asarray(np.clip(common, 0, None))
