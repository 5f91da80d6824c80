"""The subscriber that lets time pass: until the next tick, until people have said what comes next, until there is room."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from tutelage.console.states import Notice
from tutelage.errors import TutelageError
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step
from tutelage.store import write_atomic

if TYPE_CHECKING:
    from tutelage.console.engine import Engine

SHOW = 0.5
"""Seconds after which people see how things are while no timestep comes."""


class Pace:
    """The last subscriber: waits until the next timestep is to begin."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.meanwhile: Callable[[], None] = lambda: None
        """Called now and then while no timestep comes."""
        self.began, self.worked = time.perf_counter(), 0.0
        """When the timestep began, and the CPU time of the loop's thread then, s."""
        self._due = 0.0

    def on_start(self, loop: Loop) -> None:
        """The first timestep begins now."""
        self._due = self._engine.clock()
        self._ready()

    def on_step(self, loop: Loop, step: Step) -> None:
        """Wait for the clock; for the disk, if it is full; in lock-step for people, as long as they are given."""
        engine = self._engine
        period = 1.0 / engine.config.hz
        self._due += period
        if not engine.parts.fleet.paces:
            self._wait_until(self._due)
        while (reason := engine.trouble or engine.audit.error) is not None and not engine.closing:
            self._hold(reason)
        if engine.config.lockstep:
            self._wait_for_people()
        if engine.parts.fleet.paces:
            self._due = engine.clock()
        engine.late = max(engine.clock() - self._due, float(getattr(engine.parts.fleet.inner, "late", 0.0)))
        if engine.late > period:  # no hurrying after a stall: that would be a robot in fast motion
            self._due = engine.clock()
            if engine.config.lockstep:
                engine.late = 0.0
        self._ready()

    def on_end(self, loop: Loop) -> None:
        """Nothing to do."""

    def _ready(self) -> None:
        self.began, self.worked = time.perf_counter(), time.thread_time()

    def _wait_until(self, due: float) -> None:
        engine = self._engine
        with engine.lock:
            while not engine.closing and (left := due - engine.clock()) > 0:
                engine.lock.wait(min(left, SHOW))
                self.meanwhile()
                if engine.publish():
                    engine.show()

    def _wait_for_people(self) -> None:
        engine = self._engine
        shown = engine.clock()
        deadline = shown + engine.config.deadline
        with engine.lock:
            while not engine.closing and engine.clock() < deadline and engine.people.waiting_for():
                engine.lock.wait(0.1)
                self.meanwhile()
                engine.offers.tick(engine.clock())
                if engine.publish() or engine.clock() - shown > SHOW:
                    engine.show()
                    shown = engine.clock()

    def _hold(self, reason: str) -> None:
        """Nobody moves while nothing can be written down."""
        engine = self._engine
        engine.trouble, engine.people.frozen = reason, True
        what = reason.partition("; ")[0]  # what follows is advice for a run that ended; this one waits
        said = f"robots are held, because nothing can be recorded: {what}; they go on as soon as it can be written"
        engine.herald.tell(Notice(None, "error", said))
        while not engine.closing:
            with engine.lock:
                engine.lock.wait(0.25)
                self.meanwhile()
                engine.offers.tick(engine.clock())
                engine.publish()
                engine.show()
            if engine.audit.error is None and self._writable():
                break
        engine.trouble, engine.people.frozen = None, False
        self._due = engine.clock()
        engine.herald.tell(Notice(None, "info", "recording works again, robots go on"))

    def _writable(self) -> bool:
        engine = self._engine
        try:
            engine.recorder.commit(engine.loop.t)
            write_atomic(engine.config.out / ".probe", b"0" * 65536)
            (engine.config.out / ".probe").unlink()
        except (TutelageError, OSError):
            return False
        return engine.recording.retry()
