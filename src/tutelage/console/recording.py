"""The subscriber that writes each timestep down, ends the leases that it ended, and makes the snapshot that people see."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from tutelage.console.people import ended_by
from tutelage.console.states import Metrics, Snapshot
from tutelage.errors import TutelageError
from tutelage.experiments.config import FORMAT
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step
from tutelage.store import save_tree

if TYPE_CHECKING:
    from tutelage.console.engine import Engine


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
        worked = time.thread_time() - engine.pace.worked
        engine.tick = worked if engine.parts.fleet.paces else time.perf_counter() - engine.pace.began
        self._dearest = max(self._dearest, worked)
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
