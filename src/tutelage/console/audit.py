"""The record: every allocation, command, lease, reset and login, and every sample of an intervention, durably.

One SQLite file (WAL, synchronous=FULL) with hash-chained rows (`console.chain`). One thread writes: what arrives while it
commits is committed together next (group commit), so `write` costs microseconds and `flush` one wait for the disk.
Other processes, such as `tutelage accounts`, may write to the same file.
"""

from __future__ import annotations

import json
import math
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as save_arrays

from tutelage.console.chain import START, Head, HeadFile, Row, Verdict, digest
from tutelage.console.records import COLUMNS, NOT_BULK, SAMPLE, connect, head_of
from tutelage.console.records import RecordError as RecordError
from tutelage.console.records import Sample as Sample
from tutelage.console.records import samples_in as samples_in
from tutelage.console.records import verify_folder as verify_folder
from tutelage.errors import TutelageError

Array = NDArray[Any]
_Waiting = tuple[float, str, str, int | None, str, bytes | None]

VERSION = 1
_PENDING_MAX = 200_000
_HEAD_EVERY = 1.0
_RETRY_EVERY = 0.5
_SCHEMA = """
CREATE TABLE IF NOT EXISTS record (
    id INTEGER PRIMARY KEY, time REAL NOT NULL, kind TEXT NOT NULL, who TEXT NOT NULL, robot INTEGER,
    fields TEXT NOT NULL, arrays BLOB, previous BLOB NOT NULL, hash BLOB NOT NULL);
CREATE INDEX IF NOT EXISTS record_kind ON record (kind, id);
""" + "".join(
    f"CREATE INDEX IF NOT EXISTS record_{name} ON record ({columns}) WHERE {NOT_BULK};"
    for name, columns in {"rare": "id", "who": "who, id", "robot": "robot, id"}.items()
)
"""The bulky kinds are in one index only: they are written most, and listed least."""


class Audit:
    """The record in a folder. Thread-safe.

    Args:
        folder: made if absent; the database is `record.sqlite`.
        clock: seconds since 1970.

    Raises:
        RecordError: the folder cannot be written, or holds a record of another version.
    """

    def __init__(self, folder: Path, clock: Callable[[], float] = time.time) -> None:
        self.path, self._clock = folder / "record.sqlite", clock
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._prepare()
        except (OSError, sqlite3.Error) as error:
            raise RecordError(f"cannot write the record {self.path}: {error}") from None
        self._head_file = HeadFile(folder)
        self._known = self._check_head()
        self._changed = threading.Condition()
        self._pending: list[_Waiting] = []
        self._asked = self._done = 0
        self._error: str | None = None
        self._closing = False
        self._listeners: list[Callable[[str | None], None]] = []
        self._thread = threading.Thread(target=self._run, name="record", daemon=True)
        self._thread.start()

    @property
    def error(self) -> str | None:
        """Why nothing can be written at present, or None. What waits is tried again until it works."""
        return self._error

    def write(self, kind: str, who: str = "", robot: int | None = None, **fields: Any) -> None:
        """Add a row; returns at once.

        fields: JSON values, or numpy scalars and arrays; numbers that are not finite become null.

        Raises:
            RecordError: the record cannot be written at present, so what it tells of should not happen either.
        """
        self._add(kind, who, robot, _text(fields), None)

    def write_now(self, kind: str, who: str = "", robot: int | None = None, **fields: Any) -> None:
        """Add a row and wait until it is on the disk. Raises RecordError as `flush`."""
        self.write(kind, who, robot, **fields)
        self.flush()

    def sample(self, who: str, robot: int, arrays: Mapping[str, Array], **fields: Any) -> None:
        """Add one timestep of an intervention: arrays such as obs, proposed, executed, wanted, kept exactly (dtype, shape);
        fields such as t, lease, policy_version.

        Raises:
            RecordError: as for `write`.
        """
        self._add(SAMPLE, who, robot, _text(fields), save_arrays({k: np.asarray(v, order="C") for k, v in arrays.items()}))

    def flush(self, timeout: float = 10.0) -> None:
        """Wait until all that was written before this call is on the disk.

        Raises:
            RecordError: it cannot be written, or not within `timeout` seconds. It stays waiting and is tried again.
        """
        with self._changed:
            until = self._asked
            self._changed.notify_all()
            if not self._changed.wait_for(lambda: self._done >= until or self._error is not None, timeout):
                raise RecordError(f"the record is not on the disk after {timeout:g} s")
            if self._done < until:
                raise RecordError(str(self._error))

    def close(self) -> None:
        """Write what waits, and the head. Raises RecordError where that is impossible."""
        with self._changed:
            if self._closing:
                return
            self._closing = True
            self._changed.notify_all()
        self._thread.join()
        if self._done < self._asked:
            raise RecordError(f"{self._asked - self._done} rows are lost: {self._error}")

    # -- reading ------------------------------------------------------------------------------------------------

    def rows(
        self,
        before: int | None = None,
        limit: int = 100,
        kind: str | None = None,
        who: str | None = None,
        robot: int | None = None,
    ) -> list[Row]:
        """The newest `limit` rows with an id below `before`, newest first, without their arrays; without the kinds of `BULK`
        unless `kind` names one."""
        where, values = ["id < ?"], [before if before is not None else 2**62]
        for column, value in (("kind", kind), ("who", who), ("robot", robot)):
            if value is not None:
                where.append(f"{column} = ?")
                values.append(value)  # type: ignore[arg-type]
        if kind is None:
            where.append(NOT_BULK)
        columns = COLUMNS.replace("arrays", "NULL")
        query = f"SELECT {columns} FROM record WHERE {' AND '.join(where)} ORDER BY id DESC LIMIT ?"
        with closing(self._connect()) as database:
            return [Row(*row) for row in database.execute(query, [*values, limit])]

    def all_rows(self, after: int = 0, kind: str | None = None, arrays: bool = True) -> Iterator[Row]:
        """Every row with an id above `after`, oldest first."""
        columns = COLUMNS if arrays else COLUMNS.replace("arrays", "NULL")
        where, values = ("", []) if kind is None else (" AND kind = ?", [kind])
        with closing(self._connect()) as database:
            for row in database.execute(f"SELECT {columns} FROM record WHERE id > ?{where} ORDER BY id", [after, *values]):
                yield Row(*row)

    def samples(self, after: int = 0) -> Iterator[Sample]:
        """Every sample with an id above `after`, oldest first.

        Raises:
            RecordError: a row's arrays are damaged.
        """
        return samples_in(self.path.parent, after)

    def head(self) -> Head:
        """The newest durable row: its id and hash."""
        with closing(self._connect()) as database:
            return head_of(database)

    def verify(self, noted: bytes | None = None) -> Verdict:
        """Read the whole record and find the first row that was altered, removed or cut off; see `console.chain`.

        noted: a hash that was noted elsewhere earlier; it must be there.
        """
        return verify_folder(self.path.parent, noted)

    # -- the writing thread -------------------------------------------------------------------------------------

    def _add(self, kind: str, who: str, robot: int | None, fields: str, arrays: bytes | None) -> None:
        row = self._clock(), kind, who, None if robot is None else int(robot), fields, arrays
        with self._changed:
            if self._closing:
                raise RecordError("the record is closed")
            if self._error is not None or len(self._pending) >= _PENDING_MAX:
                raise RecordError(self._error or f"{_PENDING_MAX} rows wait to be recorded: the disk is too slow")
            self._pending.append(row)
            self._asked += 1
            self._changed.notify_all()

    def _run(self) -> None:
        database = self._connect()
        head_due, last = time.monotonic(), Head(0, START)
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._pending or self._closing, None if not last.rows else _HEAD_EVERY)
                    batch, self._pending = self._pending, []
                    closing_now = self._closing
                try:
                    if batch:
                        last = self._known = _commit(database, batch, self._known)
                        with self._changed:
                            self._done += len(batch)
                            self._error = None
                            self._changed.notify_all()
                        batch = []
                    if last.rows and (closing_now or time.monotonic() >= head_due):
                        self._head_file.write(last)
                        last, head_due = Head(0, START), time.monotonic() + _HEAD_EVERY
                except (sqlite3.Error, TutelageError, OSError) as error:
                    with self._changed:
                        self._pending = batch + self._pending
                        self._error = f"the record in {self.path.parent} cannot be written: {error}"
                        self._changed.notify_all()
                        if not self._closing:
                            self._changed.wait(_RETRY_EVERY)
                with self._changed:
                    if self._closing and (self._error is not None or not self._pending):
                        return
        finally:
            database.close()

    def _check_head(self) -> Head:
        """A record that was cut off or rewritten is not continued, as that would hide it."""
        known = self._head_file.read()
        with closing(self._connect()) as database:
            newest = head_of(database)
            if known and known.rows:
                row = database.execute("SELECT hash FROM record WHERE id = ?", [known.rows]).fetchone()
                if row is None or row[0] != known.hash:
                    raise RecordError(
                        f"the record in {self.path.parent} was cut off or rewritten: see tutelage audit verify; "
                        "move its files record.* elsewhere to begin a new one"
                    )
        return newest

    def _prepare(self) -> None:
        with closing(self._connect()) as database:
            found = database.execute("PRAGMA user_version").fetchone()[0]
            if found not in (0, VERSION):
                raise RecordError(f"{self.path} has version {found} and this Tutelage reads version {VERSION}")
            self.path.chmod(0o600)
            database.executescript(f"BEGIN IMMEDIATE; {_SCHEMA} PRAGMA user_version = {VERSION}; COMMIT;")

    def _connect(self) -> sqlite3.Connection:
        return connect(self.path)


def _commit(database: sqlite3.Connection, batch: list[_Waiting], known: Head) -> Head:
    """One transaction. The head is read anew each time, as another process may have written."""
    database.execute("BEGIN IMMEDIATE")
    try:
        head = head_of(database)
        if head.rows < known.rows:
            raise RecordError(f"rows after {head.rows} were cut off")
        id, last = head.rows, head.hash
        made = []
        for time_, kind, who, robot, fields, arrays in batch:
            id, previous = id + 1, last
            last = digest(previous, id, time_, kind, who, robot, fields, arrays)
            made.append((id, time_, kind, who, robot, fields, arrays, previous, last))
        database.executemany("INSERT INTO record VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", made)
        database.execute("COMMIT")
    except BaseException:
        if database.in_transaction:
            database.execute("ROLLBACK")
        raise
    return Head(id, last)


def _text(fields: Mapping[str, Any]) -> str:
    try:
        return json.dumps(fields, allow_nan=False, default=_plain, separators=(",", ":"))
    except ValueError:
        return json.dumps(_finite(json.loads(json.dumps(fields, default=_plain))), separators=(",", ":"))


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return str(value)


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    return [_finite(v) for v in value] if isinstance(value, list) else value
