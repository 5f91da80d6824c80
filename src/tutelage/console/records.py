"""Reading the record (see `console.audit`), in the server's process or in another."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays

from tutelage.console.chain import START, Head, HeadFile, Row, Verdict, verify
from tutelage.errors import TutelageError

Array = NDArray[Any]

SAMPLE = "sample"
"""Kind of the rows that hold the arrays of one timestep of an intervention."""
BULK = (SAMPLE, "command")
"""Kinds so frequent that a list of the record leaves them out unless asked."""
NOT_BULK = f"kind NOT IN ({', '.join(repr(kind) for kind in BULK)})"  # literally so, or no partial index is used
COLUMNS = "id, time, kind, who, robot, fields, arrays, previous, hash"


class RecordError(TutelageError):
    """The record cannot be written (disk full, folder gone): nothing more is to be done that must be recorded."""


@dataclass(frozen=True)
class Sample:
    """One timestep of an intervention, as `Audit.sample` was given it."""

    id: int
    time: float
    who: str
    robot: int
    fields: dict[str, Any]
    arrays: dict[str, Array]


def verify_folder(folder: Path, noted: bytes | None = None) -> Verdict:
    """`Audit.verify` of a record that no process needs to have open.

    Raises:
        RecordError: there is no record, or it is no database.
    """
    path = folder / "record.sqlite"
    if not path.exists():
        raise RecordError(f"there is no record in {folder}: no such file: {path}")
    try:
        head = HeadFile(folder).read()
    except TutelageError as error:
        return Verdict(False, 0, None, str(error), "")
    try:
        with closing(connect(path)) as database:
            rows = database.execute(f"SELECT {COLUMNS} FROM record ORDER BY id")
            return verify((Row(*row) for row in rows), head, noted)
    except sqlite3.Error as error:
        raise RecordError(f"{path} cannot be read: {error}") from None


def samples_in(folder: Path, after: int = 0) -> Iterator[Sample]:
    """`Audit.samples` of a record that another process may be writing.

    Raises:
        RecordError: there is no record, or a row's arrays are damaged.
    """
    path = folder / "record.sqlite"
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=10.0)) as database:
            query = f"SELECT {COLUMNS} FROM record WHERE id > ? AND kind = ? ORDER BY id"
            for row in (Row(*values) for values in database.execute(query, [after, SAMPLE])):
                arrays = load_arrays(row.arrays or b"")
                robot = -1 if row.robot is None else row.robot
                yield Sample(row.id, row.time, row.who, robot, json.loads(row.fields), arrays)
    except sqlite3.Error as error:
        raise RecordError(f"{path} cannot be read: {error}") from None
    except (SafetensorError, ValueError, KeyError) as error:
        raise RecordError(f"row {row.id} of {path} is damaged: {error}") from None


def connect(path: Path) -> sqlite3.Connection:
    """The database, made if absent; what is committed is on the disk."""
    database = sqlite3.connect(path, timeout=10.0, isolation_level=None, check_same_thread=False)
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA synchronous = FULL")
    return database


def head_of(database: sqlite3.Connection) -> Head:
    """The newest row's id and hash."""
    row = database.execute("SELECT id, hash FROM record ORDER BY id DESC LIMIT 1").fetchone()
    return Head(*row) if row else Head(0, START)
