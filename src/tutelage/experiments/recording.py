"""Subscribers that write a run down. Each can be cut back to a timestep: a resumed run leaves no trace of the crash."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from tutelage.errors import MissingExtraError, RunFolderError, TutelageError
from tutelage.fleet.events import Events
from tutelage.fleet.loop import Loop
from tutelage.fleet.modes import MOVING, Mode
from tutelage.fleet.step import Step
from tutelage.fleet.tally import Tally
from tutelage.store import write_atomic


class EventStore:
    """`events.sqlite`: every allocation, intervention, fall, reset and success, in order.

    Table `events(t, robot, human, event, mode)`; `event` and `mode` are the numbers of `tutelage.fleet.modes`.
    """

    def __init__(self, path: Path) -> None:
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

    def commit(self) -> None:
        """Make everything so far durable."""
        with _writing("events.sqlite"):
            self._db.commit()

    def cut(self, t: int) -> None:
        """Forget timestep t and all later ones."""
        self._db.execute("DELETE FROM events WHERE t >= ?", (t,))
        self._db.commit()

    def close(self) -> None:
        """Commit and close."""
        self.commit()
        self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        self._db.close()


class MetricsFile:
    """`metrics.jsonl`: one line of cumulative metrics every so many timesteps."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: TextIO = open(path, "a", encoding="utf-8")  # noqa: SIM115 - held for the length of the run

    def write(self, row: dict[str, float]) -> None:
        """Append a line."""
        with _writing(self._path.name):
            self._file.write(json.dumps(row) + "\n")
            self._file.flush()

    def commit(self) -> None:
        """Make everything so far durable."""
        with _writing(self._path.name):
            self._file.flush()
            os.fsync(self._file.fileno())

    def cut(self, t: int) -> None:
        """Keep the lines of the first t timesteps; drop the rest, and a line that a crash left half written."""
        self._file.close()
        kept = []
        for line in self._path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                if json.loads(line)["t"] > t:
                    break
            except (json.JSONDecodeError, TypeError, KeyError):
                break
            kept.append(line + "\n")
        write_atomic(self._path, "".join(kept).encode())  # a crash while resuming must not lose what was kept
        self._file = open(self._path, "a", encoding="utf-8")  # noqa: SIM115

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
        folder.mkdir(exist_ok=True)
        self._start = self._bytes = 0
        self._columns: dict[str, list[Any]] = {}
        self._file: Any = None
        self.episode = np.arange(robots)
        self.frame = np.zeros(robots, dtype=np.int64)

    def add(self, step: Step) -> None:
        """Keep the frames of a timestep that are asked for."""
        moving = MOVING[step.mode]
        human = step.mode == Mode.TELEOPERATED
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
            if int(path.stem.split("-")[1]) >= t:
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
        self.events.commit()
        self.metrics.commit()
        if self.frames:
            self.frames.commit(t)

    def cut(self, t: int) -> None:
        """Forget timestep t and all later ones."""
        self.events.cut(t)
        self.metrics.cut(t)
        if self.frames:
            self.frames.cut(t)

    def state_dict(self) -> dict[str, Any]:
        """Tally, last losses, episode numbers."""
        return {
            "tally": self.tally.state_dict(),
            "losses": dict(self.losses),
            **({"frames": self.frames.state_dict()} if self.frames else {}),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.tally.load_state_dict(state["tally"])
        self.losses = dict(state["losses"])
        if self.frames:
            self.frames.load_state_dict(state["frames"])


@contextmanager
def _writing(name: str) -> Iterator[None]:
    """A full disk becomes one clear line."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
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
    except OSError as error:
        raise RunFolderError(f"cannot write to {folder}: {error.strerror}; choose another folder") from None
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:  # pragma: no cover - Windows has no such lock
        pass
    except OSError:
        raise RunFolderError(f"{folder} is in use by another process; wait for it or choose another folder") from None
    return file
