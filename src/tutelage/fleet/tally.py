"""The metrics while the loop runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tutelage.fleet.metrics import HumanTime, modes_before, rohe_of
from tutelage.fleet.modes import IDLE, Event, Mode
from tutelage.fleet.step import Step

if TYPE_CHECKING:
    from tutelage.fleet.loop import Loop


class Tally:
    """The metrics of a run so far, step by step, in O(N) a step and without keeping the log.

    Args:
        num_robots: N.
        num_humans: M.
    """

    def __init__(self, num_robots: int, num_humans: int) -> None:
        self.num_robots, self.num_humans = num_robots, num_humans
        self.t = 0
        self.reward = 0.0
        self.events = np.zeros(len(Event), dtype=np.int64)
        self.time = np.zeros(len(Mode), dtype=np.int64)
        self.idle_time = 0
        self.switches_to_robot = 0
        self._mode = np.full(num_robots, Mode.AUTONOMOUS, dtype=np.int64)
        self._broken = np.zeros(num_robots, dtype=np.bool_)  # for robots that are switching: were they violated before?

    def update(self, step: Step) -> None:
        """Add the timestep that follows the last one."""
        events = step.events
        before = modes_before(events, self._mode)
        assigned = events.event == Event.ASSIGN
        self._broken[events.robot[assigned]] = before[assigned] == Mode.VIOLATED
        self._mode[events.robot] = events.mode  # where a robot occurs twice, the last event wins

        self.t = step.t + 1
        self.reward += float(np.sum(step.reward))
        self.events += np.bincount(events.event, minlength=len(Event))
        self.time += np.bincount(step.mode, minlength=len(Mode))
        self.idle_time += int(np.count_nonzero(IDLE[step.mode] | ((step.mode == Mode.SWITCHING) & self._broken)))
        self.switches_to_robot += int(np.count_nonzero((before == Mode.TELEOPERATED) & (events.mode != Mode.TELEOPERATED)))

    def summary(self) -> dict[str, float]:
        """The cumulative metrics by name, as plain numbers: `metrics.summary` of the log, and the sum of the rewards."""
        count = {event: int(n) for event, n in zip(Event, self.events, strict=True)}
        time = {mode: int(n) for mode, n in zip(Mode, self.time, strict=True)}
        human = HumanTime(time[Mode.TELEOPERATED], time[Mode.RESETTING], time[Mode.SWITCHING])
        return {
            "t": self.t,
            "successes": count[Event.SUCCESS],
            "violations": count[Event.VIOLATE],
            "hard_resets": count[Event.HARD_RESET],
            "timeouts": count[Event.TIMEOUT],
            "idle_time": self.idle_time,
            "human_time": human.total,
            **human._asdict(),
            "switches_to_human": count[Event.TAKE_OVER],
            "switches_to_robot": self.switches_to_robot,
            "rohe": rohe_of(self.num_humans, self.num_robots, count[Event.SUCCESS], human.total),
            "reward": self.reward,
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as arrays and JSON values."""
        return {
            "t": self.t,
            "reward": self.reward,
            "events": self.events.copy(),
            "time": self.time.copy(),
            "idle_time": self.idle_time,
            "switches_to_robot": self.switches_to_robot,
            "mode": self._mode.copy(),
            "broken": self._broken.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        for name in ("t", "reward", "idle_time", "switches_to_robot"):
            setattr(self, name, state[name])
        self.events[:] = 0
        self.events[: len(state["events"])] = state["events"]  # a checkpoint that is older than an event does not count it
        self.time = state["time"].copy()
        self._mode, self._broken = state["mode"].copy(), state["broken"].copy()


class Counting:
    """A subscriber that keeps a tally."""

    def __init__(self, tally: Tally) -> None:
        self.tally = tally

    def on_start(self, loop: Loop) -> None:
        """Nothing to do."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """Count the step."""
        self.tally.update(step)

    def on_end(self, loop: Loop) -> None:
        """Nothing to do."""
