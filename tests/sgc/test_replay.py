"""Replay: every message once, in time, whatever the order; memory is bounded, and what is forgotten stays refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tutelage.sgc import replay as replay_module
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.replay import MAX_SALTS, TOLERANCE_NS, WINDOW, Replay, Window

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
A, B = b"a" * 16, b"b" * 16
SALT = b"s" * 16


def take(
    replay: Replay, first: int, count: int = 1, *, sender: bytes = A, salt: bytes = SALT, sent: int = START
) -> Reason | None:
    try:
        replay.admit(sender, salt, first, count, sent, START)
    except Refused as refused:
        return refused.reason
    return None


numbers_near_each_other = st.builds(
    lambda base, offset: base + offset, st.sampled_from([1, 1000, WINDOW - 5, WINDOW, 2 * WINDOW]), st.integers(0, 40)
)


@given(st.lists(st.tuples(numbers_near_each_other, st.sampled_from([1, 1, 1, 2, 70, 3000])), max_size=60))
def test_the_window_agrees_with_a_set(batches: list[tuple[int, int]]) -> None:
    window, seen = Window(), set[int]()
    for first, count in batches:
        numbers = set(range(first, first + count))
        highest = max(seen, default=0)
        expected = not (numbers & seen) and (first > highest or highest - first < WINDOW)
        assert window.fresh(first, count) == expected
        if expected:
            window.add(first, count, 0)
            seen |= numbers


def test_numbers_in_a_row_take_no_bits_until_the_row_ends() -> None:
    window = Window()
    for k in range(1, 3 * WINDOW, 500):
        assert window.fresh(k, 500)
        window.add(k, 500, 0)
    assert not window._blocks
    assert not window.fresh(window.highest, 1)
    assert not window.fresh(window.highest - WINDOW + 1, 1)
    window.add(window.highest + 2, 1, 0)
    seen = window.highest - 2
    assert window.fresh(window.highest - 1, 1)
    assert not any(window.fresh(k, 1) for k in (seen, seen - 1024, window.highest - WINDOW + 1, window.highest))


def test_messages_come_once_in_any_order_within_the_window() -> None:
    replay = Replay(None, START)
    assert [take(replay, k) for k in (3, 1, 2, WINDOW + 1)] == [None] * 4
    assert [take(replay, k) for k in (3, 1, 2, WINDOW + 1)] == [Reason.REPLAYED] * 4
    assert take(replay, WINDOW) is None
    assert take(replay, 2 * WINDOW + 1) is None
    assert take(replay, WINDOW + 1) == Reason.REPLAYED  # behind the window, though it might be new
    assert take(replay, WINDOW + 2) is None


def test_asking_remembers_nothing() -> None:
    replay = Replay(None, START)
    for _ in range(3):
        replay.check(A, SALT, 1, START, START)
    assert take(replay, 1) is None


def test_streams_do_not_disturb_each_other() -> None:
    replay = Replay(None, START)
    assert take(replay, 1) is None
    assert take(replay, 1, sender=B) is None
    assert take(replay, 1, salt=b"t" * 16) is None


def test_a_message_beyond_the_maximum_age_is_refused() -> None:
    replay = Replay(0.5, START)
    assert take(replay, 1, sent=START - SECOND // 2) is None
    assert take(replay, 2, sent=START - SECOND // 2 - 1) == Reason.TOO_OLD


def test_a_message_from_the_future_is_refused() -> None:
    replay = Replay(None, START)
    assert take(replay, 1, sent=START + TOLERANCE_NS) is None
    assert take(replay, 2, sent=START + TOLERANCE_NS + 1) == Reason.FUTURE


def test_what_was_sent_before_the_receiver_started_is_refused() -> None:
    replay = Replay(None, START)
    assert take(replay, 1, sent=START - TOLERANCE_NS) == Reason.STALE
    assert take(replay, 2, sent=START - TOLERANCE_NS + 1) is None


def test_a_stream_that_was_forgotten_stays_refused() -> None:
    replay = Replay(None, START)
    for k in range(MAX_SALTS + 1):
        assert take(replay, 1, salt=bytes([k]) * 16, sent=START + k) is None
    assert take(replay, 1, salt=bytes(16), sent=START) == Reason.STALE
    assert take(replay, 1, salt=b"x" * 16, sent=START + SECOND) is None


def test_a_sender_that_was_forgotten_stays_refused(monkeypatch) -> None:
    monkeypatch.setattr(replay_module, "MAX_SENDERS", 3)
    replay = Replay(None, START)
    senders = [bytes([k]) * 16 for k in range(4)]
    for k, sender in enumerate(senders):
        assert take(replay, 1, sender=sender, sent=START + k) is None
    assert len(replay._senders) == 3
    assert take(replay, 1, sender=senders[0], sent=START) == Reason.STALE
    assert take(replay, 2, sender=senders[0], sent=START + SECOND) is None


@given(st.lists(st.tuples(st.integers(0, 20), st.integers(0, 20), st.integers(1, 50)), max_size=200))
def test_no_message_is_ever_taken_twice_however_many_streams_there_are(messages: list[tuple[int, int, int]]) -> None:
    """With room for few streams, and times of sending that grow as the messages come for the first time."""
    replay, taken = Replay(None, START), set[tuple[int, int, int]]()
    sent: dict[tuple[int, int, int], int] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay_module, "MAX_SENDERS", 4)
        patch.setattr(replay_module, "MAX_SALTS", 2)
        for message in messages:
            when = sent.setdefault(message, START + len(sent))
            sender, salt, first = message
            if take(replay, first, sender=bytes([sender]) * 16, salt=bytes([salt]) * 16, sent=when) is None:
                assert message not in taken
                taken.add(message)
        assert len(replay._senders) <= 4


def test_a_window_takes_as_much_memory_as_it_needs() -> None:
    window = Window()
    for k in range(1, 10 * WINDOW, 1 << 16):
        window.add(k, 1, 0)
    assert len(window._blocks) <= 4
    window = Window()
    for k in range(1, 4 * WINDOW, 1000):
        window.add(k, 1000, 0)
    assert len(window._blocks) <= WINDOW // 1024 + 2
