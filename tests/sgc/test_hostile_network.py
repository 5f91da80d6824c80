"""A router that drops, repeats, holds back, reorders, rewrites and invents packets costs time or messages, never truth.

A state machine drives real nodes; only the wire is in its hands.
"""

from __future__ import annotations

import random
import tempfile
import threading
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from sgc.fleets import Fleet, eventually, service, topic

from tutelage.sgc import delivery, lanes
from tutelage.sgc.messages import Message
from tutelage.sgc.names import Name
from tutelage.sgc.node import Node
from tutelage.sgc.transport.base import NoReply
from tutelage.sgc.transport.memory import MemoryTransport, Network

MODES = ("signature", "session", "chain")
POLICY = "".join(topic(f"log-{mode}", ["arm"], ["server"], authenticity=mode) for mode in MODES)
POLICY += service("grasp", ["server"], ["arm"])


class Wire:
    """What the router does with packets of the streams: passes them on, or as it is told."""

    def __init__(self, network: Network, name: Name) -> None:
        self.network = network
        self.name = name
        self.drop = self.twice = self.hold = False
        self.rewrite: int | None = None
        self.held: list[tuple[str, bytes]] = []
        self.seen: list[tuple[str, bytes]] = []
        self.lock = threading.Lock()
        network.tap = self.carry

    def carry(self, key: str, packet: bytes) -> list[tuple[str, bytes]]:
        if key != lanes.key(self.name, lanes.STREAM):
            return [(key, packet)]
        with self.lock:
            self.seen = [*self.seen[-50:], (key, packet)]
            if self.drop:
                return []
            if self.rewrite is not None:
                at = self.rewrite % len(packet)
                packet = packet[:at] + bytes([packet[at] ^ 0x40]) + packet[at + 1 :]
            if self.hold:
                self.held.append((key, packet))
                return []
        return [(key, packet)] * (2 if self.twice else 1)


class HostileRouter(RuleBasedStateMachine):
    """Messages are numbers; what arrives must be them, in order, each once."""

    fleet: Fleet

    @initialize(mode=st.sampled_from(MODES))
    def come_up(self, mode: str) -> None:
        self.network = Network()
        self.alias = f"log-{mode}"
        self.arm = Node.open(self.fleet["arm"], MemoryTransport(self.network))
        self.server = Node.open(self.fleet["server"], MemoryTransport(self.network))
        self.got: list[int] = []
        self.strange: list[Message] = []
        self.subscription = self.server.subscribe(self.alias, self.hear)
        self.publisher = self.arm.publisher(self.alias)
        self.sent = 0
        eventually(lambda: self.publisher.send(b"hello") or self.sent_before, every=0.02)
        self.wire = Wire(self.network, self.arm.access.entry(self.alias).name)

    sent_before = False

    def hear(self, message: Message) -> None:
        if message.payload == b"hello":
            self.sent_before = True
        elif message.sender != "arm" or not message.authentic or not message.payload.isdigit():
            self.strange.append(message)
        else:
            self.got.append(int(message.payload))

    @rule(count=st.integers(1, 20), together=st.booleans())
    def send(self, count: int, together: bool) -> None:
        for _ in range(count):
            self.publisher.send(b"%d" % self.sent)
            self.sent += 1
            if not together:
                self.publisher.flush(1.0)
        self.publisher.flush(1.0)

    @rule(drop=st.booleans(), twice=st.booleans(), hold=st.booleans())
    def misbehave(self, drop: bool, twice: bool, hold: bool) -> None:
        self.wire.drop, self.wire.twice, self.wire.hold = drop, twice, hold

    @rule(at=st.none() | st.integers(0, 4000))
    def rewrite(self, at: int | None) -> None:
        self.wire.rewrite = at

    @rule(seed=st.integers(0, 1000))
    def let_go_in_another_order(self, seed: int) -> None:
        with self.wire.lock:
            held, self.wire.held = self.wire.held, []
        random.Random(seed).shuffle(held)
        for key, packet in held:
            self.network.deliver(key, packet)

    @rule(back=st.integers(1, 50))
    def repeat_an_old_packet(self, back: int) -> None:
        for key, packet in self.wire.seen[-back:][:1]:
            self.network.deliver(key, packet)

    @rule(junk=st.binary(max_size=300))
    def invent_a_packet(self, junk: bytes) -> None:
        for lane in (lanes.STREAM, lanes.HELLO, lanes.OFFER, lanes.ANSWER, lanes.GRANTS):
            self.network.deliver(lanes.key(self.wire.name, lane), junk)
        self.network.deliver(lanes.key(self.arm.access.control, lanes.DENY), junk)

    @rule(answer=st.none() | st.binary(max_size=60))
    def spoil_answers(self, answer: bytes | None) -> None:
        self.network.answer_tap = (lambda key, reply: answer) if answer is not None else None

    @invariant()
    def in_order_and_true(self) -> None:
        if hasattr(self, "got"):
            got = list(self.got)
            assert got == sorted(set(got))
            assert all(0 <= number < self.sent for number in got)
            assert self.strange == []

    def teardown(self) -> None:
        if not hasattr(self, "wire"):
            return
        try:
            # The router behaves again: whatever the publisher still holds must arrive, and everything else is counted.
            self.wire.drop = self.wire.twice = self.wire.hold = False
            self.wire.rewrite = self.network.answer_tap = None
            last = self.sent
            self.sent += 1
            self.publisher.send(b"%d" % last)
            eventually(lambda: self.got[-1:] == [last])
            self.in_order_and_true()
            missing = last + 1 - len(self.got)
            assert missing <= self.subscription.lost
        finally:
            self.arm.close()
            self.server.close()


@pytest.fixture(scope="module", autouse=True)
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    HostileRouter.fleet = Fleet(Path(tempfile.mkdtemp(dir=tmp_path_factory.mktemp("h"))), POLICY, ["arm", "server"])
    HostileRouter.fleet.share()
    return HostileRouter.fleet


TestHostileRouter = HostileRouter.TestCase
TestHostileRouter.settings = settings(
    max_examples=25, stateful_step_count=12, deadline=None, suppress_health_check=list(HealthCheck)
)


@pytest.mark.parametrize("mode", MODES)
def test_one_packet_in_ten_lost_is_nothing_lost(fleet: Fleet, mode: str) -> None:
    network, seen = Network(), [0]

    def lose(key: str, packet: bytes) -> list[tuple[str, bytes]]:
        seen[0] += 1
        return [] if seen[0] % 10 == 0 else [(key, packet)]

    with (
        Node.open(fleet["arm"], MemoryTransport(network)) as arm,
        Node.open(fleet["server"], MemoryTransport(network)) as server,
    ):
        got: list[bytes] = []
        subscription = server.subscribe(f"log-{mode}", lambda message: got.append(message.payload))
        log = arm.publisher(f"log-{mode}")
        eventually(lambda: log.send(b"hello") or got, every=0.05)
        time.sleep(0.2)
        got.clear()
        network.tap = lose
        for k in range(500):
            log.send(b"%d" % k)
            log.flush(1.0)
        eventually(lambda: got == [b"%d" % k for k in range(500)])
        assert subscription.lost == 0


def test_junk_in_place_of_requests_and_answers_is_refused(fleet: Fleet) -> None:
    network = Network()
    with (
        Node.open(fleet["arm"], MemoryTransport(network)) as arm,
        Node.open(fleet["server"], MemoryTransport(network)) as server,
        server.serve("grasp", lambda asked: b"done"),
    ):
        assert arm.request("grasp", b"") == b"done"
        for junk in (b"", b"\0", b"\0" * 200, b"\1", b"\2", b"\7junk"):
            network.answer_tap = lambda key, reply, junk=junk: junk
            with pytest.raises(NoReply):
                arm.request("grasp", b"", timeout=0.1)
        network.answer_tap = None
        for junk in (b"", b"\0" * 200):
            network.ask_tap = lambda key, request, junk=junk: junk
            with pytest.raises(NoReply):
                arm.request("grasp", b"", timeout=0.1)
        network.ask_tap = None
        assert arm.request("grasp", b"") == b"done"


def test_a_router_that_never_gives_what_is_missing_delays_but_does_not_stop(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery, "PATIENCE", 0.3)
    network = Network()
    with (
        Node.open(fleet["arm"], MemoryTransport(network)) as arm,
        Node.open(fleet["server"], MemoryTransport(network)) as server,
    ):
        got: list[bytes] = []
        subscription = server.subscribe("log-signature", lambda message: got.append(message.payload))
        subscription.delivery.patience = 0.3
        log = arm.publisher("log-signature")
        log.send(b"0")
        eventually(lambda: got == [b"0"])
        next(iter(subscription.delivery._current.values())).patience = 0.3
        network.answer_tap = lambda key, reply: None
        network.tap = lambda key, packet: []
        log.send(b"1")
        log.flush(1.0)
        network.tap = None
        log.send(b"2")
        eventually(lambda: got == [b"0", b"2"], timeout=3.0)
        assert subscription.lost == 1
