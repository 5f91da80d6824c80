"""A node end to end, over a network in this process that can be told to misbehave."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sgc.fleets import Fleet, eventually, service, topic

from tutelage.errors import ConfigError
from tutelage.sgc import backlog, lanes
from tutelage.sgc import publisher as publishing
from tutelage.sgc.errors import NotAllowed, NotIssued
from tutelage.sgc.frames import PIECE
from tutelage.sgc.history import make_request
from tutelage.sgc.messages import Message
from tutelage.sgc.node import Node
from tutelage.sgc.publisher import PATIENT
from tutelage.sgc.service import RequestFailed
from tutelage.sgc.transport.base import Congested, NoReply, lent
from tutelage.sgc.transport.memory import MemoryTransport, Network

MODES = ("signature", "session", "chain")
POLICY = (
    "".join(topic(f"log-{mode}", ["arm"], ["server", "late"], authenticity=mode) for mode in MODES)
    + topic("camera", ["arm"], ["server"], delivery="lossy")
    + topic("command", ["server"], ["arm"], max_age=0.2)
    + topic("shared", ["arm", "server"], ["arm", "server"])
    + service("grasp", ["server"], ["arm"])
)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    return Fleet(tmp_path_factory.mktemp("fleet"), POLICY, ["arm", "server", "late"])


@pytest.fixture
def network() -> Network:
    return Network()


@pytest.fixture
def arm(fleet: Fleet, network: Network) -> Iterator[Node]:
    with Node.open(fleet["arm"], MemoryTransport(network)) as node:
        yield node


@pytest.fixture
def server(fleet: Fleet, network: Network) -> Iterator[Node]:
    with Node.open(fleet["server"], MemoryTransport(network)) as node:
        yield node


class Received(list[Message]):
    """What a subscription got."""

    def __call__(self, message: Message) -> None:
        self.append(message)

    @property
    def numbers(self) -> list[int]:
        return [int(message.payload) for message in self]


def acquainted(publish: Callable[[bytes], None], received: Received) -> None:
    """Send until the subscriber hears, as sessions and keys take a moment; then forget what it heard."""
    eventually(lambda: publish(b"-1") or received, every=0.05)
    time.sleep(0.1)
    received.clear()


def in_order(received: Received, count: int) -> bool:
    return received.numbers == list(range(count))


# -- streams --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_messages_arrive_in_order_and_once_with_their_sender(arm: Node, server: Node, mode: str) -> None:
    got = Received()
    server.subscribe(f"log-{mode}", got)
    log = arm.publisher(f"log-{mode}")
    acquainted(log.send, got)
    for k in range(500):
        log.send(b"%d" % k, wait=1.0)
    eventually(lambda: in_order(got, 500))
    assert {(m.sender, m.topic, m.authentic) for m in got} == {("arm", f"log-{mode}", True)}
    assert all(0 <= m.latency < 5 for m in got)
    assert log.packets < 500  # what queued up was sealed together


@pytest.mark.parametrize("mode", MODES)
def test_a_message_of_14_mb_arrives(arm: Node, server: Node, mode: str) -> None:
    got = Received()
    server.subscribe(f"log-{mode}", got)
    log = arm.publisher(f"log-{mode}")
    acquainted(log.send, got)
    payload = os.urandom(14 << 20)
    log.send(payload)
    eventually(lambda: [m.payload for m in got] == [payload])


def test_renewed_sessions_do_not_add_up(arm: Node, server: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a topic with one receiver would be sealed for two, after ten minutes and for ever."""
    monkeypatch.setattr("tutelage.sgc.subscription.OFFER_EVERY", 0.2)
    got = Received()
    server.subscribe("log-session", got)
    log = arm.publisher("log-session")
    acquainted(log.send, got)
    seen: set[bytes] = set()
    numbers = itertools.count()

    def renewed() -> bool:
        log.send(b"%d" % next(numbers))
        seen.update(session.ident for session in log._sealer._sessions)
        return len(seen) > 3 and len(log._sealer._sessions) == 1

    eventually(renewed, every=0.02)
    sent = next(numbers)
    eventually(lambda: in_order(got, sent))


def senders_of_large(network: Network) -> list[str]:
    """Names of the threads that send packets of more than `PIECE` bytes from now on."""
    threads: list[str] = []

    def tap(key: str, packet: bytes) -> list[tuple[str, bytes]]:
        if len(packet) > PIECE:
            threads.append(threading.current_thread().name)
        return [(key, packet)]

    network.tap = tap
    return threads


def test_a_patient_caller_sends_large_messages_itself(network: Network, arm: Node) -> None:
    """Everybody else leaves them to the publisher's thread, as the network may be slow."""
    log = arm.publisher("log-signature")
    threads = senders_of_large(network)
    for wait in (PATIENT, 0.0):
        eventually(lambda: not log._busy and time.monotonic() > log._free_at)
        log.send(bytes(PIECE), wait=wait)
        assert log.flush(5.0)
    assert threads == [threading.current_thread().name, "sgc-publish-log-signature"]


def test_a_direct_callback_does_not_wait_for_the_network(network: Network, arm: Node, server: Node) -> None:
    """It has a thread of the network, which goes on receiving only when the callback is done."""
    log, there = arm.publisher("log-signature"), threading.get_ident()
    inside: list[bool] = []
    server.subscribe("log-signature", lambda message: inside.append(there in lent), direct=True)
    eventually(lambda: log.send(b"?") or True in inside, every=0.05)
    assert there not in lent
    threads = senders_of_large(network)
    eventually(lambda: not log._busy and time.monotonic() > log._free_at)
    lent.add(there)
    try:
        log.send(bytes(PIECE), wait=PATIENT)
    finally:
        lent.discard(there)
    assert log.flush(5.0)
    assert threads == ["sgc-publish-log-signature"]


def test_iterating_over_a_subscription(arm: Node, server: Node) -> None:
    subscription = server.subscribe("log-signature")
    for k in range(3):
        arm.publisher("log-signature").send(b"%d" % k)
    assert [int(m.payload) for _, m in zip(range(3), subscription, strict=False)] == [0, 1, 2]
    assert subscription.receive(timeout=0.01) is None
    subscription.close()
    assert list(subscription) == []


@pytest.mark.parametrize("mode", MODES)
def test_a_direct_subscription_gets_the_same_on_the_networks_thread(
    network: Network, arm: Node, server: Node, mode: str
) -> None:
    got, threads = Received(), set[str]()
    server.subscribe(f"log-{mode}", lambda m: (threads.add(threading.current_thread().name), got(m))[0], direct=True)
    log = arm.publisher(f"log-{mode}")
    acquainted(log.send, got)
    threads.clear()
    for k in range(300):
        network.up = not 100 <= k < 150  # what is lost is fetched again
        log.send(b"%d" % k)
        log.flush(1.0)
    eventually(lambda: in_order(got, 300))
    assert any(not name.startswith("sgc-subscribe") for name in threads)


def test_a_direct_subscription_opens_what_comes_next_in_one_step(
    arm: Node, server: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Small messages between large ones and pauses are counted and delivered as any other."""
    got, long_way = Received(), list[int]()
    subscription = server.subscribe("log-session", got, direct=True)
    log = arm.publisher("log-session")
    acquainted(log.send, got)
    open_many = subscription.opener.open_many
    monkeypatch.setattr(subscription.opener, "open_many", lambda *a, **k: [long_way.append(1), open_many(*a, **k)][1])
    heard, packets = len(got), subscription.packets
    sent = [b"%d" % k + bytes(2 * PIECE if k % 50 == 49 else 0) for k in range(200)]
    for payload in sent:
        log.send(payload)
        assert log.flush(5.0)
    eventually(lambda: len(got) == heard + len(sent))
    assert [each.payload for each in got[heard:]] == sent
    assert [each.sequence for each in got[heard:]] == sorted({each.sequence for each in got[heard:]})
    assert subscription.packets - packets >= len(sent) + 8
    assert len(long_way) < len(sent) / 2  # pieces, what follows them, and the first after each look and sign of life
    assert subscription.lost == 0


def test_what_an_earlier_program_sends_next_is_not_taken_for_the_present_ones(
    fleet: Fleet, network: Network, arm: Node, server: Node
) -> None:
    """Two programs of one node: the number that the earlier one's message has is the one that the later one's next has."""
    got = Received()
    server.subscribe("log-session", got, direct=True)
    before = arm.publisher("log-session")
    acquainted(before.send, got)
    with Node.open(fleet["arm"], MemoryTransport(network)) as again:
        now = again.publisher("log-session")
        eventually(lambda: now.send(b"0") or got.numbers[-1:] == [0], every=0.05)
        for _ in range(20):
            while now._sealer.sequence < before._sealer.sequence + 1:
                now.send(b"1")
                assert now.flush(5.0)
            while before._sealer.sequence < now._sealer.sequence + 2:
                before.send(b"-2")
                assert before.flush(5.0)
    assert got.numbers.count(1) > 20
    assert -2 not in got.numbers


def test_a_direct_subscription_needs_a_callback(server: Node) -> None:
    with pytest.raises(ConfigError, match="a direct subscription of log-signature needs a callback"):
        server.subscribe("log-signature", direct=True)


def test_messages_wait_for_the_key_until_its_owner_is_there(tmp_path: Path, network: Network) -> None:
    fleet = Fleet(tmp_path, POLICY, ["arm", "server"])
    with Node.open(fleet["server"], MemoryTransport(network)) as server:
        got = Received()
        server.subscribe("shared", got)
        server.publisher("shared").send(b"0")
        time.sleep(0.2)
        assert got == []
        with Node.open(fleet["arm"], MemoryTransport(network)):
            eventually(lambda: in_order(got, 1))


def test_both_ends_publish_and_hear_the_same_topic(arm: Node, server: Node) -> None:
    at_arm, at_server = Received(), Received()
    arm.subscribe("shared", at_arm)
    server.subscribe("shared", at_server)
    acquainted(server.publisher("shared").send, at_arm)
    arm.publisher("shared").send(b"1")
    server.publisher("shared").send(b"2")
    eventually(lambda: {m.sender for m in at_arm} == {m.sender for m in at_server} == {"arm", "server"})


# -- what a network does ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_what_was_sent_while_the_network_was_down_is_replayed(network: Network, arm: Node, server: Node, mode: str) -> None:
    got = Received()
    subscription = server.subscribe(f"log-{mode}", got)
    log = arm.publisher(f"log-{mode}")
    acquainted(log.send, got)
    for k in range(300):
        network.up = not 100 <= k < 200
        log.send(b"%d" % k)
        log.flush(1.0)
    eventually(lambda: in_order(got, 300))
    assert subscription.lost == 0
    assert subscription.repaired > 0


@pytest.mark.parametrize("mode", MODES)
def test_what_the_network_did_not_take_is_replayed(
    arm: Node, server: Node, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    got = Received()
    subscription = server.subscribe(f"log-{mode}", got)
    log = arm.publisher(f"log-{mode}")
    acquainted(log.send, got)
    publish = arm.transport.publish

    def congested(key: str, payload: bytes | bytearray, *, reliable: bool = True) -> None:
        if key.endswith(lanes.STREAM):
            raise Congested("for a moment")
        publish(key, payload, reliable=reliable)

    log.send(b"0")
    log.flush(1.0)
    monkeypatch.setattr(arm.transport, "publish", congested)
    log.send(b"1")
    log.flush(1.0)
    monkeypatch.setattr(arm.transport, "publish", publish)
    with pytest.raises(Congested, match="for a moment"):
        log.send(b"not sent: the one before it failed")
    log.send(b"2")
    eventually(lambda: in_order(got, 3))
    assert subscription.lost == 0
    assert subscription.repaired > 0


def test_the_last_message_is_not_missed_either(network: Network, arm: Node, server: Node) -> None:
    got = Received()
    server.subscribe("log-signature", got)
    log = arm.publisher("log-signature")
    acquainted(log.send, got)
    network.up = False
    log.send(b"0")
    network.up = True
    eventually(lambda: in_order(got, 1))


def test_a_subscriber_that_is_about_to_miss_something_is_waited_for(arm: Node) -> None:
    log = arm.publisher("log-signature")
    log._history._limit = 100
    for k in range(100):
        log.send(b"%d" % k)
        log.flush(1.0)  # a packet each
    log._free_at = 0.0
    log._replay(make_request([(90, 90)]))
    assert log._free_at == 0.0
    now = time.monotonic()
    log._replay(make_request([(10, 20)]))
    assert log._free_at > now
    log.send(b"waits in the queue")
    eventually(lambda: log.queued == 0)
    waited = log._free_at
    log._replay(make_request([(10, 20)]))  # nothing came of it: whoever is stuck is not waited for again
    assert log._free_at <= max(waited, time.monotonic() + log._spacing)


def test_a_publisher_that_is_gone_leaves_a_counted_gap(fleet: Fleet, network: Network, server: Node) -> None:
    got = Received()
    subscription = server.subscribe("log-signature", got)
    with Node.open(fleet["arm"], MemoryTransport(network)) as arm:
        log = arm.publisher("log-signature")
        acquainted(log.send, got)
        log.send(b"0")
        network.up = False
        log.send(b"1")
        log.flush(1.0)
        arm.transport.close()  # nobody answers questions any more
        network.up = True
        arm.transport.publish(log._key, log._history.find([(1, 1 << 60)])[1][0])  # an old one, as if from a slow path
        log.send(b"2")
        eventually(lambda: subscription.delivery.wake() is not None)
    subscription.delivery.patience = 0.1
    next(iter(subscription.delivery._current.values())).patience = 0.1
    eventually(lambda: got.numbers == [0, 2])
    assert subscription.lost == 1


def test_a_restarted_publisher_is_heard_at_once(fleet: Fleet, network: Network, server: Node) -> None:
    got = Received()
    server.subscribe("log-signature", got)
    for k in range(3):
        with Node.open(fleet["arm"], MemoryTransport(network)) as arm:
            arm.publisher("log-signature").send(b"%d" % k)
            eventually(lambda k=k: in_order(got, k + 1))


@pytest.mark.parametrize("mode", MODES)
def test_a_slow_application_gets_everything(arm: Node, server: Node, mode: str) -> None:
    got = Received()
    subscription = server.subscribe(f"log-{mode}", lambda m: (time.sleep(0.001), got(m))[0], queue=4)
    log = arm.publisher(f"log-{mode}")
    acquainted(log.send, got)
    for k in range(400):
        log.send(b"%d" % k)
        log.flush(1.0)  # a packet each
    eventually(lambda: in_order(got, 400))
    assert subscription.deferred > 0


def test_a_lossy_topic_gives_the_newest_to_a_slow_application(arm: Node, server: Node) -> None:
    got, gate = Received(), threading.Event()
    server.subscribe("camera", lambda m: (got(m), gate.wait(5.0))[0])
    camera = arm.publisher("camera")
    eventually(lambda: camera.send(b"-1") or got, every=0.05)
    for k in range(50):
        camera.send(b"%d" % k)
        camera.flush(1.0)
    gate.set()
    eventually(lambda: got.numbers[-1] == 49)
    assert len(got) < 10
    assert got.numbers == sorted(got.numbers)


def test_a_busy_lossy_publisher_sends_the_newest(arm: Node, server: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    got = Received()
    server.subscribe("camera", got)
    camera = arm.publisher("camera")
    acquainted(camera.send, got)
    for k in range(200):
        camera.send(b"%d" % k)
    eventually(lambda: got.numbers[-1:] == [199])
    assert camera.superseded + camera.sent >= 200


def test_a_network_that_takes_nothing_is_seen_by_the_sender(arm: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backlog, "QUEUE_MESSAGES", 10)
    log, gate = arm.publisher("log-signature"), threading.Event()
    stuck = threading.Event()
    monkeypatch.setattr(arm.transport, "publish", lambda *args, **options: stuck.set() or gate.wait(5.0))
    try:
        log.send(bytes(publishing.INLINE + 1))
        assert stuck.wait(5.0)
        with pytest.raises(Congested, match=r"the queue of log-signature is full \(10 messages\)"):
            for _ in range(100):
                log.send(bytes(publishing.INLINE + 1))
        assert arm.counters()["topics"]["log-signature"]["publisher"]["congested"] == 1
        with pytest.raises(Congested):
            log.send(b"", wait=0.05)
    finally:
        gate.set()


def test_a_command_that_waited_too_long_is_refused(network: Network, arm: Node, server: Node) -> None:
    got = Received()
    subscription = arm.subscribe("command", got)
    command = server.publisher("command")
    acquainted(command.send, got)
    held: list[tuple[str, bytes]] = []
    network.tap = lambda key, packet: held.append((key, packet)) or []
    command.send(b"0")
    time.sleep(0.3)
    network.tap = None
    for key, packet in held:
        network.deliver(key, packet)
    command.send(b"1")
    eventually(lambda: got.numbers == [1])
    assert subscription.opener.refusals.as_dict()["too_old"] >= 1


# -- services -----------------------------------------------------------------------------------------------------------------


def test_a_service_is_asked_and_answers(arm: Node, server: Node) -> None:
    with server.serve("grasp", lambda asked: asked.sender.encode() + b" wants " + asked.payload):
        assert arm.request("grasp", b"the box") == b"arm wants the box"
        assert arm.request("grasp", b"", timeout=5.0) == b"arm wants "
    with pytest.raises(NoReply, match="nobody answered grasp within 0.1 s"):
        arm.request("grasp", b"", timeout=0.1)


def test_a_handler_that_fails_says_so_to_the_requester(arm: Node, server: Node) -> None:
    def fail(asked: Message) -> bytes:
        raise ValueError("the gripper is open")

    with (
        server.serve("grasp", fail),
        pytest.raises(RequestFailed, match="server could not serve grasp: ValueError: the grip"),
    ):
        arm.request("grasp", b"")


def test_a_repeated_request_is_handled_once(network: Network, arm: Node, server: Node) -> None:
    handled: list[bytes] = []
    with server.serve("grasp", lambda asked: handled.append(asked.payload) or b"done"):
        arm.request("grasp", b"0")
        asked: list[bytes] = []
        network.ask_tap = lambda key, request: (asked.append(request) if key.endswith("/call") else None) or request
        arm.request("grasp", b"1")
        key = next(key for key, _ in network.servers.values() if key.endswith("/call"))
        replays = [serve(asked[-1]) for at, serve in list(network.servers.values()) if at == key]
    assert replays == [None]
    assert handled == [b"0", b"1"]
    assert server.counters()["topics"]["grasp"]["server"]["refused"]["replayed"] == 1


def test_a_reply_to_another_request_is_refused(network: Network, arm: Node, server: Node) -> None:
    with server.serve("grasp", lambda asked: asked.payload):
        arm.request("grasp", b"to get acquainted")
        replies: list[bytes] = []
        calls = lanes.key(arm.access.entry("grasp").name, lanes.CALL)
        network.answer_tap = lambda key, reply: reply if key != calls else replies.append(reply) or replies[0]
        assert arm.request("grasp", b"0") == b"0"
        with pytest.raises(NoReply, match="refused"):
            arm.request("grasp", b"1")


# -- who is there ---------------------------------------------------------------------------------------------------------------


def test_peers_are_known_by_name_and_can_be_pinged(arm: Node, server: Node) -> None:
    [peer] = arm.peers()
    assert peer.name == "server"
    assert {"camera", "grasp", "log-chain"} <= set(peer.topics)
    assert 0 < server.ping("arm") < 1
    with pytest.raises(NoReply, match="no node late"):
        arm.ping("late", timeout=0.1)


def test_an_invented_presence_is_no_peer(network: Network, arm: Node) -> None:
    name = arm.access.entry("camera").name
    with MemoryTransport(network).announce(lanes.key(name, lanes.HERE, "ab" * 16)):
        assert arm.peers(timeout=0.2) == []


# -- what is not allowed ------------------------------------------------------------------------------------------------------


def test_what_the_policy_does_not_give_is_refused_with_the_remedy(arm: Node, server: Node) -> None:
    for attempt, match in (
        (lambda: server.publisher("camera"), "server is not in publish of topic 'camera'"),
        (lambda: arm.subscribe("camera"), "arm is not in subscribe of topic 'camera'"),
        (lambda: arm.serve("grasp", lambda m: b""), "arm is not in serve of topic 'grasp'"),
        (lambda: server.request("grasp", b""), "server is not in request of topic 'grasp'"),
        (lambda: arm.publisher("nothing"), "no part in a topic 'nothing'"),
        (lambda: arm.request("camera", b""), "camera is a stream"),
        (lambda: arm.publisher("grasp"), "grasp is a service"),
    ):
        with pytest.raises(NotAllowed, match=match):
            attempt()


def test_a_message_that_is_too_large_is_refused(arm: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tutelage.sgc.frames.MAX_MESSAGE", 1 << 20)
    with pytest.raises(ConfigError, match="at most 1 MiB"):
        arm.publisher("log-signature").send(bytes((1 << 20) + 1))


def test_an_expired_certificate_stops_a_node_with_the_remedy(tmp_path: Path, network: Network) -> None:
    fleet = Fleet(tmp_path, POLICY, ["arm"])
    home = fleet["arm"]
    home.accept(fleet.authority.issue(home.request(), hours=4 / 3600))  # long enough to be taken on a busy machine
    time.sleep(4.1)
    with pytest.raises(NotIssued, match="the certificate of arm expired"):
        Node.open(home, MemoryTransport(network))


def test_a_revoked_node_hears_nothing_more(tmp_path: Path, network: Network) -> None:
    fleet = Fleet(tmp_path, POLICY, ["arm", "server", "late"])
    with (
        Node.open(fleet["arm"], MemoryTransport(network)) as arm,
        Node.open(fleet["server"], MemoryTransport(network)) as server,
        Node.open(fleet["late"], MemoryTransport(network)) as thief,
    ):
        heard, stolen = Received(), Received()
        server.subscribe("log-signature", heard)
        thief.subscribe("log-signature", stolen)
        log = arm.publisher("log-signature")
        acquainted(log.send, heard)
        acquainted(log.send, stolen)
        # Only the owner hears of it, and no router does anything: the key changes, and the thief gets none.
        fleet["arm"].accept(fleet.authority.revoke("late"))
        epoch = arm.keyring.epoch("log-signature")
        eventually(lambda: arm.keyring.epoch("log-signature") != epoch)
        eventually(lambda: server.keyring.epoch("log-signature") == arm.keyring.epoch("log-signature"))
        heard.clear()
        stolen.clear()
        for k in range(20):
            log.send(b"%d" % k)
        eventually(lambda: in_order(heard, 20))
        assert stolen == []
        eventually(lambda: fleet["server"].deny_notice is not None)  # passed on among the nodes


def test_a_new_policy_takes_effect_while_nodes_run(tmp_path: Path, network: Network) -> None:
    fleet = Fleet(tmp_path, topic("log", ["arm"], ["server"]), ["arm", "server"])
    with (
        Node.open(fleet["arm"], MemoryTransport(network)) as arm,
        Node.open(fleet["server"], MemoryTransport(network)) as server,
    ):
        got = Received()
        server.subscribe("log", got)
        acquainted(arm.publisher("log").send, got)
        with pytest.raises(NotAllowed):
            server.publisher("command")
        fleet.publish("version = 1\n" + topic("command", ["server"], ["arm"]))
        arrived = Received()
        arm.subscribe("command", arrived)
        server.publisher("command").send(b"0")
        eventually(lambda: in_order(arrived, 1))
        eventually(lambda: arm.peers()[0].topics == ("command",))
        with pytest.raises(NotAllowed):
            arm.publisher("log").send(b"1") or time.sleep(0.5) or arm.publisher("log").send(b"2")
