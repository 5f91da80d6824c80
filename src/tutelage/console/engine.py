"""The loop with people in it, in a thread of its own: in real time, or in lock-step with those who hold robots.

Nothing that people, disks, pictures or the learner do holds up a timestep: they meet the loop under one lock, which nobody
keeps for longer than it takes to look at a few numbers. What happened is told by a second thread.
"""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from tutelage.console.audit import Audit
from tutelage.console.controls import Driver, controls_of
from tutelage.console.herald import Herald
from tutelage.console.offers import Offers
from tutelage.console.operators import Operators
from tutelage.console.parts import EngineConfig, Parts, Report, make_parts
from tutelage.console.people import Desk, People, Reasons, ended_by
from tutelage.console.states import LeaseEnded, LeaseGranted, Metrics, Notice, Snapshot, Stepped
from tutelage.console.trainer import ProcessLearner
from tutelage.errors import RunFolderError, TutelageError
from tutelage.experiments.config import FORMAT
from tutelage.experiments.recording import Recorder, lock
from tutelage.fleet.loop import Loop
from tutelage.fleet.policy import Learner
from tutelage.fleet.priority import parse
from tutelage.fleet.step import Step
from tutelage.store import load_tree, save_tree, write_atomic

if TYPE_CHECKING:
    from tutelage.remote.weights import SharedPolicy

_LOG = logging.getLogger(__name__)
FOREVER = 10**12
SHOW = 0.5
"""Seconds after which people see how things are while no timestep comes."""
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
        self.lock = threading.Condition()
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
        self.people = People(self.offers, self.driver, self.lock, self.clock, config.lockstep, self.operators.used)
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


class Recording:
    """Subscriber: writes the step down, ends leases that it ended, and makes the snapshot."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.waits: deque[float] = deque(maxlen=200)
        self.watchers: list[Callable[[Loop, Step], None]] = []
        """Called in the loop's thread after each step, such as what copies states for pictures."""
        self.losses: dict[str, float] = {}
        self._unwritten: list[tuple[str, int, dict[str, Any], dict[str, Any]]] = []
        self._metrics_at = self._saved_at = 0.0
        self._slowest = self._latest = self._dearest = 0.0
        self._saver = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._saving: Future[None] | None = None

    def on_start(self, loop: Loop) -> None:
        """Nothing to do."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """Write, end, tell."""
        engine = self._engine
        engine.tick = time.perf_counter() - engine.pace.began
        self._dearest = max(self._dearest, time.thread_time() - engine.pace.worked)
        self._samples(step)
        try:
            engine.recorder.on_step(loop, step)
        except TutelageError as error:
            engine.trouble = str(error)
        for watcher in self.watchers:
            watcher(loop, step)
        now = engine.clock()
        with engine.lock:
            engine.people.violation = loop.violation
            self._ends(step, now)
            engine.publish()
            engine.show()
        self._metrics(loop, now)
        if now - self._saved_at >= engine.config.save_every and (self._saving is None or self._saving.done()):
            self.save(loop)

    def on_end(self, loop: Loop) -> None:
        """Nothing to do: the engine saves when it closes."""

    def look(self, loop: Loop) -> Snapshot:
        """The fleet as it is. Call it with the lock."""
        engine, offers = self._engine, self._engine.offers
        n, now = loop.fleet.num_envs, engine.clock()
        queue = offers.queue(now)
        rank, reason = np.full(n, -1), [""] * n
        for place, row in enumerate(queue):
            rank[row["robot"]], reason[row["robot"]] = place, row["reason"]
        held = np.zeros(n, dtype=bool)
        leases = {}
        for robot, hold in offers.holds.items():
            held[robot] = engine.people.silent(robot)
            reason[robot] = hold.lease.reason
            lease = hold.lease
            leases[robot] = {
                "operator": lease.operator, "id": lease.id, "since": lease.since, "held": bool(held[robot]),
                "reason": lease.reason,
            }  # fmt: skip
        for robot in np.flatnonzero(loop.violation).tolist():
            reason[robot] = "violated"
        stopped = engine.parts.fleet.latched
        return Snapshot(
            loop.t, engine.wall(now), loop.mode.copy(), loop.human_of, loop.age.copy(), tuple(reason), rank,
            loop.online & ~stopped, stopped, held, tuple(queue), leases, engine.policy_version, engine.tick, engine.late,
        )  # fmt: skip

    def _samples(self, step: Step) -> None:
        """What people did, into the durable record; what cannot be written now is tried again."""
        people, version = self._engine.people, self._engine.policy_version
        for robot in np.flatnonzero(step.taught).tolist():
            lease = people.driving[robot]
            arrays = {
                "obs": step.obs[robot],
                "proposed": step.proposed[robot],
                "executed": step.actions[robot],
                "wanted": step.wanted[robot],
            }
            fields = {"t": step.t, "lease": lease.id, "policy_version": version}
            self._unwritten.append((lease.operator, robot, arrays, fields))
        self.retry()

    def retry(self) -> bool:
        """Write what waits; whether all of it could be written."""
        try:
            while self._unwritten:
                who, robot, arrays, fields = self._unwritten[0]
                self._engine.audit.sample(who, robot, arrays, **fields)
                self._unwritten.pop(0)
        except TutelageError as error:
            self._engine.trouble = str(error)
            return False
        return True

    def _ends(self, step: Step, now: float) -> None:
        offers = self._engine.offers
        for robot, why in ended_by(step.events):
            if why == "reset_done" and robot in offers.holds:
                self._engine.operators[offers.holds[robot].lease.operator].resets += 1
            if robot in offers.holds or why == "reset_done":
                offers.end(robot, why, now)

    def _metrics(self, loop: Loop, now: float) -> None:
        engine = self._engine
        self._slowest, self._latest = max(self._slowest, engine.tick), max(self._latest, engine.late)
        if now - self._metrics_at < 1.0:
            return
        row = engine.recorder.row()
        steps = max(1, loop.fleet.num_envs * loop.t)
        row |= {
            "time": time.time(),
            "human_steps": row["teleoperation"],
            "intervention_rate": row["teleoperation"] / steps,
            "queue": len(engine.offers.order),
            "queue_wait": float(np.mean(self.waits)) if self.waits else 0.0,
            "policy_version": engine.policy_version,
            "tick_ms": 1000 * self._slowest,
            "tick_cpu_ms": 1000 * self._dearest,
            "late_ms": 1000 * self._latest,
        }
        self._metrics_at, self._slowest, self._latest, self._dearest = now, 0.0, 0.0, 0.0
        engine.rows.append(row)
        engine.herald.tell(Metrics(None, row))

    def save(self, loop: Loop, wait: bool = False) -> None:
        """Keep the state of the loop; the disk is waited for in another thread."""
        engine = self._engine
        tree = {
            "format": FORMAT,
            "t": loop.t,
            "loop": loop.state_dict() if loop.fleet.can_checkpoint else {},
            "recorder": engine.recorder.state_dict(),
            "operators": engine.operators.state_dict(),
        }
        try:
            engine.recorder.commit(loop.t)
        except TutelageError as error:
            engine.trouble = str(error)
        self._saved_at = engine.clock()
        self._saving = self._saver.submit(self._write, tree)
        if wait:
            self._saving.result()

    def _write(self, tree: dict[str, Any]) -> None:
        try:
            save_tree(self._engine.checkpoint, tree)
        except TutelageError as error:
            self._engine.trouble = str(error)

    def later(self, work: Callable[[], None]) -> None:
        """Do something in the thread that waits for the disk."""
        self._saver.submit(work)

    def close(self) -> None:
        """Wait for the disk."""
        self._saver.shutdown()


class Pace:
    """The last subscriber: waits until the next timestep is to begin."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
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
                engine.lock.wait(left)
                if engine.publish():
                    engine.show()

    def _wait_for_people(self) -> None:
        engine = self._engine
        shown = engine.clock()
        deadline = shown + engine.config.deadline
        with engine.lock:
            while not engine.closing and engine.clock() < deadline and engine.people.waiting_for():
                engine.lock.wait(0.1)
                engine.offers.tick(engine.clock())
                if engine.publish() or engine.clock() - shown > SHOW:
                    engine.show()
                    shown = engine.clock()

    def _hold(self, reason: str) -> None:
        """Nobody moves while nothing can be written down."""
        engine = self._engine
        engine.trouble, engine.people.frozen = reason, True
        engine.herald.tell(Notice(None, "error", f"robots are held, because nothing can be recorded: {reason}"))
        while not engine.closing:
            with engine.lock:
                engine.lock.wait(0.25)
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
