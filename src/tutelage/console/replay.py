"""Interventions as films: what the robot was like before, during and after, to be looked at again.

What is kept are states, not pictures: they are small, cost the loop a copy, and are drawn in any size when somebody looks.
Robots with cameras of their own are kept as the JPEG pictures that they sent, a few a second.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tutelage.console.frames import Frames, OwnPainter, fitted
from tutelage.console.packing import Tree, pack, unpack
from tutelage.console.states import Frame, LeaseEnded, Told
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step

if TYPE_CHECKING:
    from tutelage.console.engine import Engine

Array = NDArray[Any]
_LOG = logging.getLogger(__name__)

LEAD, TAIL = 2.0, 1.0
"""Seconds before and after the intervention that belong to its film."""
REEL = 50
"""Frames that are written together."""
CAMERA_RATE = 5.0
"""Pictures a second of robots that send pictures, or draw themselves."""
KEPT = 5000
"""Films; then the oldest are dropped."""
_SCHEMA = """
CREATE TABLE IF NOT EXISTS film (id INTEGER PRIMARY KEY, lease TEXT, robot INTEGER, operator TEXT, reason TEXT, began REAL,
    seconds REAL, outcome TEXT, frames INTEGER);
CREATE TABLE IF NOT EXISTS reel (film INTEGER, first INTEGER, frames INTEGER, content BLOB, PRIMARY KEY (film, first));
"""
_KILLED = """
UPDATE film SET outcome = 'lost', frames = (SELECT coalesce(sum(frames), 0) FROM reel WHERE reel.film = film.id),
    seconds = ? * (SELECT coalesce(sum(frames), 0) FROM reel WHERE reel.film = film.id) WHERE outcome IS NULL
"""
"""What is known of a film that was being made when the server was killed."""


@dataclass
class _Film:
    """One that is being made."""

    id: int
    lease: str
    robot: int
    frames: int = 0
    outcome: str = ""
    tail: int = 0
    reel: list[dict[str, Any]] = field(default_factory=list)


class Replay:
    """The films of a server.

    Args:
        engine: whose loop and leases.
        frames: what draws.
    """

    def __init__(self, engine: Engine, frames: Frames) -> None:
        self._engine, self._frames = engine, frames
        self._path: Path = engine.config.out / "films.sqlite"
        painter = frames.painter
        self._whole = painter is not None and not isinstance(painter, OwnPainter)
        """Whether a look at all robots in every timestep is cheap."""
        every = 1 if self._whole else max(1, round(engine.config.hz / CAMERA_RATE))
        self._every, self._tail = every, round(TAIL * engine.config.hz / every)
        self._past: deque[tuple[float, Step, Array | None]] = deque(
            maxlen=round(LEAD * engine.config.hz) if self._whole else 1
        )
        self._films: dict[int, _Film] = {}
        self._ending: list[_Film] = []
        self._outcomes: dict[str, str] = {}
        self._work: queue.SimpleQueue[Callable[[sqlite3.Connection], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="films", daemon=True)
        with closing(self._connect()) as database:
            database.executescript(_SCHEMA)
            self._next = 1 + (database.execute("SELECT max(id) FROM film").fetchone()[0] or 0)
            database.execute(_KILLED, (every / engine.config.hz,))

    def start(self) -> None:
        """Begin to write."""
        self._engine.herald.subscribe(self._hear)
        self._thread.start()

    def close(self) -> None:
        """Write what there is."""
        for film in [*self._films.values(), *self._ending]:
            self._end(film)
        self._work.put(None)
        if self._thread.is_alive():
            self._thread.join(10.0)

    # -- in the loop's thread -----------------------------------------------------------------------------------

    def on_step(self, loop: Loop, step: Step) -> None:
        """Add the timestep to the films that are being made; begin those of new leases, end those of others."""
        with self._engine.lock:
            leases = {robot: hold.lease for robot, hold in self._engine.offers.holds.items()}
        for robot, film in list(self._films.items()):
            if robot not in leases or leases[robot].id != film.lease:
                del self._films[robot]
                film.tail = self._tail
                self._ending.append(film)
        states = self._frames.painter.copy(np.arange(len(step.mode))) if self._whole and self._frames.painter else None
        now = time.time()
        for robot, lease in leases.items():
            if robot not in self._films:
                film = self._films[robot] = _Film(self._next, lease.id, robot)
                self._next += 1
                row = (film.id, lease.id, robot, lease.operator, lease.reason, lease.since)
                self._do("INSERT INTO film (id, lease, robot, operator, reason, began) VALUES (?, ?, ?, ?, ?, ?)", row)
                for past, before, whole in self._past if self._whole else ():
                    self._add(film, past, before, whole)
        if step.t % self._every == 0:
            for film in [*self._films.values(), *self._ending]:
                self._add(film, now, step, states)
        for film in list(self._ending):
            film.tail -= step.t % self._every == 0
            if film.tail <= 0 and film.lease in self._outcomes:
                self._ending.remove(film)
                self._end(film)
        self._past.append((now, step, states))

    def _add(self, film: _Film, now: float, step: Step, states: Array | None) -> None:
        robot = film.robot
        frame: dict[str, Any] = {
            "t": step.t,
            "time": now,
            "mode": int(step.mode[robot]),
            "action": step.actions[robot],
            "wanted": step.wanted[robot],
            "proposed": step.proposed[robot],
        }
        picture = self._look(robot) if states is None else states[robot]
        if picture is not None:
            frame["picture"] = picture
        film.reel.append(frame)
        if len(film.reel) >= REEL:
            self._cut(film)

    def _look(self, robot: int) -> Array | None:
        """A picture of a robot that is not drawn from its state, as bytes of JPEG (n,) or pixels (H, W, 3)."""
        if self._frames.painter is not None:
            return np.asarray(self._frames.painter.copy(np.array([robot]))[0])
        source = getattr(self._engine.parts.fleet.inner, "jpeg", None)
        found = source(robot, 0) if source is not None else None
        return None if found is None else np.frombuffer(found[1], dtype=np.uint8)

    def _cut(self, film: _Film) -> None:
        """Write the frames so far."""
        reel, first = film.reel, film.frames
        film.reel, film.frames = [], first + len(reel)
        if reel:
            self._work.put(lambda database: _write_reel(database, film.id, first, reel))

    def _end(self, film: _Film) -> None:
        self._cut(film)
        outcome = self._outcomes.pop(film.lease, "lost").partition(" ")
        seconds = float(outcome[2] or 0.0)
        values = (seconds, outcome[0], film.frames, film.id)
        self._do("UPDATE film SET seconds = ?, outcome = ?, frames = ? WHERE id = ?", values)
        if film.id % 100 == 0:
            self._do("DELETE FROM reel WHERE film <= ?", (film.id - KEPT,))
            self._do("DELETE FROM film WHERE id <= ?", (film.id - KEPT,))

    def _do(self, query: str, values: tuple[Any, ...]) -> None:
        def work(database: sqlite3.Connection) -> None:
            database.execute(query, values)

        self._work.put(work)

    def _hear(self, event: Told) -> None:
        if isinstance(event, LeaseEnded):
            if len(self._outcomes) > 1000:  # of leases that no timestep saw
                self._outcomes.pop(next(iter(self._outcomes)))
            self._outcomes[event.lease] = f"{event.why} {event.seconds}"

    # -- the writing thread -------------------------------------------------------------------------------------

    def _run(self) -> None:
        with closing(self._connect()) as database:
            while (work := self._work.get()) is not None:
                with contextlib.suppress(sqlite3.Error):  # a film is a convenience; the record is what counts
                    work(database)

    def _connect(self) -> sqlite3.Connection:
        database = sqlite3.connect(self._path, timeout=10.0, isolation_level=None, check_same_thread=False)
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA synchronous = NORMAL")
        return database

    # -- looking again ------------------------------------------------------------------------------------------

    def episodes(self, limit: int) -> list[dict[str, Any]]:
        """Films that are complete, newest first."""
        query = (
            "SELECT id, robot, operator, reason, began, seconds, outcome, frames FROM film "
            "WHERE outcome IS NOT NULL ORDER BY id DESC LIMIT ?"
        )
        names = ("id", "robot", "operator", "reason", "began", "seconds", "outcome", "frames")
        with closing(self._connect()) as database:
            return [dict(zip(names, row, strict=True)) for row in database.execute(query, (limit,))]

    def episode(self, id: int) -> dict[str, Any] | None:
        """One film: what was done in each frame."""
        names = ("id", "robot", "operator", "reason", "began", "seconds", "outcome")
        with closing(self._connect()) as database:
            row = database.execute(f"SELECT {', '.join(names)} FROM film WHERE id = ?", (id,)).fetchone()
            if row is None:
                return None
            reels = database.execute("SELECT content FROM reel WHERE film = ? ORDER BY first", (id,)).fetchall()
        frames: list[dict[str, Any]] = []
        for (content,) in reels:
            reel = unpack(content)
            for k in range(len(reel["t"])):
                one = {name: _plain(reel[name][k]) for name in ("t", "time", "mode", "action", "wanted", "proposed")}
                frames.append(one)
        return {**dict(zip(names, row, strict=True)), "frames": frames}

    def picture(self, id: int, frame: int, width: int, height: int) -> Frame | None:
        """A frame of a film, drawn now."""
        query = "SELECT first, content FROM reel WHERE film = ? AND first <= ? ORDER BY first DESC LIMIT 1"
        with closing(self._connect()) as database:
            row = database.execute(query, (id, frame)).fetchone()
        if row is None or frame < 0:
            return None
        k, reel = frame - row[0], unpack(row[1])
        if k >= len(reel["t"]) or str(k) not in reel["picture"]:
            return None
        kept, taken = reel["picture"][str(k)], float(reel["time"][k])
        if self._frames.painter is not None:
            drawn = self._frames.draw(kept, width, height)
            return None if drawn is None else Frame(taken, drawn)
        from tutelage.remote.jpeg import decode

        return Frame(taken, fitted(decode(kept.tobytes()), width, height))


def _write_reel(database: sqlite3.Connection, film: int, first: int, reel: list[dict[str, Any]]) -> None:
    tree: Tree = {name: np.array([frame[name] for frame in reel]) for name in ("t", "time", "mode")}
    tree |= {name: np.stack([frame[name] for frame in reel]) for name in ("action", "wanted", "proposed")}
    tree["picture"] = {str(k): np.asarray(frame["picture"]) for k, frame in enumerate(reel) if "picture" in frame}
    database.execute("INSERT INTO reel VALUES (?, ?, ?, ?)", (film, first, len(reel), pack(tree)))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [None if not np.isfinite(x) else round(float(x), 5) for x in value.ravel()]
    return value.item()
