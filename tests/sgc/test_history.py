"""What a publisher keeps, and how it is asked for."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tutelage.sgc.history import History, make_request, parse_answer, parse_request
from tutelage.sgc.reasons import Reason, Refused


def filled(**limits: float) -> History:
    """Packets 1-2, 3-4, ... 19-20, sent a second apart."""
    history = History(**limits)  # type: ignore[arg-type]
    for k in range(10):
        history.add(2 * k + 1, 2 * k + 2, b"packet %d" % k, float(k))
    return history


def asked(history: History, *ranges: tuple[int, int]) -> tuple[int, list[bytes]]:
    floor, packets = parse_answer(history.answer(make_request(ranges)))
    return floor, [bytes(packet) for packet in packets]


def test_packets_with_messages_in_the_ranges_come_back_in_order_and_once() -> None:
    assert asked(filled(), (2, 3), (4, 4), (19, 30)) == (1, [b"packet 0", b"packet 1", b"packet 9"])


def test_the_oldest_packets_make_room() -> None:
    assert asked(filled(packets=3), (1, 16)) == (15, [b"packet 7"])
    assert asked(filled(size=20), (1, 20)) == (17, [b"packet 8", b"packet 9"])
    assert asked(filled(max_age=1.5), (1, 20)) == (17, [b"packet 8", b"packet 9"])


def test_an_answer_is_bounded_but_never_empty_handed() -> None:
    floor, packets = filled().find([(1, 20)], size=5)
    assert (floor, packets) == (1, [b"packet 0"])


def test_nothing_sent_nothing_found() -> None:
    assert asked(History(), (1, 5)) == (0, [])


@pytest.mark.parametrize("request_", [b"", b"x", bytes(16 * 65), make_request([(5, 4)]), make_request([(5, 9), (1, 2)])])
def test_requests_that_make_no_sense_are_refused(request_: bytes) -> None:
    with pytest.raises(Refused) as refused:
        parse_request(request_)
    assert refused.value.reason == Reason.MALFORMED


@given(st.binary(max_size=64))
def test_any_bytes_are_an_answer_or_refused(data: bytes) -> None:
    try:
        floor, packets = parse_answer(data)
    except Refused as refused:
        assert refused.reason == Reason.MALFORMED
    else:
        assert sum(len(packet) + 4 for packet in packets) + 8 == len(data)
        assert floor >= 0


def test_an_answer_that_is_cut_short_ends_with_what_confirms_it() -> None:
    history = History()
    for number in range(1, 21):
        history.add(number, number, bytes([number]) * 100, 0.0, confirms=number % 8 == 0)
    everything = [(1, 20)]
    assert [packet[0] for packet in history.find(everything, 300)[1]] == [1, 2, 3, 8]
    assert [packet[0] for packet in history.find([(4, 7), (9, 20)], 300)[1]] == [4, 5, 6, 16]  # 8 came, so it is known
    assert [packet[0] for packet in history.find([(6, 20)], 300)[1]] == [6, 7, 8]
    assert [packet[0] for packet in history.find([(17, 20)], 300)[1]] == [17, 18, 19]  # its anchor is still to come
