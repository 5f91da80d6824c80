"""What one timestep of the loop was: the only thing that learners and subscribers see."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tutelage.fleet.events import Events
from tutelage.fleet.modes import MOVING, Mode

if TYPE_CHECKING:
    from tutelage.fleet.loop import Loop

Array = NDArray[Any]


@dataclass(frozen=True)
class Step:
    """Timestep t of N robots. Arrays are not to be changed.

    Attributes:
        t: index of the timestep, from 0.
        obs: (N, ...) what the robots saw.
        proposed: (N, A) what the policy would do.
        actions: (N, A) what was executed.
        wanted: (N, A) what the humans wanted where teleoperated (executed unless an `Execution` changes it), else NaN.
        mode: (N,) the `Mode` of each robot during the step.
        human: (N,) the human who helps each robot during the step, or -1.
        reward: (N,) float64.
        next_obs: (N, ...) what the step led to, before any reset.
        violation: (N,) bool, c(s) after the step, before any reset.
        success: (N,) bool, the task was completed by this step.
        truncated: (N,) bool, the horizon was reached by this step.
        events: what happened before, during and at the end of the step.
        signals: the signals that the priority looked at, by name, (N,) each.
        losses: what learning reported in this step, by name.
        held: (N,) bool, robots that stood still although they are autonomous or teleoperated: their person gave no fresh
            command (then `wanted` is NaN), or they wait for somebody to come. None: nobody.
    """

    t: int
    obs: Array
    proposed: Array
    actions: Array
    wanted: Array
    mode: Array
    human: Array
    reward: Array
    next_obs: Array
    violation: Array
    success: Array
    truncated: Array
    events: Events
    signals: dict[str, Array] = field(default_factory=dict)
    losses: dict[str, float] = field(default_factory=dict)
    held: Array | None = None

    @cached_property
    def moved(self) -> Array:
        """(N,) bool, whose physics went on: autonomous and teleoperated robots that were not held."""
        return np.asarray(MOVING[self.mode] if self.held is None else MOVING[self.mode] & ~self.held)

    @cached_property
    def taught(self) -> Array:
        """(N,) bool, the robots for which a human said what to do: `wanted` holds data to learn from."""
        return np.asarray((self.mode == Mode.TELEOPERATED) & self.moved)


class Subscriber(Protocol):
    """Something that listens to the loop: recording, progress, checkpoints, plots, a console."""

    def on_start(self, loop: Loop) -> None:
        """The loop is about to run."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """A timestep is complete."""

    def on_end(self, loop: Loop) -> None:
        """The loop is done, or was interrupted (also called when it raises)."""
