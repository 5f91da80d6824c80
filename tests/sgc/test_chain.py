"""Chains: messages that are confirmed a little later, by one signature for many."""

from __future__ import annotations

import time

import pytest
from members import Fleet

from tutelage.sgc import chain as chain_module
from tutelage.sgc.chain import EVERY
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.sealing import Opened, Opener, Sealer


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> Fleet:
    return Fleet(tmp_path_factory.mktemp("fleet"))


def reason(call, *arguments, **named) -> Reason:
    with pytest.raises(Refused) as raised:
        call(*arguments, **named)
    return raised.value.reason


def sealed(sealer: Sealer, count: int, now: int) -> list[bytes]:
    """Messages a microsecond apart, so that only their number makes an anchor due."""
    return [bytes(sealer.seal(b"%d" % k, now=now + 1000 * k)) for k in range(count)]


def opened(opener: Opener, packets: list[bytes]) -> list[Opened]:
    return [message for packet in packets for message in opener.open_many(packet)]


def test_messages_wait_for_their_anchor_and_come_in_order(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    packets = sealed(sealer, EVERY, time.time_ns())
    assert opened(opener, packets[:-1]) == []
    messages = opened(opener, packets[-1:])
    assert [message.payload for message in messages] == [b"%d" % k for k in range(EVERY)]
    assert all(message.authentic for message in messages)
    assert opener.refusals.total() == 0


def test_an_anchor_is_due_after_some_time_too(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    now = time.time_ns()
    packets = [sealer.seal(b"x", now=now + k * 9_000_000) for k in range(4)]
    assert [len(opener.open_many(packet)) for packet in packets] == [0, 0, 0, 4]


def test_a_sender_that_falls_silent_confirms_by_a_packet_of_its_own(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    assert sealer.flush() is None
    assert opened(opener, sealed(sealer, 3, time.time_ns())) == []
    anchor = sealer.flush()
    assert anchor is not None
    assert [message.sequence for message in opener.open_many(anchor)] == [1, 2, 3]
    assert sealer.flush() is None
    assert opener.open_many(anchor) == []  # a repetition confirms nothing new
    assert sealer.sequence == 3  # it takes no number, so it leaves no gap


def test_lost_messages_do_not_hurt_the_others(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    packets = sealed(sealer, EVERY, time.time_ns())
    messages = opened(opener, [packet for k, packet in enumerate(packets) if k % 3 or k == EVERY - 1])
    assert [message.sequence for message in messages] == [k + 1 for k in range(EVERY) if k % 3 or k == EVERY - 1]


def test_one_lost_anchor_does_no_harm(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    packets = sealed(sealer, 2 * EVERY, time.time_ns())
    del packets[EVERY - 1]
    assert [message.sequence for message in opened(opener, packets)] == [k for k in range(1, 2 * EVERY + 1) if k != EVERY]


def test_a_message_that_comes_after_its_anchor_is_confirmed_at_once(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    packets = sealed(sealer, EVERY, time.time_ns())
    late = packets.pop(10)
    assert len(opened(opener, packets)) == EVERY - 1
    assert [message.sequence for message in opener.open_many(late)] == [11]
    assert reason(opener.open_many, late) == Reason.REPLAYED


def test_confirmed_messages_are_given_once(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    packets = sealed(sealer, EVERY, time.time_ns())
    opened(opener, packets[:-1])
    for packet in packets[:-1]:
        assert reason(opener.open_many, packet) == Reason.REPLAYED
    assert len(opener.open_many(packets[-1])) == EVERY
    for packet in packets:
        assert reason(opener.open_many, packet) == Reason.REPLAYED


def forgery(fleet: Fleet, genuine: Sealer, payload: bytes, sequence: int, now: int) -> bytes:
    """What server, a subscriber, can make with the topic's key: a packet under drone-1's id and salt. It lacks the signature."""
    forger = fleet.sealer("drone-1", "lidar")
    forger.salt, forger.sequence = genuine.salt, sequence - 1
    forger.seal(b"", now=now)
    forger.sequence = sequence - 1
    return bytes(forger.seal(payload, now=now))


def test_a_member_cannot_slip_in_a_message_of_another(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    now = time.time_ns()
    packets = sealed(sealer, EVERY, now)
    forged = forgery(fleet, sealer, b"forged", 5, now)
    messages = opened(opener, [forged, *packets])
    assert [message.payload for message in messages] == [b"%d" % k for k in range(EVERY)]
    assert opener.refusals.as_dict() == {"forged": 1}
    assert reason(opener.open_many, forged) in (Reason.FORGED, Reason.REPLAYED)


def test_a_forged_anchor_confirms_nothing(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    now = time.time_ns()
    opened(opener, sealed(sealer, 3, now))
    forger = fleet.sealer("drone-1", "lidar")
    forger.salt, forger.sequence = sealer.salt, 3
    forger.seal(b"x", now=now)
    forger._home = fleet.homes["server"]  # it signs with its own key
    forger._looked = now
    assert reason(opener.open_many, forger.flush(now=now)) == Reason.FORGED
    assert len(opener.open_many(sealer.flush())) == 3


def test_messages_that_nobody_confirms_are_dropped_and_counted(fleet: Fleet, monkeypatch) -> None:
    monkeypatch.setattr(chain_module, "MAX_HELD", 10)
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    packets = sealed(sealer, EVERY, time.time_ns())
    assert len(opened(opener, packets)) == 10
    assert opener.refusals.as_dict() == {"unconfirmed": EVERY - 10}


def test_held_messages_take_a_bounded_amount_of_memory(fleet: Fleet, monkeypatch) -> None:
    monkeypatch.setattr(chain_module, "MAX_HELD_BYTES", 5000)
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    now = time.time_ns()
    for k in range(20):
        opener.open_many(sealer.seal(bytes(1000), now=now + k))
    assert opener._confirmation._held_bytes == 5000
    assert len(opener.open_many(sealer.flush())) == 5
    assert opener._confirmation._held_bytes == 0


def test_provisional_messages_come_at_once_and_are_marked(fleet: Fleet) -> None:
    sealer, opener = fleet.sealer("drone-1", "lidar"), fleet.opener("server", "lidar", provisional=True)
    packets = sealed(sealer, EVERY, time.time_ns())
    messages = [opener.open(packet) for packet in packets]
    assert [message.sequence for message in messages] == list(range(1, EVERY + 1))
    assert not any(message.authentic for message in messages)
    assert opener.refusals.total() == 0


def test_provisional_messages_stop_when_they_are_not_confirmed(fleet: Fleet) -> None:
    sealer, opener = fleet.sealer("drone-1", "lidar"), fleet.opener("server", "lidar", provisional=True)
    now = time.time_ns()
    opener.open(sealer.seal(b"x", now=now), now=now)
    later = now + 1_100_000_000
    forged = forgery(fleet, sealer, b"forged", 20, later)
    assert reason(opener.open, forged, now=later) == Reason.UNCONFIRMED
    opener.open_many(sealer.flush(now=later), now=later)
    assert opener.open(sealer.seal(b"y", now=later), now=later).payload == b"y"


def test_a_forgery_that_was_given_provisionally_is_counted(fleet: Fleet) -> None:
    sealer, opener = fleet.sealer("drone-1", "lidar"), fleet.opener("server", "lidar", provisional=True)
    now = time.time_ns()
    opener.open(forgery(fleet, sealer, b"forged", 1, now))
    with pytest.raises(Refused):
        opener.open(sealer.seal(b"genuine", now=now))
    opener.open_many(sealer.flush())
    assert opener.refusals[Reason.FORGED] == 1


def test_batches_are_confirmed_too(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("lidar", "drone-1", "server")
    assert opener.open_many(sealer.seal_many([b"a", b"b", b"c"])) == []
    assert opener.open_many(sealer.seal_many([b"d", b"e"])) == []
    assert [message.payload for message in opener.open_many(sealer.flush())] == [b"a", b"b", b"c", b"d", b"e"]
