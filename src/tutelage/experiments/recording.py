"""Subscribers that write a run down. Each can be cut back to a timestep: a resumed run leaves no trace of the crash."""

from __future__ import annotations

import json
import os
import re
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from tutelage.errors import MissingExtraError, RunFolderError, TutelageError
from tutelage.files import claimed
from tutelage.fleet.events import Events
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step
from tutelage.fleet.tally import Tally
from tutelage.store import write_atomic


class EventStore:
    """`events.sqlite`: every allocation, intervention, fall, reset and success, in order.

    Table `events(t, robot, human, event, mode)`; `event` and `mode` are the numbers of `tutelage.fleet.modes`.

    Attributes:
        written: number of events that this run has written down.
    """

    def __init__(self, path: Path) -> None:
        self.written = 0
        try:
            self._db = sqlite3.connect(path)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.execute(
                "CREATE TABLE IF NOT EXISTS events(t INTEGER, robot INTEGER, human INTEGER, event INTEGER, mode INTEGER)"
            )
            self._db.commit()
        except sqlite3.Error as error:
            raise RunFolderError(f"cannot open {path}: {error}; restore the file or start a new run") from None

    def add(self, events: Events) -> None:
        """Append events."""
        if len(events.t):
            rows = np.stack(events, axis=1).tolist()
            with _writing("events.sqlite"):
                self._db.executemany("INSERT INTO events VALUES (?, ?, ?, ?, ?)", rows)
            self.written += len(rows)

    def commit(self) -> None:
        """Show everything so far to readers. A crash of the process loses none of it, a power cut may."""
        with _writing("events.sqlite"):
            self._db.commit()

    def sync(self) -> None:
        """Make everything so far durable: SQLite syncs its log when it moves it into the file."""
        self.commit()
        with _writing("events.sqlite"):
            self._db.execute("PRAGMA wal_checkpoint(FULL)").fetchall()

    def count(self, t: int) -> int:
        """Number of events before timestep t."""
        with _writing("events.sqlite"):
            return int(self._db.execute("SELECT COUNT(*) FROM events WHERE t < ?", (t,)).fetchone()[0])

    def cut(self, t: int) -> None:
        """Forget timestep t and all later ones."""
        with _writing("events.sqlite"):
            self._db.execute("DELETE FROM events WHERE t >= ?", (t,))
            self._db.commit()
        self.written = self.count(t)

    def close(self) -> None:
        """Commit and close."""
        self.commit()
        with _writing("events.sqlite"):
            self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            self._db.close()


class MetricsFile:
    """`metrics.jsonl`: one line of cumulative metrics every so many timesteps.

    Attributes:
        written: number of lines that this run has written down.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.written = 0
        self._file = self._open()

    def write(self, row: dict[str, float]) -> None:
        """Append a line."""
        with _writing(self._path.name):
            self._file.write(json.dumps(row) + "\n")
            self._file.flush()
        self.written += 1

    def commit(self) -> None:
        """Make everything so far durable."""
        with _writing(self._path.name):
            self._file.flush()
            os.fsync(self._file.fileno())

    def lines(self, t: int) -> list[str]:
        """The lines of the first t timesteps, up to one that cannot be read."""
        kept = []
        for line in self._path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                if json.loads(line)["t"] > t:
                    break
            except (json.JSONDecodeError, TypeError, KeyError):
                break
            kept.append(line + "\n")
        return kept

    def cut(self, t: int) -> None:
        """Keep the lines of the first t timesteps; drop the rest, and a line that a crash left half written."""
        self._file.close()
        kept = self.lines(t)
        write_atomic(self._path, "".join(kept).encode())  # a crash while resuming must not lose what was kept
        self._file = self._open()
        self.written = len(kept)

    def _open(self) -> TextIO:
        try:
            return open(self._path, "a", encoding="utf-8")  # held for the length of the run
        except OSError as error:
            raise RunFolderError(f"cannot open {self._path}: {error.strerror}; restore it or start a new run") from None

    def close(self) -> None:
        """Flush and close."""
        self.commit()
        self._file.close()


class EpisodeFrames:
    """`episodes/*.parquet`: frames in the field's names, one file between two checkpoints.

    Columns: timestep, robot, episode_index, frame_index, observation.state or observation.images.camera, action (executed),
    action.proposed (by the policy), action.wanted (by the human; the executed one where none acted), next.reward,
    next.success, next.violation, intervention (bool), operator (human, -1 for none), policy_version (number of timesteps the
    policy has learned from). An image is a tensor (H, W, 3) uint8.
    """

    ROOM = 2**26
    """Bytes of frames that are kept as they are; beyond that they are compressed in memory until the next commit."""

    def __init__(self, folder: Path, which: str, robots: int) -> None:
        try:
            import pyarrow  # noqa: F401
        except ImportError:
            raise MissingExtraError("pyarrow", "data") from None
        self._folder, self._which = folder, which
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise RunFolderError(f"cannot write to {folder}: {error.strerror}; restore it or start a new run") from None
        self._start = self._bytes = 0
        self._columns: dict[str, list[Any]] = {}
        self._file: Any = None
        self.episode = np.arange(robots)
        self.frame = np.zeros(robots, dtype=np.int64)

    def add(self, step: Step) -> None:
        """Keep the frames of a timestep that are asked for."""
        moving, human = step.moved, step.taught
        keep = human if self._which == "human" else moving
        (robots,) = np.nonzero(keep)
        if robots.size:
            seen = step.obs[robots]
            images = seen.dtype == np.uint8
            columns = {
                "timestep": np.full(robots.size, step.t),
                "robot": robots,
                "episode_index": self.episode[robots],
                "frame_index": self.frame[robots],
                "observation.images.camera" if images else "observation.state": seen if images else seen.astype(np.float32),
                "action": step.actions[robots],
                "action.proposed": step.proposed[robots].astype(np.float32),
                "action.wanted": np.where(human[:, None], step.wanted, step.actions)[robots],
                "next.reward": step.reward[robots],
                "next.success": step.success[robots],
                "next.violation": step.violation[robots],
                "intervention": human[robots],
                "operator": step.human[robots],
                "policy_version": np.full(robots.size, step.t),
            }
            for name, column in columns.items():
                self._columns.setdefault(name, []).append(column)
                self._bytes += column.nbytes
            if self._bytes > self.ROOM:
                self._compress()
        self.frame[moving] += 1
        ended = moving & (step.violation | step.success | step.truncated)
        self.frame[ended] = 0
        self.episode[ended] += len(self.episode)  # robot i has episodes i, i + N, i + 2N, ...

    def commit(self, t: int) -> None:
        """Write the frames since the last commit as one durable file."""
        if self._columns:
            self._compress()
        if self._file:
            content, writer = self._file
            writer.close()
            write_atomic(self._folder / f"steps-{self._start:08d}-{t:08d}.parquet", content.getvalue().to_pybytes())
        self._file, self._start = None, t

    def _compress(self) -> None:
        """Append the frames at hand to the file that is being made in memory."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pa.table({name: _arrow(np.concatenate(parts)) for name, parts in self._columns.items()})
        if self._file is None:
            content = pa.BufferOutputStream()
            self._file = content, pq.ParquetWriter(content, table.schema, compression="zstd")
        self._file[1].write_table(table)
        self._columns, self._bytes = {}, 0

    def cut(self, t: int) -> None:
        """Drop the files of timestep t and later ones."""
        for path in self._folder.glob("steps-*.parquet"):
            if (named := re.fullmatch(r"steps-(\d+)-\d+", path.stem)) and int(named[1]) >= t:
                with _writing(str(path)):
                    path.unlink()
        self._start = t

    def state_dict(self) -> dict[str, Any]:
        """Episode and frame numbers of the robots."""
        return {"episode": self.episode.copy(), "frame": self.frame.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.episode, self.frame = state["episode"].copy(), state["frame"].copy()


def _arrow(values: Any) -> Any:
    """A column (n,), (n, width) or of images (n, H, W, 3) as an Arrow array."""
    import pyarrow as pa

    if values.ndim == 1:
        return pa.array(values)
    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
    return pa.FixedShapeTensorArray.from_numpy_ndarray(values)


class Recorder:
    """Writes a run down: events and metrics always, frames on request. Keeps the running tally.

    Args:
        folder: the run folder.
        robots: N, humans: M.
        steps: T, after which a last line of metrics is written in any case.
        every: timesteps between lines of metrics.
        frames: "human", "all" or "none".
    """

    def __init__(self, folder: Path, robots: int, humans: int, steps: int, every: int, frames: str) -> None:
        self.tally = Tally(robots, humans)
        self.events = EventStore(folder / "events.sqlite")
        self.metrics = MetricsFile(folder / "metrics.jsonl")
        self.frames = EpisodeFrames(folder / "episodes", frames, robots) if frames != "none" else None
        self.steps, self.every = steps, every
        self.losses: dict[str, float] = {}
        self._folder = folder
        self._written: dict[str, int] = {}

    def on_start(self, loop: Loop) -> None:
        """Nothing to do."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """Write the step down."""
        self.tally.update(step)
        self.events.add(step.events)
        self.losses |= step.losses
        if self.frames:
            self.frames.add(step)
        if self.due(loop.t):
            self.metrics.write(self.row())
            self.events.commit()  # a report of a live run sees both

    def due(self, t: int) -> bool:
        """Whether a line of metrics is written after t timesteps."""
        return t % self.every == 0 or t == self.steps

    def row(self) -> dict[str, float]:
        """The metrics so far and the latest losses."""
        return {**self.tally.summary(), **{f"loss/{name}": loss for name, loss in self.losses.items()}}

    def on_end(self, loop: Loop) -> None:
        """Nothing to do: the run closes its recorder after everybody has heard of the end."""

    def close(self) -> None:
        """Make everything durable and close the files."""
        self.events.close()
        self.metrics.close()

    def commit(self, t: int) -> None:
        """Make the first t timesteps durable."""
        self.events.sync()
        self.metrics.commit()
        if self.frames:
            self.frames.commit(t)

    def cut(self, t: int) -> None:
        """Forget timestep t and all later ones.

        Raises:
            RunFolderError: what the restored state says was written down before is not there any more; nothing is cut.
        """
        found = {"events.sqlite": self.events.count(t), "metrics.jsonl": len(self.metrics.lines(t))}
        for name, count in found.items():
            if count != self._written.get(name, count):
                raise RunFolderError(
                    f"{self._folder / name} is damaged: {count:,} readable entries before timestep {t:,}, and "
                    f"{self._written[name]:,} were written; restore it or start a new run"
                )
        self.events.cut(t)
        self.metrics.cut(t)
        if self.frames:
            self.frames.cut(t)

    def state_dict(self) -> dict[str, Any]:
        """Tally, last losses, episode numbers, and how much is written down."""
        return {
            "tally": self.tally.state_dict(),
            "losses": dict(self.losses),
            "written": {"events.sqlite": self.events.written, "metrics.jsonl": self.metrics.written},
            **({"frames": self.frames.state_dict()} if self.frames else {}),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.tally.load_state_dict(state["tally"])
        self.losses = dict(state["losses"])
        self._written = dict(state.get("written", {}))  # older checkpoints do not say
        if self.frames:
            self.frames.load_state_dict(state["frames"])


@contextmanager
def _writing(name: str) -> Iterator[None]:
    """A full disk becomes one clear line, and so does a damaged database."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        if type(error) is sqlite3.DatabaseError:  # what a disk or another process does is an OperationalError
            raise RunFolderError(f"{name} is damaged: {error}; restore it or start a new run") from None
        reason = getattr(error, "strerror", None) or str(error)
        raise TutelageError(f"cannot write {name}: {reason}; free some space, then continue with: tutelage resume") from None


def lock(folder: Path) -> TextIO:
    """Claim a run folder for this process, and make it if need be; the claim ends with the process or `close`.

    Raises:
        RunFolderError: another process is running there, or nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = open(folder / ".lock", "w")  # noqa: SIM115 - held for the length of the run
        ours = claimed(file.fileno())
    except OSError as error:
        raise RunFolderError(f"cannot write to {folder}: {error.strerror}; choose another folder") from None
    if not ours:
        file.close()
        raise RunFolderError(f"{folder} is in use by another process; wait for it or choose another folder")
    return file
