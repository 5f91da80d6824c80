"""The supervision server without its web: one object that any thread may ask, and that tells what happened.

The only thing that the web application talks to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from tutelage.console.audit import Audit
from tutelage.console.config import EngineConfig
from tutelage.console.engine import Engine
from tutelage.console.frames import Frames
from tutelage.console.parts import Report
from tutelage.console.replay import Replay
from tutelage.console.states import (
    Denied,
    Description,
    Frame,
    Lease,
    LeaseEnded,
    LeaseGranted,
    Metrics,
    Notice,
    Offer,
    Snapshot,
    Stepped,
    Told,
)
from tutelage.console.trainer import ProcessLearner
from tutelage.errors import TutelageError

__all__ = [
    "Denied", "Description", "EngineConfig", "Frame", "Lease", "LeaseEnded", "LeaseGranted", "Metrics", "Notice", "Offer",
    "Snapshot", "Stepped", "Supervision", "Told",
]  # fmt: skip


class Supervision:
    """A fleet, the people who look after it, and the policy that learns from them.

    All methods may be called from any thread and return at once, except where they say that they wait. Those that people
    call raise `Denied` where what they ask for is not possible.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.description = _describe(engine)
        self._frames = Frames(engine.parts.fleet.inner, engine.config.hz)
        self._replay = Replay(engine, self._frames) if engine.config.replay else None
        engine.recording.watchers.append(self._frames.on_step)
        engine.pace.meanwhile = self._frames.look
        if self._replay:
            engine.recording.watchers.append(self._replay.on_step)

    @classmethod
    def open(cls, config: EngineConfig, audit: Audit, report: Report = lambda what, done: None) -> Supervision:
        """Make it, or resume what the folder holds. Prepares a policy first where there is none: that takes a while.

        Raises:
            ConfigError, RunFolderError: see `Engine`.
        """
        return cls(Engine(config, audit, report))

    # -- people -------------------------------------------------------------------------------------------------

    def join(self, operator: str) -> int:
        """Take a seat: index j. The same person gets the same seat again."""
        with self._asked() as now:
            seat = self.engine.offers.join(operator, now)
            self.engine.offers.tick(now)
            return seat

    def leave(self, operator: str) -> None:
        """The person is gone: their robot holds at once; after a grace period it is offered to others."""
        with self._asked() as now:
            self.engine.offers.leave(operator, now)

    def available(self, operator: str, yes: bool) -> None:
        """Whether the person wants offers."""
        with self._asked() as now:
            self.engine.offers.available(operator, yes, now)

    def accept(self, operator: str, robot: int) -> Lease:
        """Take a robot that was offered."""
        with self._asked() as now:
            return self.engine.offers.accept(operator, robot, now)

    def decline(self, operator: str, robot: int) -> None:
        """Leave an offered robot to others; it is not offered to this person again for a while."""
        with self._asked() as now:
            self.engine.offers.decline(operator, robot, now)
            self.engine.operators[operator].declined += 1
            self.engine.offers.tick(now)

    def take(self, operator: str, robot: int) -> None:
        """Take a robot on one's own judgement; the lease comes as an event."""
        with self._asked() as now:
            self.engine.offers.take(operator, robot, now)

    def give_back(self, operator: str, robot: int) -> None:
        """The robot goes on by itself."""
        with self._asked() as now:
            self.engine.offers.give_back(operator, robot, now)

    def hand_over(self, operator: str, robot: int, to: str) -> None:
        """Offer one's robot to a certain person; one keeps it until they accept."""
        with self._asked() as now:
            self.engine.offers.hand_over(operator, robot, to, now)

    def reset(self, operator: str, robot: int) -> None:
        """Begin a hard reset of the robot that one holds."""
        with self._asked() as now:
            self.engine.offers.reset(operator, robot, now)

    def command(
        self,
        operator: str,
        robot: int,
        lease: str,
        seq: int,
        action: Sequence[float] | None,
        assist: bool = False,
        push: Sequence[float] | None = None,
    ) -> bool:
        """What the robot is to do. The newest command wins; False: it is older than one that came before, and dropped."""
        try:
            return self.engine.people.give(operator, robot, lease, seq, action, assist, push)
        except Denied:
            raise
        except TutelageError as error:
            raise Denied("held", f"nothing can be recorded, so nobody may drive: {error}") from None

    def renew(self, operator: str, lease: str) -> None:
        """The person is still there."""
        with self.engine.lock:
            self.engine.offers.heard(operator, lease, self.engine.clock())

    def estop(self, operator: str, robot: int | None) -> None:
        """Emergency stop of a robot, or of all (None). Acts at once; waits for the disk thereafter."""
        robots = self._robots(robot)
        self.engine.parts.fleet.stop(robots)  # first of all, and without any lock
        with self._asked() as now:
            self.engine.offers.stop(robots, now)
        self.engine.remember_stops("estop", operator, robots)

    def clear_estop(self, operator: str, robot: int | None) -> None:
        """The robot, or all, may go on. Waits for the disk."""
        robots = self._robots(robot)
        with self._asked():
            self.engine.offers.clear(robots)
        self.engine.parts.fleet.clear(robots)
        self.engine.remember_stops("estop_clear", operator, robots)

    def standing(self, operator: str) -> list[Told]:
        """What somebody who comes back must be told again: `LeaseGranted` of the robot they have, `Offer` of what is offered
        to them, for as long as it still is."""
        with self.engine.lock:
            return self.engine.offers.standing(operator, self.engine.clock())

    # -- what there is to see -----------------------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """The newest one."""
        return self.engine.snapshot

    def subscribe(self, callback: Callable[[Told], None]) -> Callable[[], None]:
        """Hear of everything that happens, in order, in a thread of the server's; returns how to unsubscribe."""
        return self.engine.herald.subscribe(callback)

    def frame(self, robot: int, camera: int, width: int, height: int) -> Frame | None:
        """The newest picture; asking for it again and again is what keeps it coming. None: there is none yet."""
        return self._frames.get(robot, camera, width, height)

    def jpeg(self, robot: int, camera: int) -> tuple[float, bytes] | None:
        """The newest picture of a robot that sends JPEG itself, as it came: seconds since 1970, and the file; else None."""
        source = getattr(self.engine.parts.fleet.inner, "jpeg", None)
        known = 0 <= robot < self.engine.parts.fleet.num_envs and 0 <= camera < len(self.description.cameras)
        return source(robot, camera) if source is not None and known else None

    def metrics(self, since: int = 0) -> list[dict[str, Any]]:
        """The rows of metrics after timestep `since`, oldest first."""
        return [_plain(row) for row in list(self.engine.rows) if row["t"] > since]

    def operators(self) -> list[dict[str, Any]]:
        """What each person has done."""
        with self.engine.lock:
            present = {seat.operator for seat in self.engine.offers.seats if seat and seat.present}
            now = self.engine.clock()
            since = {hold.lease.operator: now - hold.since for hold in self.engine.offers.holds.values()}
            return self.engine.operators.rows(present, since)

    def episodes(self, limit: int = 100) -> list[dict[str, Any]]:
        """Recorded interventions, newest first: {id, robot, operator, began, seconds, outcome, frames}. Reads the disk."""
        return self._replay.episodes(limit) if self._replay else []

    def episode(self, id: int) -> dict[str, Any] | None:
        """One of them, with "frames": [{t, time, mode, action, wanted, proposed}]; None: there is none. Reads the disk."""
        return self._replay.episode(id) if self._replay else None

    def episode_frame(self, id: int, frame: int, width: int = 640, height: int = 360) -> Frame | None:
        """A picture of it, None where there is none. Reads the disk and waits for the renderer."""
        return self._replay.picture(id, frame, width, height) if self._replay else None

    @property
    def healthy(self) -> dict[str, Any]:
        """{ok, t, loop, late, tick, learner, restarts, swap_ms, online, recording, policy_version, error}."""
        engine = self.engine
        learner = engine.learner if isinstance(engine.learner, ProcessLearner) else None
        recording = engine.trouble is None and engine.audit.error is None
        learning = learner is None or learner.alive
        return {
            "ok": engine.alive and recording and learning,
            "t": engine.loop.t,
            "loop": engine.alive and engine.error is None,
            "late": engine.late,
            "tick": engine.tick,
            "learner": learning,
            "restarts": learner.restarts if learner else 0,
            "swap_ms": 1000 * learner.swap_seconds if learner else 0.0,
            "online": int(np.count_nonzero(engine.snapshot.online)),
            "recording": recording,
            "policy_version": engine.policy_version,
            "error": engine.error or engine.trouble or engine.audit.error,
        }

    def start(self) -> None:
        """Begin."""
        self._frames.start()
        if self._replay:
            self._replay.start()
        self.engine.start()

    def close(self) -> None:
        """End: robots hold, everything is written down. Waits for it."""
        self.engine.close()
        if self._replay:
            self._replay.close()
        self._frames.close()

    # -- inside -------------------------------------------------------------------------------------------------

    @contextmanager
    def _asked(self) -> Iterator[float]:
        """Somebody asks for something now: under the lock, and the loop's thread is told to look."""
        with self.engine.lock:
            try:
                yield self.engine.clock()
            except Denied:
                raise
            except TutelageError as error:
                raise Denied("held", f"nothing can be recorded, so nobody may drive: {error}") from None
            finally:
                self.engine.lock.notify_all()

    def _robots(self, robot: int | None) -> list[int]:
        n = self.engine.parts.fleet.num_envs
        if robot is None:
            return list(range(n))
        if not 0 <= robot < n:
            raise Denied("unknown_robot", f"there is no robot {robot}")
        return [robot]


def _describe(engine: Engine) -> Description:
    config, run, fleet, terms = engine.config, engine.parts.config, engine.parts.fleet, engine.config.terms
    names = getattr(fleet.inner, "names", None) or tuple(f"robot {k + 1}" for k in range(fleet.num_envs))
    cameras = getattr(getattr(fleet.inner, "description", None), "cameras", ("camera",))
    return Description(
        run.task or config.task, tuple(names), tuple(cameras), config.hz, config.lockstep, run.humans, run.algorithm,
        engine.driver.controls, run.t_reset, terms.fresh, terms.grace, terms.offer,
    )  # fmt: skip


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    """JSON knows no NaN."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
