"""The hash chain of the record: what a row's hash is taken over, and the first row that does not fit.

    hash(row) = SHA-256(hash(row before) | id | time | robot | length-prefixed kind, who, fields, arrays)

A row that is altered, inserted, removed or moved breaks the chain at that row or at the next. Cutting off the newest rows
leaves a shorter chain that fits, and so does writing the whole chain anew: what tells these is a `Head`, the number of rows
and the last hash under a key (HMAC-SHA-256) in a file of its own.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import json
import secrets
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tutelage.errors import TutelageError
from tutelage.files import Lock, write_atomic

START = bytes(32)
"""The hash before the first row."""


@dataclass(frozen=True)
class Row:
    """One row of the record.

    Attributes:
        id: 1, 2, 3, ... without gaps.
        time: seconds since 1970, the server's clock.
        kind: what happened: login, offer, lease, command, sample, ...
        who: the operator, "server", or "".
        robot: index, or None.
        fields: JSON object, as text.
        arrays: the arrays of a sample as safetensors, or None.
        previous: the hash of the row before.
        hash: of this row.
    """

    id: int
    time: float
    kind: str
    who: str
    robot: int | None
    fields: str
    arrays: bytes | None
    previous: bytes
    hash: bytes

    def expected(self) -> bytes:
        """The hash that this row should have."""
        return digest(self.previous, self.id, self.time, self.kind, self.who, self.robot, self.fields, self.arrays)


def digest(
    previous: bytes, id: int, time: float, kind: str, who: str, robot: int | None, fields: str, arrays: bytes | None
) -> bytes:
    """The hash of a row, 32 bytes."""
    made = hashlib.sha256(previous)
    made.update(struct.pack(">qdq", id, time, -1 if robot is None else robot))
    for part in (kind.encode(), who.encode(), fields.encode(), b"" if arrays is None else arrays):
        made.update(struct.pack(">q", len(part)))
        made.update(part)
    return made.digest()


@dataclass(frozen=True)
class Verdict:
    """What verification found.

    Attributes:
        ok: every row fits, and none that the head knows is missing.
        rows: how many were read.
        broken_at: id of the first row that is wrong or missing, or None.
        why: one line.
        head: hash of the last row that fits, hexadecimal.
    """

    ok: bool
    rows: int
    broken_at: int | None
    why: str
    head: str


def verify(rows: Iterable[Row], head: Head | None, noted: bytes | None = None) -> Verdict:
    """Follow the chain from its first row.

    Args:
        rows: all of them, by id.
        head: what the head's file says; None where there is none.
        noted: a hash that somebody noted elsewhere earlier: it must be in the chain.
    """
    last, count, seen = START, 0, noted is None or noted == START  # noted when there was no row yet
    for row in rows:
        at = count + 1
        why = ""
        if row.id != at:
            why = f"row {at} is missing"
        elif row.previous != last:
            why = f"row {at} does not follow the row before it"
        elif row.hash != row.expected():
            why = f"row {at} was altered"
        elif head and head.rows == at and head.hash != row.hash:
            why = f"row {at} is not the one that the head's file names: the record was rewritten"
        if why:
            return Verdict(False, count, at, why, last.hex())
        last, count = row.hash, at
        seen = seen or hmac.compare_digest(last, noted or b"")
    if head and head.rows > count:
        return Verdict(
            False, count, count + 1, f"the newest {head.rows - count} of {head.rows} rows were cut off", last.hex()
        )
    if not seen:
        return Verdict(False, count, None, "the noted hash is not in the record: it was rewritten or cut off", last.hex())
    return Verdict(True, count, None, f"all {count} rows fit", last.hex())


@dataclass(frozen=True)
class Head:
    """The newest row that is known to have existed: how many rows, and the last hash."""

    rows: int
    hash: bytes


class HeadFile:
    """The head of the chain in `record.head`, under the key in `record.key` (mode 0600, made at first).

    It protects against somebody who can change or cut the database but not read the key, such as with a copy of it. It
    does not protect against one who acts as the server's user, nor does it notice that the whole folder was put back to an
    older state: note the hash that `tutelage audit verify` prints elsewhere, and give it to it later.
    """

    def __init__(self, folder: Path) -> None:
        """folder: of the record."""
        self.path, self._key_path = folder / "record.head", folder / "record.key"
        self._lock = Lock(folder / "record.lock")

    def read(self) -> Head | None:
        """What the file says, or None where there is neither file nor key.

        Raises:
            TutelageError: it was altered, or only one of the two files is there.
        """
        if not self._key_path.exists() and not self.path.exists():
            return None
        try:
            content = json.loads(self.path.read_bytes())
            head = Head(int(content["rows"]), bytes.fromhex(content["hash"]))
            mac = bytes.fromhex(content["mac"])
            key = self._key_path.read_bytes()
        except FileNotFoundError as error:
            raise TutelageError(f"{error.filename} is missing: what was cut off the record cannot be told") from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise TutelageError(f"{self.path} is damaged: {error}") from None
        if not hmac.compare_digest(mac, self._mac(key, head)):
            raise TutelageError(f"{self.path} was altered, or belongs to another key")
        return head

    def write(self, head: Head) -> None:
        """Replace it, unless another process wrote a newer one. Raises TutelageError where the disk is full."""
        with self._lock:
            with contextlib.suppress(TutelageError):  # a damaged one
                there = self.read()
                if there and there.rows > head.rows:
                    return
            if not self._key_path.exists():
                write_atomic(self._key_path, secrets.token_bytes(32), private=True)
            mac = self._mac(self._key_path.read_bytes(), head)
            content = {"version": 1, "rows": head.rows, "hash": head.hash.hex(), "mac": mac.hex()}
            write_atomic(self.path, json.dumps(content).encode(), private=True)

    @staticmethod
    def _mac(key: bytes, head: Head) -> bytes:
        return hmac.digest(key, b"tutelage record head 1" + struct.pack(">q", head.rows) + head.hash, "sha256")
