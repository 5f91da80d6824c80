"""The emergency stop of a robot is latched until the server clears it, whatever is restarted meanwhile."""

from __future__ import annotations

from pathlib import Path

from tutelage.remote.latch import Latch
from tutelage.remote.messages import Stop, StopOperation
from tutelage.remote.wire import pack_stop


def message(number: int, operation: StopOperation = StopOperation.STOP, server: int = 5) -> bytes:
    return pack_stop(Stop(server, number, operation))


def latch(folder: Path | None, said: list[str]) -> Latch:
    return Latch(folder, lambda first: said.append("stop" if first else "again"), lambda: said.append("clear"))


def test_it_stops_at_once_and_stays_stopped_until_it_is_cleared(tmp_path: Path) -> None:
    said: list[str] = []
    made = latch(tmp_path, said)
    assert not made.stopped
    made.take(message(1))
    made.take(message(2))
    assert made.stopped
    assert latch(tmp_path, []).stopped  # switched off and on
    made.take(message(3, StopOperation.CLEAR))
    assert not made.stopped
    assert not latch(tmp_path, []).stopped
    assert said == ["stop", "again", "clear"]


def test_it_holds_where_it_cannot_be_written_down(tmp_path: Path) -> None:
    said: list[str] = []
    made = latch(tmp_path / "file" / "folder", said)
    (tmp_path / "file").write_text("in the way")
    made.take(message(1))
    assert made.stopped
    made.take(message(2, StopOperation.CLEAR))
    assert not made.stopped
    assert said == ["stop", "clear"]


def test_a_late_clear_does_not_undo_a_newer_stop(tmp_path: Path) -> None:
    made = latch(tmp_path, [])
    made.take(message(2))
    made.take(message(1, StopOperation.CLEAR))
    made.take(message(2, StopOperation.CLEAR))
    assert made.stopped
    assert made.counts["replaced"] == 2


def test_damaged_messages_are_counted_and_do_nothing(tmp_path: Path) -> None:
    made = latch(tmp_path, [])
    for bad in (b"", b"stop", message(1)[:-1], message(1) + b"x"):
        made.take(bad)
    assert not made.stopped
    assert made.counts["malformed"] == 4


def test_a_button_on_the_robot_wins_against_a_clear_that_comes_with_it() -> None:
    made = Latch(None, lambda first: None, lambda: made.stop())
    made.stop()
    made.take(message(1, StopOperation.CLEAR))
    assert made.stopped
