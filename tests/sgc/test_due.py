"""What is opened in one step is what would be opened the long way, and nothing else."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from members import Fleet

from tutelage.sgc.due import Due
from tutelage.sgc.packet import NO_LABEL
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.sealing import Opener, Sealer

NODES = ["operator-1", "server", "drone-1", "operator-2"]
PIECE = b"\1" + bytes(15)
MILLISECOND = 1_000_000


class Eager:
    """A receiver that tries what is due first, as a subscription does."""

    def __init__(self, opener: Opener) -> None:
        self.opener, self.at_once = opener, 0
        self.due: Due | None = None
        self.next = 0

    def take(self, packet: bytes, now: int) -> list[tuple[bytes, int, int]] | Reason:
        """Payloads with their numbers and times, or why not."""
        opened = self.due.open(packet, self.next, now) if self.due is not None else None
        if opened is not None:
            self.at_once += 1
            self.next += 1
            return [(opened[0], self.next - 1, opened[1])]
        self.due = None
        outcome = take(self.opener, packet, now)
        if isinstance(outcome, list):
            self.due, self.next = self.opener.due(), outcome[-1][1] + 1
        return outcome


def take(opener: Opener, packet: bytes, now: int) -> list[tuple[bytes, int, int]] | Reason:
    """The long way."""
    try:
        return [(each.payload, each.sequence, each.sent) for each in opener.open_many(packet, now=now)]
    except Refused as refused:
        return refused.reason


def seen(opener: Opener) -> dict[tuple[bytes, bytes], tuple[int, int]]:
    """The highest number and the newest time of each start of each sender."""
    senders = opener._replay._senders
    return {(by, salt): (w.highest, w.sent) for by, of in senders.items() for salt, w in of.windows.items()}


def meet(sealer: Sealer, *openers: Opener) -> None:
    """One session, which all of these openers of one node have: each is to open the same packets."""
    first = openers[0]
    first.complete_session(sealer.accept_session(first.offer_session()))
    for opener in openers[1:]:
        opener._sessions = first._sessions


def sending(fleet: Fleet, name: str = "operator-1") -> tuple[Sealer, Eager, Opener]:
    """A sender, and two receivers with the same session that do not know of each other."""
    sealer = fleet.sealer(name, "teleop")
    eager, plain = (fleet.opener("server", "teleop") for _ in range(2))
    meet(sealer, eager, plain)
    return sealer, Eager(eager), plain


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    return Fleet(tmp_path_factory.mktemp("due"), NODES)


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return Fleet(tmp_path, NODES)


EVENTS = (
    "send", "send", "send", "send", "large", "batch", "piece", "lose", "repeat", "overtake", "flip", "cut", "grow", "splice",
    "late", "early", "ahead", "stale", "pause", "rotate", "renew", "join", "other",
)  # fmt: skip


@given(st.lists(st.tuples(st.sampled_from(EVENTS), st.integers(0, 1 << 16)), max_size=60))
def test_it_opens_what_the_long_way_opens(shared: Fleet, events: list[tuple[str, int]]) -> None:
    """Whatever the network does to packets, and whatever else the sender sends."""
    sealer, eager, plain = sending(shared)
    second = shared.sealer("operator-2", "teleop")
    meet(second, eager.opener, plain)
    now = time.time_ns()
    packets = [bytes(sealer.seal(b"first", now=now))]

    def arrive(packet: bytes, at: int) -> None:
        assert eager.take(packet, at) == take(plain, packet, at)

    arrive(packets[0], now)
    for event, dice in events:
        now += MILLISECOND
        body = dice.to_bytes(4, "big")
        if event == "batch":
            packets.append(bytes(sealer.seal_many([body, b"", body], now=now)))
        elif event == "other":
            packets.append(bytes(second.seal(body, now=now)))
        else:
            label = PIECE if event == "piece" else NO_LABEL
            sent = now + {"ahead": 6_000, "stale": -600}.get(event, 0) * MILLISECOND
            packets.append(bytes(sealer.seal(body * (8000 if event == "large" else 1), label=label, now=sent)))
        packet, at, old = packets[-1], dice % len(packets[-1]), packets[dice % len(packets)]
        if event == "lose":
            continue
        if event == "repeat":
            arrive(old, now)
        elif event == "overtake":
            packets.append(bytes(sealer.seal(b"quick", now=now)))
            arrive(packets[-1], now)
        elif event == "flip":
            arrive(packet[:at] + bytes([packet[at] ^ (1 << dice % 8)]) + packet[at + 1 :], now)
        elif event == "cut":
            arrive(packet[:at] + packet[-8:], now)
            arrive(packet[:at], now)
        elif event == "grow":
            arrive(packet[:-8] + b"x" + packet[-8:], now)
        elif event == "splice":
            arrive(old[:at] + packet[at:], now)
            arrive(packet[:at] + old[at:], now)
        elif event == "late":
            now += 600 * MILLISECOND
        elif event == "early":
            arrive(packet, now - 6_000 * MILLISECOND)
        elif event == "pause":
            now += 300 * MILLISECOND
        elif event == "rotate":
            pushes = {push.node: push.grant for push in shared.keyrings["operator-1"].rotate("teleop", delay=0.0)}
            shared.keyrings["server"].accept("teleop", pushes["server"])
        elif event == "renew":
            meet(sealer, eager.opener, plain)
            for replacement in eager.opener.replacements():
                sealer.end_session(replacement)
        elif event == "join":
            meet(sealer, shared.opener("drone-1", "teleop"))
        arrive(packet, now)
    assert seen(eager.opener) == seen(plain)


def test_nearly_everything_is_due(fleet: Fleet) -> None:
    """All but the first packet, and the first after each look at keys and policy, four times a second."""
    sealer, eager, plain = sending(fleet)
    start = time.time_ns()
    for k in range(1000):
        now = start + k * MILLISECOND
        packet = bytes(sealer.seal(b"%d" % k, now=now))
        assert eager.take(packet, now) == take(plain, packet, now) == [(b"%d" % k, k + 1, now)]
    assert 990 < eager.at_once < 1000


def expected(fleet: Fleet, now: int, label: bytes = NO_LABEL) -> tuple[Due, bytes]:
    """A packet that is due as the second."""
    sealer, eager, _ = sending(fleet)
    eager.take(bytes(sealer.seal(b"first", now=now)), now)
    due = eager.opener.due()
    assert due is not None
    return due, bytes(sealer.seal(b"left", label=label, now=now))


def test_every_changed_bit_of_what_is_due_is_refused(fleet: Fleet) -> None:
    now = time.time_ns()
    due, packet = expected(fleet, now)
    for length in range(len(packet) - 8):
        assert due.open(packet[:length], 2, now) is None
        assert due.open(packet[:length] + packet[-8:], 2, now) is None
    for at in range(8 * len(packet)):
        changed = bytearray(packet)
        changed[at // 8] ^= 1 << at % 8
        assert due.open(bytes(changed), 2, now) is None
    assert due.open(packet, 1, now) is None
    assert due.open(packet, 2, now) == (b"left", now)
    assert [due.open(packet, sequence, now) for sequence in (2, 3)] == [None, None]


def test_what_has_to_be_looked_at_is_not_due(fleet: Fleet) -> None:
    """Another kind of frame, another time than that for which it was looked, another state of keys and policy."""
    now = time.time_ns()
    due, packet = expected(fleet, now, PIECE)
    assert due.open(packet, 2, now) is None
    due, packet = expected(fleet, now)
    assert due.open(packet, 2, due.since - 1) is None
    assert due.open(packet, 2, due.until + 1) is None
    assert due.open(packet, 2, due.until) == (b"left", now)
    for change in ({"keys": due.keys + 1}, {"beliefs": due.beliefs + 1}, {"max_age": -1}, {"kind": 2}):
        due, packet = expected(fleet, now)
        assert replace(due, **change).open(packet, 2, now) is None
        assert due.open(packet, 2, now) == (b"left", now)


def test_the_revoked_are_refused_at_once(fleet: Fleet) -> None:
    sealer, eager, _ = sending(fleet, "operator-2")
    now = time.time_ns()
    for _ in range(2):
        assert isinstance(eager.take(bytes(sealer.seal(b"x", now=now)), now), list)
    assert eager.at_once == 1
    fleet.revoke("operator-2", tell=["server"])
    assert eager.take(bytes(sealer.seal(b"x", now=now)), now) == Reason.REVOKED


def test_nothing_is_due_that_was_not_one_message_for_one_receiver(fleet: Fleet) -> None:
    sealer, eager, _ = sending(fleet)
    opener, now = eager.opener, time.time_ns()
    assert opener.due() is None
    opener.open_many(sealer.seal(b"x", now=now), now=now)
    assert opener.due() is not None
    opener.open_many(sealer.seal_many([b"x", b"y"], now=now), now=now)
    assert opener.due() is None
    opener.open(sealer.seal(b"x", bind=b"request", now=now), bind=b"request", now=now)
    assert opener.due() is None
    opener.open(sealer.seal(b"x", now=now), now=now)
    with pytest.raises(Refused):
        opener.open(b"noise")
    assert opener.due() is None
    meet(sealer, fleet.opener("drone-1", "teleop"))
    opener.open(sealer.seal(b"x", now=now), now=now)
    assert opener.due() is None
    signed, server = fleet.pair("camera", "drone-1", "server")
    server.open(signed.seal(b"x"))
    assert server.due() is None
