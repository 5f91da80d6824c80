"""The loop with people in it, in a thread of its own: in real time, or in lock-step with those who hold robots.

Nothing that people, disks, pictures or the learner do holds up a timestep: they meet the loop under one lock, which nobody
keeps for longer than it takes to look at a few numbers. What happened is told by a second thread.
"""

from __future__ import annotations

import gc
import json
import logging
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from tutelage.console.audit import Audit
from tutelage.console.config import EngineConfig
from tutelage.console.controls import Driver, controls_of
from tutelage.console.herald import Herald
from tutelage.console.offers import Offers
from tutelage.console.operators import Operators
from tutelage.console.pace import Pace
from tutelage.console.parts import Parts, Report, make_parts
from tutelage.console.people import Desk, People
from tutelage.console.reasons import Reasons
from tutelage.console.recording import Recording
from tutelage.console.states import LeaseEnded, LeaseGranted, Notice, Stepped
from tutelage.console.trainer import ProcessLearner
from tutelage.errors import RunFolderError, TutelageError
from tutelage.experiments.config import FORMAT
from tutelage.experiments.recording import Recorder, lock
from tutelage.fleet.policy import Learner
from tutelage.fleet.priority import parse
from tutelage.store import load_tree, write_atomic

if TYPE_CHECKING:
    from tutelage.remote.weights import SharedPolicy

_LOG = logging.getLogger(__name__)
FOREVER = 10**12
SWITCH = 0.0005
"""Seconds after which a thread that computes lets another one go on: the loop is to be on time while pictures are made."""


class Engine:
    """The loop, its people and its learner.

    Args:
        config: what is supervised.
        audit: the durable record; closed by whoever made it.
        report: told what is being prepared, and how much of it is done.

    Raises:
        ConfigError, RunFolderError: see `make_parts`; or the folder is in use.
    """

    def __init__(self, config: EngineConfig, audit: Audit, report: Report = lambda what, done: None) -> None:
        self.config, self.audit, self.clock = config, audit, time.monotonic
        self.lock, self._stopping = threading.Condition(), threading.Lock()
        self.operators = Operators()
        self.herald = Herald(audit)
        self.rows: deque[dict[str, Any]] = deque(maxlen=7200)
        self.error: str | None = None
        self.trouble: str | None = None
        """Why robots are held: nothing can be written down."""
        self.late = self.tick = 0.0
        self._claim = lock(config.out)
        self._report = report
        self._built, self._begin, self._closing = threading.Event(), threading.Event(), False
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._main, name="loop", daemon=True)
        self._thread.start()
        self._built.wait()
        if self._failure is not None:
            self._claim.close()
            raise self._failure

    # -- building -----------------------------------------------------------------------------------------------

    def _main(self) -> None:
        """The loop's thread: fleets that draw want to be made and stepped in the same one."""
        try:
            self._build()
        except BaseException as error:
            self._failure = error
            self._built.set()
            return
        self._built.set()
        self._begin.wait()
        try:
            if not self._closing:
                self.loop.run(FOREVER)
        except Exception as error:
            self.error = f"{type(error).__name__}: {error}"
            self.herald.tell(Notice(None, "error", f"the loop ended, robots hold: {self.error}"))
            _LOG.exception("the loop ended")
            while not self._closing:  # people may still ask, and be told no
                time.sleep(0.1)
        finally:
            self._end()

    def _end(self) -> None:
        """The loop is over: write everything down, where it was opened."""
        now = self.clock()
        with self.lock:
            for robot in list(self.offers.holds):
                self.offers.end(robot, "lost", now)
            self.publish()
        if not self.loop.in_step:
            self.recording.save(self.loop, wait=True)
        self.recording.close()
        try:
            self.recorder.close()
        except TutelageError as error:
            self.error = str(error)
        self.parts.fleet.close()

    def _build(self) -> None:
        config = self.config
        self.parts = parts = make_parts(config, self._report)
        if config.learner != "inline":
            torch.set_num_threads(1)  # a fleet's products are small, and threads that wait for each other are late
        fleet, run = parts.fleet, parts.config
        n = fleet.num_envs
        self.offers = Offers(n, run.humans, config.terms, self._log, self.wall)
        self.driver = Driver(
            controls_of(run.task, fleet.inner, config.assist and parts.expert is not None), fleet, parts.expert
        )
        self.people = People(
            self.offers, self.driver, self.lock, self.clock, config.lockstep, self.operators.used, self._log
        )
        self.reasons = Reasons(parse(run.priority, run.thresholds, run.gate), self.offers, run.queue == "fifo")
        self.desk = Desk(self.people, self.reasons, self.clock, run.t_reset, config.gated)
        self._version = self._known_version()
        self.learner = self._learner(parts)
        self._shared = None if config.simulated else self._share()
        self.loop = parts.assembly.loop(
            fleet=fleet, policy=self._shared or parts.policy, priority=self.reasons, team=self.people, allocator=self.desk,
            learner=self.learner, execution=None, overlap=False,
        )  # fmt: skip
        self.recorder = Recorder(config.out, n, run.humans, FOREVER, run.metrics_every, "none")
        self.pace = Pace(self)
        self.recording = Recording(self)
        if parts.resumed and self.checkpoint.exists():  # else it was killed before its first timestep
            self._resume()
        else:
            self.recording.save(self.loop, wait=True)
        self._recall_stops()
        self.people.violation = self.loop.violation
        self.snapshot = self.recording.look(self.loop)
        self.loop.subscribers = [self.recording, self.pace]

    def _learner(self, parts: Parts) -> Learner | None:
        c = self.config
        if c.learner == "inline":
            return parts.learner
        if c.learner == "none" or parts.learner.config.schedule == "never":
            return None
        notice = lambda level, text: self.herald.tell(Notice(None, level, text))  # noqa: E731
        return ProcessLearner(
            c.out, parts.learner, self._version, c.per_sample, c.swap_every, c.save_every, notice, self._swapped
        )

    @property
    def policy_version(self) -> int:
        """How often the policy's weights were replaced."""
        if isinstance(self.learner, ProcessLearner):
            return self.learner.version
        return self.loop.t if self.learner is not None else self._version

    def _known_version(self) -> int:
        """The policy's version before the server was started, from its record."""
        return max((json.loads(row.fields)["version"] for row in self.audit.rows(limit=1, kind="policy")), default=0)

    def _swapped(self, version: int, seen: int) -> None:
        self._log_quietly("policy", "", None, version=version, seen=seen)
        if self._shared is not None:
            self.recording.later(self._shared.share)

    def _share(self) -> SharedPolicy | None:
        """Robots may have the policy themselves, where the policy of their network lets the server hand it out."""
        from tutelage.remote.weights import SharedPolicy

        inner: Any = self.parts.fleet.inner
        try:
            return SharedPolicy(inner, self.parts.policy)
        except TutelageError as error:
            _LOG.info("robots decide nothing by themselves: %s", error)
            return None

    def _resume(self) -> None:
        path = self.checkpoint
        state = load_tree(path)
        if state.get("format") != FORMAT:
            raise RunFolderError(f"{path} has format {state.get('format')}, this version reads {FORMAT}")
        try:
            if self.parts.fleet.can_checkpoint:
                self.loop.load_state_dict(state["loop"])
            self.loop.t = int(state["t"])
            self.recorder.load_state_dict(state["recorder"])
            self.operators.load_state_dict(state["operators"])
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError):
            raise RunFolderError(f"{path} does not fit {self.config.out / 'config.json'}; one of them is damaged") from None
        self.recorder.cut(self.loop.t)

    # -- running ------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Let the loop run."""
        sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH))
        gc.collect()
        gc.freeze()  # what there is by now stays: looking through all of it again and again would hold everybody up
        self.herald.start()
        if isinstance(self.learner, ProcessLearner):
            self.learner.start()
        self._log_quietly("start", "", None, t=self.loop.t, fleet=self.config.fleet)
        self._begin.set()

    def close(self) -> None:
        """End the loop after the present timestep, and write everything down."""
        self._closing = True
        with self.lock:
            self.loop.stop_requested = True
            self.lock.notify_all()
        self._begin.set()
        self._thread.join(30.0)
        if isinstance(self.learner, ProcessLearner):
            self.learner.close()
        self.herald.close()
        self._claim.close()

    @property
    def closing(self) -> bool:
        """Whether the end was asked for."""
        return self._closing

    @property
    def alive(self) -> bool:
        """Whether the loop runs."""
        return self._begin.is_set() and self._thread.is_alive() and self.error is None

    @property
    def checkpoint(self) -> Path:
        """The state of the loop."""
        return self.config.out / "checkpoint" / "serve.safetensors"

    def wall(self, moment: float) -> float:
        """A moment of the clock as seconds since 1970."""
        return time.time() - (self.clock() - moment)

    def publish(self) -> bool:
        """Tell what happened to offers and leases, if anything did. Call it with the lock, and not amid a timestep."""
        events = self.offers.take_events()
        for event in events:
            if isinstance(event, LeaseGranted):
                operator = self.operators[event.lease.operator]
                operator.interventions += 1
                if event.answered is not None:
                    operator.accepted += 1
                    operator.acceptance_time += event.answered
                self.recording.waits.append(event.waited)
            elif isinstance(event, LeaseEnded) and event.operator is not None:
                self.operators[event.operator].human_time += event.seconds
            self.herald.tell(event)
        return bool(events)

    def show(self) -> None:
        """Tell what it looks like now. Call it as `publish`."""
        self.snapshot = self.recording.look(self.loop)
        self.herald.tell(Stepped(None, self.snapshot))

    # -- what must not be forgotten -----------------------------------------------------------------------------

    def _log(self, kind: str, who: str, robot: int | None, **fields: Any) -> None:
        self.audit.write(kind, who, robot, **fields)

    def _log_quietly(self, kind: str, who: str, robot: int | None, **fields: Any) -> None:
        """What happens in any case, recorded or not."""
        try:
            self.audit.write(kind, who, robot, **fields)
        except TutelageError as error:
            self.trouble = str(error)

    def remember_stops(self, kind: str, operator: str, robots: list[int]) -> None:
        """An emergency stop outlives the server."""
        self._log_quietly(kind, operator, robots[0] if len(robots) == 1 else None, robots=robots)
        try:
            with self._stopping:  # the newest is written last, whoever comes first
                write_atomic(self._stops, json.dumps(np.flatnonzero(self.parts.fleet.stopped).tolist()).encode())
        except TutelageError as error:
            self.trouble = str(error)

    def _recall_stops(self) -> None:
        try:
            robots = [int(r) for r in json.loads(self._stops.read_text())] if self._stops.exists() else []
        except (ValueError, TypeError):
            robots = list(range(self.parts.fleet.num_envs))  # which ones is not known any more: all
        self.parts.fleet.stopped[:] = False
        self.parts.fleet.stop(robots)
        self.offers.stopped = set(robots)
        self.loop.online = self.loop.online & ~self.parts.fleet.stopped

    @property
    def _stops(self) -> Path:
        return self.config.out / "stopped.json"
