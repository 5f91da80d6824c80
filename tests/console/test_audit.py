"""The record: durable, chained, and an error where it cannot be written."""

from __future__ import annotations

import contextlib
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tutelage.console.audit import Audit, RecordError, samples_in, verify_folder
from tutelage.console.chain import START, Row, digest, verify
from tutelage.errors import TutelageError


@pytest.fixture
def audit(tmp_path: Path) -> Iterator[Audit]:
    made = Audit(tmp_path)
    yield made
    with contextlib.suppress(RecordError):
        made.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A record of ten rows that is closed."""
    with contextlib.closing(Audit(tmp_path)) as audit:
        for i in range(10):
            audit.write("command", "ana", i % 3, seq=i)
    return tmp_path


def change(folder: Path, *statements: str) -> None:
    with contextlib.closing(sqlite3.connect(folder / "record.sqlite")) as database, database:
        for statement in statements:
            database.execute(statement)


def test_what_is_flushed_is_read_back_newest_first(audit: Audit) -> None:
    audit.write("login", "ana", address="127.0.0.1")
    audit.write("allocation", "server", 3, human=np.int64(1), rank=np.float32(np.nan))
    audit.flush()
    rows = audit.rows()
    assert [(row.id, row.kind, row.who, row.robot, row.fields) for row in rows] == [
        (2, "allocation", "server", 3, '{"human":1,"rank":null}'),
        (1, "login", "ana", None, '{"address":"127.0.0.1"}'),
    ]
    assert rows[0].previous == rows[1].hash
    assert audit.head().rows == 2


def test_lists_are_filtered_and_paged_and_leave_out_what_is_bulky(audit: Audit) -> None:
    for i in range(6):
        audit.write("lease", "ana" if i % 2 else "ben", i)
        audit.write("command", "ana", i)
    audit.flush()
    assert {row.kind for row in audit.rows()} == {"lease"}
    assert len(audit.rows(kind="command")) == 6
    assert [row.robot for row in audit.rows(who="ana")] == [5, 3, 1]
    assert [row.id for row in audit.rows(robot=4)] == [9]
    newest = audit.rows(limit=2)
    assert [row.id for row in audit.rows(before=newest[-1].id, limit=2)] == [7, 5]


@given(
    st.dictionaries(
        st.text(min_size=1, max_size=5),
        st.sampled_from(["float32", "float64", "uint8", "int64", "bool"]).flatmap(
            lambda kind: st.lists(st.integers(0, 3), max_size=3).map(lambda shape: np.ones(shape, dtype=kind))
        ),
        max_size=4,
    )
)
def test_samples_come_back_exactly(tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, np.ndarray]) -> None:
    folder = tmp_path_factory.mktemp("record")
    with contextlib.closing(Audit(folder)) as audit:
        audit.sample("ana", 2, arrays, t=5, policy_version=3)
        audit.flush()
    (sample,) = samples_in(folder)
    assert (sample.who, sample.robot, sample.fields) == ("ana", 2, {"t": 5, "policy_version": 3})
    assert sample.arrays.keys() == arrays.keys()
    for name, array in arrays.items():
        assert sample.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(sample.arrays[name], array)


def test_only_samples_after_the_ones_that_are_known_are_read(audit: Audit) -> None:
    for t in range(5):
        audit.write("lease", "ana", 0)
        audit.sample("ana", 0, {"obs": np.zeros(3)}, t=t)
    audit.flush()
    first = next(audit.samples())
    assert [sample.fields["t"] for sample in audit.samples(first.id)] == [1, 2, 3, 4]


def test_many_threads_write_one_chain(audit: Audit) -> None:
    def work(name: str) -> None:
        for i in range(200):
            audit.write("command", name, seq=i)
            if i % 50 == 0:
                audit.flush()

    threads = [threading.Thread(target=work, args=(f"person-{k}",)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    audit.flush()
    assert audit.verify().ok
    for k in range(8):
        seqs = [row.fields for row in audit.all_rows() if row.who == f"person-{k}"]
        assert seqs == [f'{{"seq":{i}}}' for i in range(200)]


def test_two_processes_write_one_chain(folder: Path) -> None:
    one, two = Audit(folder), Audit(folder)
    for i in range(5):
        one.write("a", seq=i)
        two.write("b", seq=i)
        one.flush()
        two.flush()
    one.close()
    two.close()
    verdict = verify_folder(folder)
    assert verdict.ok
    assert verdict.rows == 20


# -- what verification finds ------------------------------------------------------------------------------------


def test_a_whole_record_fits(folder: Path) -> None:
    verdict = verify_folder(folder)
    assert verdict.ok
    assert verdict.rows == 10


@pytest.mark.parametrize(
    ("statement", "at"),
    [
        ("UPDATE record SET who = 'eve' WHERE id = 4", 4),
        ("UPDATE record SET fields = '{}' WHERE id = 4", 4),
        ("UPDATE record SET time = time + 1 WHERE id = 4", 4),
        ("UPDATE record SET robot = NULL WHERE id = 4", 4),
        ("UPDATE record SET arrays = x'00' WHERE id = 4", 4),
        ("DELETE FROM record WHERE id = 4", 4),
        ("DELETE FROM record WHERE id <= 4", 1),
        ("DELETE FROM record WHERE id > 7", 8),
        ("DELETE FROM record", 1),
        (
            "INSERT INTO record SELECT 11, time, kind, who, robot, fields, arrays, previous, hash FROM record WHERE id = 10",
            11,
        ),
    ],
)
def test_the_first_row_that_is_wrong_is_found(folder: Path, statement: str, at: int) -> None:
    change(folder, statement)
    verdict = verify_folder(folder)
    assert not verdict.ok
    assert verdict.broken_at == at
    assert verdict.rows == at - 1


def test_swapped_rows_are_found(folder: Path) -> None:
    change(
        folder,
        "UPDATE record SET id = 99 WHERE id = 4",
        "UPDATE record SET id = 4 WHERE id = 5",
        "UPDATE record SET id = 5 WHERE id = 99",
    )
    assert verify_folder(folder).broken_at == 4


def rewrite(folder: Path, rows: int) -> None:
    """What somebody can do who can write the database and knows how the chain is made."""
    with contextlib.closing(sqlite3.connect(folder / "record.sqlite")) as database, database:
        last = START
        database.execute("DELETE FROM record WHERE id > ?", [rows])
        for id, time, kind, who, robot, fields in database.execute(
            "SELECT id, time, kind, who, robot, fields FROM record ORDER BY id"
        ).fetchall():
            who = "eve" if id == 4 else who
            hash = digest(last, id, time, kind, who, robot, fields, None)
            database.execute("UPDATE record SET who = ?, previous = ?, hash = ? WHERE id = ?", [who, last, hash, id])
            last = hash


def test_a_chain_that_was_made_anew_does_not_fit_the_head(folder: Path) -> None:
    rewrite(folder, 10)
    verdict = verify_folder(folder)
    assert verdict.broken_at == 10
    assert "rewritten" in verdict.why


def test_the_head_cannot_be_written_without_its_key(folder: Path) -> None:
    rewrite(folder, 6)
    head = (folder / "record.head").read_text()
    (folder / "record.head").write_text(head.replace('"rows": 10', '"rows": 6'))
    verdict = verify_folder(folder)
    assert not verdict.ok
    assert "altered" in verdict.why


@pytest.mark.parametrize("name", ["record.head", "record.key"])
def test_a_missing_head_or_key_is_told(folder: Path, name: str) -> None:
    (folder / name).unlink()
    assert not verify_folder(folder).ok


def test_an_older_copy_of_the_folder_is_found_by_a_noted_hash_only(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    old = tmp_path_factory.mktemp("copies") / "old"
    shutil.copytree(folder, old)
    with contextlib.closing(Audit(folder)) as audit:
        audit.write("estop", "eve")
    noted = bytes.fromhex(verify_folder(folder).head)
    assert verify_folder(folder, noted).ok
    assert verify_folder(old).ok
    assert not verify_folder(old, noted).ok


def test_a_hash_that_was_noted_before_the_first_row_is_in_every_record(folder: Path) -> None:
    assert verify_folder(folder, bytes(32)).ok


def test_a_record_that_was_cut_off_is_not_continued(folder: Path) -> None:
    change(folder, "DELETE FROM record WHERE id > 7")
    with pytest.raises(RecordError, match="cut off or rewritten"):
        Audit(folder)


def test_a_record_that_is_cut_off_while_it_is_written_is_not_continued(audit: Audit, tmp_path: Path) -> None:
    for i in range(5):
        audit.write("command", seq=i)
    audit.flush()
    change(tmp_path, "DELETE FROM record WHERE id > 2")
    audit.write("command", seq=5)
    with pytest.raises(RecordError, match="cut off"):
        audit.flush()


rows = st.builds(
    lambda kind, who, robot, fields, arrays: (kind, who, robot, fields, arrays),
    st.text(max_size=4), st.text(max_size=4), st.none() | st.integers(0, 9), st.text(max_size=6), st.none() | st.binary(max_size=6),
)  # fmt: skip


@given(st.lists(rows, min_size=1, max_size=6), st.data())
def test_any_change_of_one_row_breaks_the_chain(
    contents: list[tuple[str, str, int | None, str, bytes | None]], data: st.DataObject
) -> None:
    chain, last = [], START
    for id, (kind, who, robot, fields, arrays) in enumerate(contents, 1):
        hash = digest(last, id, 1.0 * id, kind, who, robot, fields, arrays)
        chain.append(Row(id, 1.0 * id, kind, who, robot, fields, arrays, last, hash))
        last = hash
    assert verify(chain, None).ok
    at = data.draw(st.integers(0, len(chain) - 1))
    other = data.draw(rows)
    row = chain[at]
    changed = Row(row.id, row.time, *other, row.previous, row.hash)
    same = (other[0], other[1], other[2], other[3], other[4] or b"") == (
        row.kind,
        row.who,
        row.robot,
        row.fields,
        row.arrays or b"",
    )
    verdict = verify([*chain[:at], changed, *chain[at + 1 :]], None)
    assert verdict.ok == same
    assert same or verdict.broken_at == at + 1


# -- faults -----------------------------------------------------------------------------------------------------


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from tutelage.console.audit import Audit, RecordError

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
audit = Audit(Path(sys.argv[1]))
acknowledged = 0
resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, resource.RLIM_INFINITY))
try:
    for i in range(1000):
        audit.sample("ana", 0, {"obs": np.zeros(2500)}, t=i)
        audit.flush()
        acknowledged += 1
except RecordError as error:
    print("refused:", error)
for attempt in range(3):
    try:
        audit.write("command", "ana", 0)
        print("written")
    except RecordError:
        print("still refused", audit.error is not None)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
while audit.error:
    pass
audit.write("notice", "server", text="room again")
audit.close()
print("acknowledged:", acknowledged)
"""


def test_a_full_disk_is_an_error_until_there_is_room_and_loses_nothing(tmp_path: Path) -> None:
    said = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path)], capture_output=True, text=True, check=True, timeout=120
    ).stdout.splitlines()
    assert said[0].startswith("refused: the record in ")
    assert said[1:4] == ["still refused True"] * 3
    acknowledged = int(said[-1].removeprefix("acknowledged: "))
    assert 0 < acknowledged < 1000
    verdict = verify_folder(tmp_path)
    assert verdict.ok
    # The one that was refused an acknowledgement waited, and is there too.
    assert [sample.fields["t"] for sample in samples_in(tmp_path)] == list(range(acknowledged + 1))


KILLED = """
import sys
from pathlib import Path
from tutelage.console.audit import Audit

audit = Audit(Path(sys.argv[1]))
i = 0
while True:
    audit.write("command", "ana", 0, seq=i)
    if i % 7 == 0:
        audit.flush()
        print(i, flush=True)
    i += 1
"""


def test_nothing_acknowledged_is_lost_when_the_server_is_killed(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        for _ in range(40):
            acknowledged = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read().split()
    acknowledged = int(rest[-2]) if len(rest) > 1 else acknowledged  # the last line may be half a number
    verdict = verify_folder(tmp_path)
    assert verdict.ok
    assert verdict.rows > acknowledged
    with contextlib.closing(Audit(tmp_path)) as audit:  # and it goes on
        audit.write("server", "server")
        audit.flush()
        assert audit.verify().ok


def test_a_folder_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TutelageError, match="cannot write the record"):
        Audit(tmp_path / "file" / "below")


def test_a_database_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "record.sqlite").write_bytes(b"not a database at all, but long enough to be read" * 100)
    with pytest.raises(TutelageError, match="cannot write the record"):
        Audit(tmp_path)


def test_a_record_of_a_later_version_is_refused(folder: Path) -> None:
    change(folder, "PRAGMA user_version = 99")
    with pytest.raises(RecordError, match="version 99"):
        Audit(folder)


def test_the_files_are_for_their_owner_only(folder: Path) -> None:
    for name in ("record.sqlite", "record.key", "record.head"):
        assert (folder / name).stat().st_mode & 0o077 == 0
