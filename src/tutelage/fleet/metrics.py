"""What a run achieved and what it cost: ROHE, burden, idle time (sections 2.3, 3.3, 5.3 and 5.6).

Every number is a pure function of the event log; `tutelage.fleet.tally` computes the same numbers while the loop runs. Time
is counted in timesteps; summed over robots it is robot-timesteps, and because a human is with one robot at a time,
robot-timesteps with a human are human timesteps too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ContractError
from tutelage.fleet.events import Events
from tutelage.fleet.modes import END_OF_STEP, HELPED, IDLE, TABLE, Event, Mode

Array = NDArray[Any]

HUMAN_TIME_UNIT = 100
"""Timesteps in a unit of human time in the ROHE: section 5.6 measures it "in hundreds of timesteps"."""


@dataclass(frozen=True)
class EventLog:
    """All events of a run's first `steps` timesteps.

    Attributes:
        events: in the order in which they happened.
        num_robots: N.
        num_humans: M.
        steps: T, completed timesteps.

    Raises:
        ContractError: the events cannot be those of such a run.
    """

    events: Events
    num_robots: int
    num_humans: int
    steps: int

    def __post_init__(self) -> None:
        events = self.events
        ranges = {
            "t": (events.t, 0, self.steps),
            "robot": (events.robot, 0, self.num_robots),
            "human": (events.human, -1, self.num_humans),
            "event": (events.event, 0, len(Event)),
            "mode": (events.mode, 0, len(Mode)),
        }
        for name, (column, low, high) in ranges.items():
            if len(column) != len(events.t):
                raise ContractError(f"the columns t and {name} of the events differ in length")
            outside = (column < low) | (column >= high)
            if outside.any():
                k = int(np.argmax(outside))
                raise ContractError(f"event {k}: {name} is {column[k]}, outside {low}..{high - 1}")
        if (np.diff(events.t) < 0).any():
            raise ContractError(f"event {int(np.argmax(np.diff(events.t) < 0)) + 1} is earlier than the one before it")
        impossible = TABLE[self.before, events.event] != events.mode
        if impossible.any():
            k = int(np.argmax(impossible))
            was, event, mode = Mode(self.before[k]).name, Event(events.event[k]).name, Mode(events.mode[k]).name
            raise ContractError(f"event {k}: {event} cannot take robot {events.robot[k]} from {was} to {mode}")

    @cached_property
    def before(self) -> Array:
        """The mode of the robot before each event, (n,)."""
        return modes_before(self.events, np.full(self.num_robots, Mode.AUTONOMOUS))

    def until(self, steps: int) -> EventLog:
        """The log as it was after `steps` timesteps."""
        early = self.events.t < steps
        return EventLog(Events(*(column[early] for column in self.events)), self.num_robots, self.num_humans, steps)


def modes_before(events: Events, start: Array) -> Array:
    """The mode of the robot before each event, (n,), when the robots were in the modes `start` (N,) at first."""
    order = np.argsort(events.robot, kind="stable")  # by robot, and by time for each robot
    robot, after = events.robot[order], events.mode[order]
    first = np.diff(robot, prepend=-1) != 0
    before = np.empty(len(robot), dtype=np.int64)
    before[order] = np.where(first, start[robot], np.roll(after, 1))
    return before


# -- the log as intervals -----------------------------------------------------------------------------------------


class Intervals(NamedTuple):
    """n stretches of time that a robot spent in one mode, by robot and then by time. All (n,).

    robot: index; human: who was with it, or -1; mode: a `Mode`; violated: bool, whether c(s) = 1 meanwhile;
    start: first timestep; end: first timestep that is no longer part of it. For each robot they cover 0 to T.
    """

    robot: Array
    human: Array
    mode: Array
    violated: Array
    start: Array
    end: Array

    @property
    def length(self) -> Array:
        """Timesteps, (n,)."""
        return np.asarray(self.end - self.start)

    def where(self, mask: Array) -> Intervals:
        """The intervals of the mask (n,) bool."""
        return Intervals(*(column[mask] for column in self))

    def cumulative(self, steps: int) -> Array:
        """Robot-timesteps spent in these intervals during the timesteps 0..t, for each t, (T,) int64."""
        change = np.bincount(self.start, minlength=steps + 1) - np.bincount(self.end, minlength=steps + 1)
        return np.asarray(np.cumsum(np.cumsum(change)[:steps]))


def intervals(log: EventLog) -> Intervals:
    """The mode of every robot over time.

    Robots are autonomous at 0. An event before the step takes effect at its t, one at the end of the step (violation,
    hard reset) at t + 1; what is still going on ends at T. Modes that last no timestep (switching without latency) and
    events that leave the mode as it is (success, timeout) do not appear.
    """
    n, events = log.num_robots, log.events
    changes = events.mode != log.before
    robot = np.concatenate([np.arange(n), events.robot[changes]])
    human = np.concatenate([np.full(n, -1), events.human[changes]])
    mode = np.concatenate([np.full(n, Mode.AUTONOMOUS), events.mode[changes]])
    before = np.concatenate([np.full(n, Mode.AUTONOMOUS), log.before[changes]])
    start = np.concatenate([np.zeros(n, dtype=np.int64), (events.t + np.isin(events.event, END_OF_STEP))[changes]])

    order = np.argsort(robot, kind="stable")
    robot, human, mode, before, start = (column[order] for column in (robot, human, mode, before, start))
    last = np.diff(robot, append=n) != 0
    end = np.where(last, log.steps, np.roll(start, -1))
    violated = IDLE[mode] | ((mode == Mode.SWITCHING) & (before == Mode.VIOLATED))
    human = np.where(HELPED[mode], human, -1)  # the event that ends an intervention names its human as well
    return Intervals(robot, human, mode, violated, start, end).where(end > start)


# -- counts ---------------------------------------------------------------------------------------------------------


def _count(log: EventLog, event: Event) -> int:
    return int(np.count_nonzero(log.events.event == event))


def _count_curve(log: EventLog, event: Event) -> Array:
    return np.cumsum(np.bincount(log.events.of(event).t, minlength=log.steps))


def successes(log: EventLog) -> int:
    """Task completions of all robots (section 5.6, metric 1)."""
    return _count(log, Event.SUCCESS)


def successes_curve(log: EventLog) -> Array:
    """Task completions during the timesteps 0..t, for each t, (T,) int64."""
    return _count_curve(log, Event.SUCCESS)


def violations(log: EventLog) -> int:
    """Times that a robot entered c(s) = 1 (section 5.3)."""
    return _count(log, Event.VIOLATE)


def violations_curve(log: EventLog) -> Array:
    """Constraint violations during the timesteps 0..t, for each t, (T,) int64."""
    return _count_curve(log, Event.VIOLATE)


def hard_resets(log: EventLog) -> int:
    """Completed hard resets (section 5.6, metric 2). At most `violations`: some may still wait for theirs."""
    return _count(log, Event.HARD_RESET)


def hard_resets_curve(log: EventLog) -> Array:
    """Completed hard resets during the timesteps 0..t, for each t, (T,) int64."""
    return _count_curve(log, Event.HARD_RESET)


def timeouts(log: EventLog) -> int:
    """Episodes that reached the horizon without success."""
    return _count(log, Event.TIMEOUT)


# -- time -----------------------------------------------------------------------------------------------------------


def idle_time(log: EventLog) -> int:
    """Robot-timesteps in c(s) = 1 (section 5.6, metric 3).

    From the violation until the end of the hard reset: waiting for a human, the human's switching latency and the t_R
    timesteps of the reset itself. (Table C.2 counts alike: 340 hard resets with t_R = 5 are 1700 timesteps there.)
    """
    spans = intervals(log)
    return int(spans.length[spans.violated].sum())


def idle_time_curve(log: EventLog) -> Array:
    """Robot-timesteps in c(s) = 1 during the timesteps 0..t, for each t, (T,) int64."""
    spans = intervals(log)
    return spans.where(spans.violated).cumulative(log.steps)


class HumanTime(NamedTuple):
    """Human timesteps by what they were spent on."""

    teleoperation: int
    resetting: int
    waiting: int
    """Switching latency: assigned, but not in control yet."""

    @property
    def total(self) -> int:
        """The sum over t of the squared Frobenius norm of alpha^t, the denominator of eq. 5.2."""
        return self.teleoperation + self.resetting + self.waiting


def human_time(log: EventLog) -> HumanTime:
    """Human timesteps: pairs of robot and timestep with a human, alpha_ij = 1 (eq. 5.1, 5.2)."""
    spans = intervals(log)
    kinds = Mode.TELEOPERATED, Mode.RESETTING, Mode.SWITCHING
    return HumanTime(*(int(spans.length[spans.mode == mode].sum()) for mode in kinds))


def human_time_curve(log: EventLog) -> Array:
    """Human timesteps during the timesteps 0..t, for each t, (T,) int64."""
    spans = intervals(log)
    return spans.where(HELPED[spans.mode]).cumulative(log.steps)


def time_in_modes(log: EventLog) -> Array:
    """Robot-timesteps in each `Mode`, (len(Mode),) int64; they add up to N T."""
    spans = intervals(log)
    time = np.zeros(len(Mode), dtype=np.int64)
    np.add.at(time, spans.mode, spans.length)
    return time


# -- interventions ----------------------------------------------------------------------------------------------------


def switches_to_human(log: EventLog) -> int:
    """Context switches from autonomous to supervisor mode: beginnings of a teleoperation. C(pi) of eq. 3.2."""
    return _count(log, Event.TAKE_OVER)


def switches_to_robot(log: EventLog) -> int:
    """Context switches back: ends of a teleoperation, by release, violation or loss of the robot."""
    return int(np.count_nonzero((log.before == Mode.TELEOPERATED) & (log.events.mode != Mode.TELEOPERATED)))


def context_switches(log: EventLog) -> int:
    """Context switches in either direction, C(pi) of eq. 2.2."""
    return switches_to_human(log) + switches_to_robot(log)


def supervisor_actions(log: EventLog) -> int:
    """Timesteps in which a human's action was executed, D(pi) of eq. 2.2. Hard resets are not among them."""
    return human_time(log).teleoperation


def intervention_lengths(log: EventLog) -> Array:
    """Timesteps of each teleoperation, (n,) int64, by robot and then by time; the last ones may have been cut off by T."""
    spans = intervals(log)
    return np.asarray(spans.length[spans.mode == Mode.TELEOPERATED])


# -- return on human effort ---------------------------------------------------------------------------------------------


def rohe(log: EventLog, unit: float = HUMAN_TIME_UNIT) -> float:
    """Return on human effort (eq. 5.2) of the sparse reward: M/N * successes / (1 + human time / unit).

    Args:
        log: the run.
        unit: timesteps in a unit of human time.
    """
    return rohe_of(log.num_humans, log.num_robots, successes(log), human_time(log).total, unit)


def rohe_curve(log: EventLog, unit: float = HUMAN_TIME_UNIT) -> Array:
    """`rohe` of the timesteps 0..t, for each t, (T,) float64."""
    effort = 1 + human_time_curve(log) / unit
    return np.asarray(log.num_humans / log.num_robots * successes_curve(log) / effort)


def rohe_of(humans: int, robots: int, tasks: int, human_steps: int, unit: float = HUMAN_TIME_UNIT) -> float:
    """Equation 5.2 itself, of M, N, completed tasks and human timesteps."""
    return humans / robots * tasks / (1 + human_steps / unit)


# -- supervisor burden --------------------------------------------------------------------------------------------------


def burden(log: EventLog, latency: float) -> float:
    """Supervisor burden B = L * C + D of the whole log (eq. 2.2), in human timesteps.

    Args:
        log: the run.
        latency: L, timesteps that a context switch costs; C counts both directions.
    """
    return latency * context_switches(log) + supervisor_actions(log)


def burden_per_intervention(log: EventLog, latency: float) -> float:
    """Supervisor burden B = C * (L + I) of the whole log (eq. 3.2), in human timesteps.

    Args:
        log: the run.
        latency: L, timesteps that the switches to the human and back cost together. C counts the interventions and
            I is their mean number of supervisor actions.
    """
    interventions = switches_to_human(log)
    actions = supervisor_actions(log) / interventions if interventions else 0.0
    return interventions * (latency + actions)


def cutoff_latency(log: EventLog, baseline: EventLog) -> float:
    """L* (section 2.6): the smallest L* >= 0 such that for all L > L* the burden (eq. 2.2) is below the baseline's.

    0.0 if it is lower for all L > 0, infinite if there is no such L*. Compare logs of the same amount of work, since both
    burdens are totals.
    """
    fewer_switches = context_switches(baseline) - context_switches(log)
    more_actions = supervisor_actions(log) - supervisor_actions(baseline)
    if fewer_switches > 0:  # L * fewer_switches > more_actions
        return max(0.0, more_actions / fewer_switches)
    return 0.0 if fewer_switches == 0 and more_actions < 0 else math.inf


# -- all of it ------------------------------------------------------------------------------------------------------------


def summary(log: EventLog) -> dict[str, float]:
    """All totals by name, as plain numbers; the sum of the rewards is not in the log."""
    time = human_time(log)
    return {
        "t": log.steps,
        "successes": successes(log),
        "violations": violations(log),
        "hard_resets": hard_resets(log),
        "timeouts": timeouts(log),
        "idle_time": idle_time(log),
        "human_time": time.total,
        **time._asdict(),
        "switches_to_human": switches_to_human(log),
        "switches_to_robot": switches_to_robot(log),
        "rohe": rohe(log),
    }
