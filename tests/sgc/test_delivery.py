"""Whatever a network does to the packets, messages come in order, once, and what is missing is counted."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tutelage.sgc import delivery, frames
from tutelage.sgc.assembler import Assembler
from tutelage.sgc.delivery import InOrder, Newest
from tutelage.sgc.reasons import Refusals
from tutelage.sgc.sealing import Opened

SALT, OTHER = b"s" * 16, b"o" * 16


def message(sequence: int, salt: bytes = SALT, age: float = 0.0, sender: str = "arm", size: int = 1) -> Opened:
    return Opened(b"x" * size, sender, sequence, salt, 0, 1, True, b"", frames.label(frames.Kind.WHOLE, age))


def numbers(messages: list[Opened]) -> list[int]:
    return [each.sequence for each in messages]


def test_what_comes_in_order_is_delivered_at_once() -> None:
    order = InOrder(0.0)
    assert [numbers(order.accept(message(k), 0.0)) for k in (1, 2, 3)] == [[1], [2], [3]]
    assert order.wake() is None


def test_a_gap_is_asked_for_and_closed_by_the_answer() -> None:
    order = InOrder(0.0)
    order.accept(message(1), 0.0)
    assert order.accept(message(4), 1.0) == []
    assert order.questions(1.0) == []  # it may only have been overtaken
    assert order.questions(1.1) == [(SALT, [(2, 3)])]
    assert order.questions(1.2) == []  # one question at a time
    assert numbers(order.accept(message(2), 1.3)) == [2]
    assert numbers(order.accept(message(3), 1.3)) == [3, 4]
    assert order.answered(SALT, 1, 1.3) == []
    assert order.wake() is None
    assert (order.tally.gaps, order.tally.lost) == (1, 0)


def test_what_the_publisher_no_longer_has_is_lost_and_delivery_goes_on() -> None:
    order = InOrder(0.0)
    order.accept(message(1), 0.0)
    order.accept(message(5), 0.0)
    order.accept(message(7), 0.0)
    order.questions(1.0)
    assert numbers(order.answered(SALT, 6, 1.0)) == [5]
    assert order.tally.lost == 3
    assert numbers(order.accept(message(6), 1.0)) == [6, 7]


def test_a_publisher_that_is_gone_delays_delivery_by_its_patience_once() -> None:
    order = InOrder(0.0)
    order.accept(message(1), 0.0)
    order.accept(message(3), 0.0)
    order.accept(message(5), 0.0)
    assert order.due(delivery.PATIENCE - 0.1) == []
    assert numbers(order.due(delivery.PATIENCE)) == [3, 5]
    assert order.tally.lost == 2
    order.accept(message(7), 10.0)
    assert numbers(order.due(10.0 + delivery.IMPATIENCE)) == [7]


def test_questions_that_do_not_help_become_rarer() -> None:
    order = InOrder(0.0, patience=100.0)
    order.accept(message(1), 0.0)
    order.accept(message(3), 0.0)
    asked, now = [], 0.0
    while now < 4.0:
        for salt, _ in order.questions(now):
            asked.append(now)
            order.answered(salt, 0, now)
        now += 0.01
    assert 4 <= len(asked) <= 7


def test_a_subscriber_that_comes_late_begins_with_what_it_hears_first() -> None:
    order = InOrder(started=100.0)
    assert numbers(order.accept(message(50, age=60.0), 101.0)) == [50]


def test_a_stream_that_began_after_the_subscription_is_wanted_from_its_beginning() -> None:
    order = InOrder(started=100.0)
    assert order.accept(message(3, age=4.0), 110.0) == []
    assert order.questions(111.0) == [(SALT, [(1, 2)])]


def test_a_restarted_sender_ends_its_earlier_stream() -> None:
    order = InOrder(0.0)
    order.accept(message(1), 0.0)
    order.accept(message(3), 0.0)
    fresh = order.accept(message(1, OTHER), 1.0)
    assert [(each.salt, each.sequence) for each in fresh] == [(SALT, 3), (OTHER, 1)]
    assert order.accept(message(4), 1.0) == []  # nothing of the earlier start comes after the new one
    assert (order.tally.lost, order.tally.late) == (1, 1)


def test_what_waits_behind_a_gap_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delivery, "HELD_MESSAGES", 10)
    order = InOrder(0.0)
    order.accept(message(1), 0.0)
    delivered = [number for k in range(3, 30) for number in numbers(order.accept(message(k), 0.0))]
    assert delivered == list(range(3, 30))
    assert order.tally.lost == 1


def test_the_newest_wins_on_a_lossy_topic() -> None:
    newest = Newest(0.0)
    assert numbers(newest.accept(message(1), 0.0)) == [1]
    assert numbers(newest.accept(message(4), 0.0)) == [4]
    assert newest.accept(message(3), 0.0) == []
    assert (newest.tally.lost, newest.tally.late) == (2, 1)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_any_network_delivers_in_order_once_and_accounts_for_the_rest(data: st.DataObject) -> None:
    sent = data.draw(st.integers(1, 30), "sent")
    arrivals = data.draw(st.lists(st.integers(1, sent), max_size=60), "arrivals")
    order, now, out = InOrder(0.0), 0.0, []
    for sequence in arrivals:
        now += data.draw(st.sampled_from([0.0, 0.01, 0.3, 1.0]), "pause")
        out += order.accept(message(sequence), now)
        out += order.due(now)
        for salt, ranges in order.questions(now):
            missing = [k for first, last in ranges for k in range(first, last + 1)]
            assert all(k not in numbers(out) for k in missing)
            kept = data.draw(st.lists(st.sampled_from(missing), unique=True), "kept")
            for k in kept:
                out += order.accept(message(k), now)
            out += order.answered(salt, data.draw(st.integers(0, sent + 2), "floor"), now)
    for _ in range(2):
        now += 2 * delivery.PATIENCE
        out += order.due(now)
    got = numbers(out)
    assert got == sorted(set(got))
    assert set(arrivals) <= set(got) | set(range(1, max(got, default=0)))
    assert order.tally.lost == (max(got) if got else 0) - len(got)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 30), st.integers(1, 6), st.sampled_from([SALT, SALT, OTHER])), max_size=30))
def test_the_messages_of_a_packet_together_are_what_they_are_one_by_one(packets: list[tuple[int, int, bytes]]) -> None:
    together, single = InOrder(0.0), InOrder(0.0)
    for now, (first, count, salt) in enumerate(packets):
        messages = [message(sequence, salt) for sequence in range(first, first + count)]
        one_by_one = [ready for each in messages for ready in single.accept(each, now)]
        assert together.accept_all(messages, now) == one_by_one
        assert (together.tally, together.wake()) == (single.tally, single.wake())


def test_a_packet_with_a_hole_is_no_run() -> None:
    """Of a chain, what an anchor confirms may lack a message in the middle."""
    order = InOrder(0.0)
    assert numbers(order.accept_all([message(k) for k in (1, 2, 4)], 0.0)) == [1, 2]
    assert order.wake() is not None
    assert numbers(order.accept_all([message(3)], 0.0)) == [3, 4]
    assert order.wake() is None


def test_a_sender_that_starts_again_leaves_no_gap_behind() -> None:
    order = InOrder(0.0)
    order.accept(message(1), 0.0)
    order.accept(message(3), 0.0)
    assert order.wake() is not None
    assert numbers(order.accept(message(1, OTHER), 1.0)) == [3, 1]
    assert order.wake() is None
    assert not order.crowded


# -- frames -------------------------------------------------------------------------------------------------------------


@given(size=st.integers(0, 3 * 512 * 1024 + 1), start=st.integers(1, 1000))
@settings(max_examples=20, deadline=None)
def test_large_messages_come_back_from_their_pieces(size: int, start: int) -> None:
    payload = bytes(range(256)) * (size // 256 + 1)
    payload = payload[:size]
    assembly = frames.Assembly()
    whole = frames.label(frames.Kind.WHOLE, 1.5), payload
    parts = list(frames.pieces(memoryview(payload), 1.5)) if size > frames.PIECE else [whole]
    out = [assembly.take(start + k, label, bytes(part)) for k, (label, part) in enumerate(parts)]
    assert out[:-1] == [None] * (len(parts) - 1)
    assert out[-1] == payload
    assert all(frames.age_of(label) == 1.5 for label, _ in parts)


def test_a_message_that_lacks_a_piece_is_dropped() -> None:
    parts = list(frames.pieces(memoryview(bytes(3 * frames.PIECE)), 0.0))
    assembly = frames.Assembly()
    assert [assembly.take(k, parts[k][0], bytes(parts[k][1])) for k in (0, 2)] == [None, None]
    assert not assembly.unfinished
    assert assembly.take(3, frames.label(frames.Kind.WHOLE, 0.0), b"next") == b"next"


def test_what_an_earlier_start_left_unfinished_is_forgotten() -> None:
    """Else it would be kept for good, where the present one sends whole messages only."""
    present = {SALT}
    assembler = Assembler("log", Refusals(), lambda: present)
    pieces = [
        message(k + 1)._replace(payload=bytes(part), label=label)
        for k, (label, part) in enumerate(frames.pieces(memoryview(bytes(3 * frames.PIECE)), 0.0))
    ]
    assert assembler.messages(pieces[:2], 0.0) == []
    assert set(assembler.unfinished) == {SALT}
    present = {OTHER}
    assert [each.payload for each in assembler.messages([message(1, OTHER)], 0.0)] == [b"x"]
    assert not assembler.unfinished
    assert [len(each.payload) for each in assembler.messages(pieces, 0.0)] == [3 * frames.PIECE]  # released all at once
    assert not assembler.unfinished


@given(st.binary(min_size=16, max_size=16), st.binary(max_size=40))
@settings(max_examples=500)
def test_any_bytes_are_a_frame_or_refused(label: bytes, body: bytes) -> None:
    from tutelage.sgc.reasons import Reason, Refused

    try:
        frames.parse(label, body)
    except Refused as refused:
        assert refused.reason == Reason.MALFORMED


@pytest.mark.parametrize("kind", [InOrder, Newest])
def test_two_programs_of_one_sender_are_noticed_and_a_restart_is_not(kind) -> None:
    order, second = kind(0.0), 1_000_000_000
    order.accept(message(1)._replace(sent=second), 0.0)
    order.accept(message(1, OTHER)._replace(sent=10 * second), 1.0)
    order.accept(message(2)._replace(sent=9 * second), 1.0)  # of the earlier start, overtaken
    assert order.twice == set()
    order.accept(message(3)._replace(sent=16 * second), 7.0)
    assert order.twice == {"arm"}
