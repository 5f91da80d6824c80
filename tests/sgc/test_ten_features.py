"""The ten features of section 8.3, one test each, over real routers. The name of a test is the feature's."""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from sgc import netlab
from sgc.fleets import Fleet, Heard, Programs, eventually, free_port, service, topic

from tutelage.sgc import lanes
from tutelage.sgc.backlog import QUEUE_MESSAGES
from tutelage.sgc.errors import NotAllowed
from tutelage.sgc.names import Name, Topic
from tutelage.sgc.node import Node
from tutelage.sgc.router import Router, RouterConfig
from tutelage.sgc.rules import Role
from tutelage.sgc.transport.base import Congested
from tutelage.sgc.transport.config import Endpoint, NetworkConfig

pytest.importorskip("zenoh", reason="needs the extra sgc")

STRING = "std_msgs/msg/String"
POLICY = (
    topic("berkeley", ["arm-1"], ["server"], interface="/state", node="arm", unique="Berkeley")
    + topic("pittsburgh", ["arm-2"], ["server"], interface="/state", node="arm", unique="Pittsburgh")
    + topic("chat", ["arm-1", "server"], ["arm-1", "server"], interface="/chatter", type=STRING)
    + topic("private", ["arm-1"], ["arm-1"])
    + service("plan", ["server"], ["arm-1"])
)
NODES = ("arm-1", "arm-2", "server")


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return Fleet(tmp_path, POLICY, NODES, ["router-1", "router-2"])


@pytest.fixture
def domains() -> Iterator[int]:
    """DDS domains, on the loopback interface only."""
    pytest.importorskip("cyclonedds", reason="needs the extra ros2")
    from sgc.proxies.company import stay_on_loopback

    stay_on_loopback()
    return iter(range(60, 80))


@pytest.fixture
def mesh(fleet: Fleet) -> Iterator[list[str]]:
    """Two routers, joined; the nodes dial the first."""
    one, two = (f"tls/127.0.0.1:{free_port()}" for _ in range(2))
    for name in NODES:
        NetworkConfig((Endpoint.parse(one),)).save(fleet[name].path)
    with Router(fleet["router-1"], RouterConfig.of([one])), Router(fleet["router-2"], RouterConfig.of([two], [one])):
        yield [one, two]


def hear(node: Node, alias: str) -> list[bytes]:
    """The payloads that come from now on."""
    got: list[bytes] = []
    node.subscribe(alias, lambda message: got.append(message.payload))
    return got


def test_1_globally_identifiable_addresses(fleet: Fleet, mesh: list[str]) -> None:
    """The same interface at two places has two names, which everybody derives alike and which follow nobody's address."""
    arm_1, server = (fleet[name].access for name in ("arm-1", "server"))
    assert arm_1.entry("berkeley").name == server.entry("berkeley").name
    assert server.entry("berkeley").name != server.entry("pittsburgh").name
    assert len(server.entry("berkeley").name) * 8 == 256
    NetworkConfig((Endpoint.parse(mesh[1]),)).save(fleet["arm-2"].path)  # elsewhere: another router
    with (
        Node.open(fleet["server"].path) as at_server,
        Node.open(fleet["arm-1"].path) as one,
        Node.open(fleet["arm-2"].path) as two,
    ):
        berkeley, pittsburgh = hear(at_server, "berkeley"), hear(at_server, "pittsburgh")
        eventually(lambda: one.publisher("berkeley").send(b"from Berkeley") or berkeley, every=0.05)
        eventually(lambda: two.publisher("pittsburgh").send(b"from Pittsburgh") or pittsburgh, every=0.05)
        assert set(berkeley) == {b"from Berkeley"}
        assert set(pittsburgh) == {b"from Pittsburgh"}


def test_2_transparency_to_ros2_applications(fleet: Fleet, mesh: list[str], domains: Iterator[int]) -> None:
    """Plain DDS participants, which know nothing of this package, talk across two ROS 2 domains."""
    ros = pytest.importorskip("sgc.proxies.ros_ends", reason="needs the extra ros2")
    from tutelage.sgc.proxies.ros2 import Ros2Proxy
    from tutelage.sgc.proxies.ros_qos import QosProfile
    from tutelage.sgc.proxies.routes import Routes, TopicRoute

    def routes(domain: int) -> Routes:
        return Routes((TopicRoute("chat", "/chatter", STRING, True, True, QosProfile(depth=100), domain, queue=100),), ())

    here, there = next(domains), next(domains)
    with Node.open(fleet["arm-1"].path) as arm, Node.open(fleet["server"].path) as server:
        eventually(lambda: arm.connected and server.connected)
        with Ros2Proxy(arm, routes(here)), Ros2Proxy(server, routes(there)):
            robot, cloud = ros.RosNode(here), ros.RosNode(there)
            listener = cloud.subscription("/chatter")
            eventually(listener.get_matched_publications)
            said = [f"message {k}" for k in range(50)]
            speaker = robot.say("/chatter", said)
            assert ros.taken(listener, 50, 20.0) == said
            del speaker


def test_3_communication_security(fleet: Fleet, mesh: list[str]) -> None:
    """A router reads nothing, and what it changes or makes up is refused."""
    where = f"tls/127.0.0.1:{free_port()}"
    for name in NODES:
        NetworkConfig((Endpoint.parse(where),)).save(fleet[name].path)
    with Router(fleet["router-1"], RouterConfig.of([where])) as router:
        seen: list[tuple[str, bytes]] = []
        spy = router._session
        spy.declare_subscriber("**", lambda sample: seen.append((str(sample.key_expr), sample.payload.to_bytes())))
        with Node.open(fleet["server"].path) as server, Node.open(fleet["arm-1"].path) as arm:
            got = hear(server, "berkeley")
            arm.publisher("berkeley").send(b"the plan of the building")
            eventually(lambda: got)
            eventually(lambda: any(key.endswith("/stream") for key, _ in seen))
            assert not any(b"building" in packet for _, packet in seen)
            key, packet = next((key, packet) for key, packet in seen if key.endswith("/stream"))
            for at in (0, 30, 70, len(packet) - 1):
                spy.put(key, packet[:at] + bytes([packet[at] ^ 1]) + packet[at + 1 :])
            spy.put(key, packet)
            refusals = server.subscriptions()[0].opener.refusals
            eventually(lambda: refusals.total() >= 5)
            assert got == [b"the plan of the building"]
            assert refusals.as_dict()["replayed"] >= 1


def test_4_global_anonymity(fleet: Fleet) -> None:
    """All of a topic's metadata and the name in the network do not go together without the topic's secret."""
    entry = fleet["server"].access.entry("berkeley")
    known = entry.rule.topic
    guesses = [
        hashlib.sha256(known.canonical()).digest(),
        hashlib.sha256("".join(vars(known).values()).encode()).digest(),
        Name.of(known, bytes(32)),
    ]
    assert entry.name not in guesses
    assert Name.of(Topic(**vars(known)), entry.secret) == entry.name
    # What a router is told, and so could reveal, are names and pseudonyms.
    told = json.dumps([[r.name.hex(), sorted(r.send), sorted(r.receive)] for r in fleet["router-1"].access.routes])
    for word in ("arm", "server", "state", "Berkeley", "std_msgs"):
        assert word not in told
    assert not fleet["router-1"].access.topics


def test_5_network_isolation_and_topic_level_access_control(fleet: Fleet, mesh: list[str]) -> None:
    """What is not shared stays where it is: others have neither its name nor its key, nor the router's leave."""
    with Node.open(fleet["arm-1"].path) as arm, Node.open(fleet["server"].path) as server:
        own = hear(arm, "private")
        eventually(lambda: arm.publisher("private").send(b"mine") or own, every=0.05)
        with pytest.raises(NotAllowed, match="the policy gives server no part in a topic 'private'"):
            server.subscribe("private")
        stolen: list[bytes] = []
        server.transport.subscribe(lanes.key(arm.access.entry("private").name, lanes.STREAM), stolen.append)
        for _ in range(10):
            arm.publisher("private").send(b"mine")
            time.sleep(0.02)
        assert stolen == []
        with pytest.raises(NotAllowed, match="server is not in publish"):
            server.publisher("berkeley")


@pytest.mark.skipif(bool(netlab.why_not()), reason=netlab.why_not() or "-")
def test_6_global_connectivity(tmp_path: Path) -> None:
    """Both sides behind address translation, with the same private address; only the router can be reached."""
    fleet = Fleet(tmp_path, topic("log", ["robot"], ["server"]), ["robot", "server"])
    fleet.join("router", Role.ROUTER, addresses=(netlab.ROUTER,))
    fleet.publish((tmp_path / "authority" / "policy.toml").read_text())
    for name in ("robot", "server"):
        NetworkConfig((Endpoint.parse(f"tls/{netlab.ROUTER}:7447"),)).save(fleet[name].path)
    with netlab.Lab() as lab, Programs(tmp_path) as programs:
        programs.start("route", fleet["router"].path, "tls/0.0.0.0:7447", inside=lab.inside("router"))
        listener = programs.start("listen", fleet["server"].path, "log", inside=lab.inside("server"))
        programs.start("publish", fleet["robot"].path, "log", 0.01, inside=lab.inside("robot"))
        eventually(lambda: len(Heard.of(listener).numbers) > 50)
        assert Heard.of(listener).in_order


def test_7_seamless_and_resilient_connectivity_to_network_dynamism(fleet: Fleet, tmp_path: Path) -> None:
    """A router dies, another takes over; no node starts again, and nothing is lost. (On the move: test_nat.)"""
    one, two = (f"quic/127.0.0.1:{free_port()}" for _ in range(2))
    for name in NODES:
        NetworkConfig((Endpoint.parse(one), Endpoint.parse(two))).save(fleet[name].path)
    with Programs(tmp_path) as programs:
        first = programs.start("route", fleet["router-1"].path, one)
        programs.start("route", fleet["router-2"].path, two, "--", one)
        with Node.open(fleet["server"].path) as server, Node.open(fleet["arm-1"].path) as arm:
            got = hear(server, "berkeley")
            eventually(lambda: arm.publisher("berkeley").send(b"-") or got, every=0.05)
            time.sleep(0.2)
            got.clear()
            for k in range(200):
                arm.publisher("berkeley").send(b"%d" % k)
                time.sleep(0.005)
                if k == 50:
                    first.kill()
            eventually(lambda: got == [b"%d" % k for k in range(200)])


def test_8_dds_agnostic_compatibility(fleet: Fleet, mesh: list[str], domains: Iterator[int]) -> None:
    """What crosses is ROS 2's serialization, byte for byte, of types this package has never heard of; not one DDS vendor's
    objects. (Fast DDS on one side, Cyclone DDS on the other: proxies/test_fastdds.)"""
    ros = pytest.importorskip("sgc.proxies.ros_ends", reason="needs the extra ros2")
    from tutelage.sgc.proxies import dds_raw
    from tutelage.sgc.proxies.ros2 import Ros2Proxy
    from tutelage.sgc.proxies.ros_qos import QosProfile
    from tutelage.sgc.proxies.routes import Routes, TopicRoute

    kind = "their_msgs/msg/Unheard"
    here, there = next(domains), next(domains)

    def routes(domain: int) -> Routes:
        return Routes((TopicRoute("chat", "/chatter", kind, True, True, QosProfile(depth=100), domain, queue=100),), ())

    with Node.open(fleet["arm-1"].path) as arm, Node.open(fleet["server"].path) as server:
        eventually(lambda: arm.connected and server.connected)
        with Ros2Proxy(arm, routes(here)), Ros2Proxy(server, routes(there)):
            writer = ros.RosNode(here).raw_publisher("/chatter", kind)
            reader = ros.RosNode(there).raw_subscription("/chatter", kind)
            eventually(lambda: writer.get_matched_subscriptions() and reader.get_matched_publications())
            sample = b"\0\1\0\0" + bytes(range(256))
            eventually(lambda: dds_raw.write(writer, sample) and dds_raw.take(reader), every=0.2)
            dds_raw.write(writer, sample)
            eventually(lambda: [s.data for s in dds_raw.take(reader)][:1] == [sample])


def test_9_compatibility_with_non_ros2_software(fleet: Fleet, mesh: list[str]) -> None:
    """A WebSocket client that speaks rosbridge's JSON, and nothing else, is answered by a service and hears a topic."""
    client = pytest.importorskip("websockets.sync.client", reason="needs the extra rosbridge")
    pytest.importorskip("rosbags", reason="needs the extra rosbridge")
    from tutelage.sgc.proxies.ros_types import RosTypes
    from tutelage.sgc.proxies.rosbridge import Bridge
    from tutelage.sgc.proxies.routes import Routes, TopicRoute

    with Node.open(fleet["arm-1"].path) as arm, Node.open(fleet["server"].path) as server:
        eventually(lambda: arm.connected and server.connected)
        chat = TopicRoute("chat", "/chatter", STRING, True, True)
        with Bridge(server, Routes((chat,), ()), RosTypes("jazzy"), port=0) as bridge:
            host, port = bridge.address
            with client.connect(f"ws://{host}:{port}", proxy=None) as socket:
                socket.send(json.dumps({"op": "subscribe", "topic": "/chatter", "type": STRING}))
                text = "hello"
                cdr = b"\0\1\0\0" + (len(text) + 1).to_bytes(4, "little") + text.encode() + b"\0"
                stop = threading.Event()
                speaker = threading.Thread(
                    target=lambda: [arm.publisher("chat").send(cdr) for _ in iter(lambda: stop.wait(0.1), True)]
                )
                speaker.start()
                try:
                    heard = json.loads(socket.recv(timeout=10))
                finally:
                    stop.set()
                    speaker.join()
    assert heard == {"op": "publish", "topic": "/chatter", "msg": {"data": "hello"}}


def test_10_efficient_message_processing_and_routing(fleet: Fleet, mesh: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The network is off the path of whoever sends: a network that takes nothing does not hold up `send`, memory stays
    bounded, and small messages that queue up share a packet and a proof."""
    with Node.open(fleet["server"].path) as server, Node.open(fleet["arm-1"].path) as arm:
        got = hear(server, "berkeley")
        state = arm.publisher("berkeley")
        eventually(lambda: state.send(b"-") or got, every=0.05)
        gate, publish, stuck = threading.Event(), arm.transport.publish, list[threading.Thread]()

        def closed(key: str, packet: bytes, *, reliable: bool = True) -> None:
            stuck.append(threading.current_thread())
            gate.wait(60.0)
            publish(key, packet, reliable=reliable)

        time.sleep(0.2)
        monkeypatch.setattr(arm.transport, "publish", closed)
        got.clear()
        packets = state.packets
        first = threading.Thread(target=state.send, args=(b"%d" % 0,))
        first.start()
        eventually(lambda: stuck and (first in stuck or not first.is_alive()))  # not the last sign of life
        with pytest.raises(Congested):
            for k in range(1, 2 * QUEUE_MESSAGES):
                state.send(b"%d" % k)
        assert not gate.is_set()  # all of these were sent while the network took nothing
        assert state.packets - packets <= 1
        assert state.queued == QUEUE_MESSAGES
        gate.set()
        eventually(lambda: len(got) >= QUEUE_MESSAGES)
        numbers = sorted(int(payload) for payload in got if payload != b"-")
        assert numbers == list(range(len(numbers)))
        assert state.packets - packets < 20
