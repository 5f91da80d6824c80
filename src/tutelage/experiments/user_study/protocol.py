"""Appendix B.4: who does what in which order, and what is counted."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tutelage.fleet.loop import Loop
from tutelage.fleet.modes import Event, Mode
from tutelage.fleet.step import Step
from tutelage.seeding import stream

ROBOTS, STEPS = 3, 350
"""Robots of a participant, and timesteps of a condition."""
HUMAN_GATED = "HG-DAgger"
CONDITIONS = (HUMAN_GATED, "SafeDAgger", "LazyDAgger", "ThriftyDAgger")
QUESTIONS = {
    "mental_demand": "How mentally demanding was it?",
    "frustration": "How insecure, discouraged, irritated, stressed, and annoyed were you?",
}
"""The two questions of the NASA-TLX that the study asks of each condition, from 1, very low, to 5, very high."""
SCALE = (1, 5)


def order(participant: int, seed: int = 0) -> tuple[str, ...]:
    """The conditions in this participant's own random order."""
    return tuple(CONDITIONS[k] for k in stream(seed, f"participant {participant}").permutation(len(CONDITIONS)))


@dataclass
class Counts:
    """One condition of one participant.

    Attributes:
        interventions: times that the person took over.
        human_actions: actions that the person gave.
        robot_actions: actions that the robots took by themselves.
        throughput: tasks completed by all robots.
        idle_time: timesteps that a robot stood still and waited, mean over robots; None with HG-DAgger.
        pairs: found in the games of Concentration; None with HG-DAgger, where the person watches all the time.
    """

    interventions: int = 0
    human_actions: int = 0
    robot_actions: int = 0
    throughput: int = 0
    idle_time: float | None = 0.0
    pairs: int | None = None

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)


class Counting:
    """A subscriber that counts what the table reports. Where a robot needs somebody, `called` says so."""

    def __init__(self) -> None:
        self.counts, self.called = Counts(), False

    def on_start(self, loop: Loop) -> None:
        """Nothing to do."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """Count the timestep of all robots."""
        c, kind = self.counts, step.events.event
        c.interventions += int(np.count_nonzero(kind == Event.TAKE_OVER))
        c.throughput += int(np.count_nonzero(kind == Event.SUCCESS))
        c.human_actions += int(step.taught.sum())
        c.robot_actions += int((step.moved & (step.mode == Mode.AUTONOMOUS)).sum())
        still = ~step.moved & (step.mode != Mode.RESETTING)
        if c.idle_time is not None:
            c.idle_time += float(still.mean())
        self.called = bool((still | (step.human >= 0)).any())

    def on_end(self, loop: Loop) -> None:
        """Nothing to do."""
