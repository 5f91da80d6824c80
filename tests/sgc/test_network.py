"""Nodes and routers over Zenoh, on loopback: real processes that are killed, certificates that are renewed, intruders."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

zenoh = pytest.importorskip("zenoh", reason="needs the extra sgc")

from sgc.fleets import Fleet, Heard, Programs, eventually, free_port, service, topic  # noqa: E402

from tutelage.sgc import lanes  # noqa: E402
from tutelage.sgc.home import Home  # noqa: E402
from tutelage.sgc.node import Node  # noqa: E402
from tutelage.sgc.router import Router, RouterConfig  # noqa: E402
from tutelage.sgc.transport.base import NoReply  # noqa: E402
from tutelage.sgc.transport.config import Endpoint, Identity, NetworkConfig  # noqa: E402
from tutelage.sgc.transport.zenoh import ZenohTransport  # noqa: E402

POLICY = topic("log", ["arm"], ["server"]) + topic("camera", ["arm"], ["server"]) + service("grasp", ["server"], ["arm"])
NODES, ROUTERS = ("arm", "server", "thief"), ("router-1", "router-2")


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return Fleet(tmp_path, POLICY, NODES, ROUTERS)


@pytest.fixture
def programs(tmp_path: Path) -> Iterator[Programs]:
    with Programs(tmp_path) as running:
        yield running


def address(protocol: str = "tls") -> str:
    return f"{protocol}/127.0.0.1:{free_port()}"


def point(fleet: Fleet, *routers: str) -> None:
    """Tell all nodes where the routers are."""
    for name in NODES:
        NetworkConfig(tuple(map(Endpoint.parse, routers))).save(fleet.homes[name].path)


def transport(home: Home, router: str) -> ZenohTransport:
    identity = Identity(home.root_file, home.leaf_file, home.key_file)
    return ZenohTransport(NetworkConfig((Endpoint.parse(router),)), identity)


# -- protocols ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", ["tls", "quic", "ws", "wss"])
def test_nodes_meet_through_a_router(fleet: Fleet, protocol: str) -> None:
    where = address(protocol)
    point(fleet, where)
    with (
        Router(fleet["router-1"], RouterConfig.of([where])) as router,
        Node.open(fleet["arm"].path) as arm,
        Node.open(fleet["server"].path) as server,
    ):
        got: list[bytes] = []
        server.subscribe("log", lambda message: got.append(message.payload))
        arm.publisher("log").send(b"hello")
        eventually(lambda: got == [b"hello"])
        arm.publisher("log").send(bytes(14 << 20))
        eventually(lambda: got[1:] == [bytes(14 << 20)])
        with server.serve("grasp", lambda asked: asked.payload[::-1]):
            assert arm.request("grasp", b"xyz", timeout=5.0) == b"zyx"
        assert [peer.name for peer in arm.peers()] == ["server"]
        assert {who for who, _ in router.links} == {arm.home.pseudonym, server.home.pseudonym}


def test_nodes_come_up_before_their_router(fleet: Fleet) -> None:
    where = address()
    point(fleet, where)
    with Node.open(fleet["arm"].path) as arm, Node.open(fleet["server"].path) as server:
        got: list[bytes] = []
        server.subscribe("log", lambda message: got.append(message.payload))
        arm.publisher("log").send(b"0")
        assert not arm.connected
        with Router(fleet["router-1"], RouterConfig.of([where])):
            eventually(lambda: arm.connected and server.connected)
            arm.publisher("log").send(b"1")
            eventually(lambda: got == [b"0", b"1"])


def test_a_router_can_read_neither_message_nor_topic(fleet: Fleet) -> None:
    where = address()
    point(fleet, where)
    with Router(fleet["router-1"], RouterConfig.of([where])) as router:
        seen: list[bytes] = []
        router._session.declare_subscriber("**", lambda s: seen.append(str(s.key_expr).encode() + s.payload.to_bytes()))
        with Node.open(fleet["arm"].path) as arm, Node.open(fleet["server"].path) as server:
            got: list[bytes] = []
            server.subscribe("log", lambda message: got.append(message.payload))
            arm.publisher("log").send(b"the secret of the arm")
            eventually(lambda: got == [b"the secret of the arm"])
        wire = b"".join(seen)
    assert len(wire) > 1000
    for word in (b"secret", b"arm", b"server", b"log", b"std_msgs", b"acme"):
        assert word not in wire


# -- routers that die ---------------------------------------------------------------------------------------------------------


def test_a_router_of_two_is_killed_and_nothing_is_lost(fleet: Fleet, programs: Programs) -> None:
    one, two = address(), address()
    point(fleet, one, two)
    first = programs.start("route", fleet["router-1"].path, one)
    programs.start("route", fleet["router-2"].path, two, "--", one)
    listener = programs.start("listen", fleet["server"].path, "log")
    programs.start("publish", fleet["arm"].path, "log", 0.01)
    eventually(lambda: len(Heard.of(listener).numbers) > 50)
    killed = time.monotonic()
    first.kill()
    eventually(lambda: len([t for t in Heard.of(listener).times if t > killed]) > 200)
    heard = Heard.of(listener)
    assert heard.in_order
    assert heard.lost == 0
    assert heard.gap(killed - 0.1) < 2.5


def test_the_only_router_is_killed_and_comes_back(fleet: Fleet, programs: Programs) -> None:
    where = address()
    point(fleet, where)
    router = programs.start("route", fleet["router-1"].path, where)
    listener = programs.start("listen", fleet["server"].path, "log")
    programs.start("publish", fleet["arm"].path, "log", 0.01)
    eventually(lambda: len(Heard.of(listener).numbers) > 50)
    router.kill()
    router.wait()
    time.sleep(0.5)
    programs.start("route", fleet["router-1"].path, where)
    back = time.monotonic()
    eventually(lambda: len([t for t in Heard.of(listener).times if t > back]) > 200)
    heard = Heard.of(listener)
    assert heard.in_order
    assert heard.lost == 0
    assert heard.gap(back) < 2.5


def test_a_killed_publisher_leaves_the_subscriber_ready_for_its_successor(fleet: Fleet, programs: Programs) -> None:
    where = address()
    point(fleet, where)
    programs.start("route", fleet["router-1"].path, where)
    listener = programs.start("listen", fleet["server"].path, "log")
    for _ in range(2):
        publisher = programs.start("publish", fleet["arm"].path, "log", 0.01)
        before = len(Heard.of(listener).numbers)
        eventually(lambda before=before: len(Heard.of(listener).numbers) > before + 50)
        publisher.kill()
        publisher.wait()
    numbers = Heard.of(listener).numbers
    again = numbers.index(0, 1)
    assert numbers[:again] == list(range(again))
    assert numbers[again:] == list(range(len(numbers) - again))


# -- access control ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", ["tls", "quic", "ws"])
def test_a_router_keeps_strangers_out_of_a_topic(fleet: Fleet, protocol: str) -> None:
    where = address(protocol)
    camera = fleet["arm"].access.entry("camera").name
    grasp = fleet["arm"].access.entry("grasp").name
    with (
        Router(fleet["router-1"], RouterConfig.of([where])),
        transport(fleet["arm"], where) as arm,
        transport(fleet["server"], where) as server,
        transport(fleet["thief"], where) as thief,
    ):
        heard: list[bytes] = []
        stolen: list[str] = []
        server.subscribe(lanes.key(camera, lanes.STREAM), heard.append)
        thief.subscribe(lanes.key(camera, lanes.STREAM), lambda packet: stolen.append("packet"))
        thief.watch(lanes.key(camera, lanes.HERE, "*"), lambda key, present: stolen.append(key))
        for pattern in ("**", "*/**", lanes.key(camera, "**")):
            thief._session.declare_subscriber(pattern, lambda sample: stolen.append(str(sample.key_expr)))
            thief._session.liveliness().declare_subscriber(
                pattern, lambda sample: stolen.append(str(sample.key_expr)), history=True
            )
        arm.announce(lanes.key(camera, lanes.HERE, fleet["arm"].pseudonym))
        arm.serve(lanes.key(camera, lanes.KEYS), lambda asked: b"key")
        server.serve(lanes.key(grasp, lanes.CALL), lambda asked: b"grasped")
        eventually(lambda: arm.publish(lanes.key(camera, lanes.STREAM), b"image") or heard)
        assert arm.request(lanes.key(grasp, lanes.CALL), b"", 5.0) == b"grasped"
        heard.clear()
        server.publish(lanes.key(camera, lanes.KEYS), b"not a lane to publish on")
        with transport(fleet["thief"], where) as forger:
            forger.publish(lanes.key(camera, lanes.STREAM), b"forged")
            for key in (lanes.key(camera, lanes.KEYS), lanes.key(grasp, lanes.CALL)):
                with pytest.raises(NoReply):
                    forger.request(key, b"", 0.3)
            assert [r for r in forger._session.liveliness().get("**", timeout=0.5) if r.ok is not None] == []
        arm.publish(lanes.key(camera, lanes.STREAM), b"last")
        eventually(lambda: heard[-1:] == [b"last"])
    assert set(heard) <= {b"image", b"last"}
    assert stolen == []


def test_a_node_cannot_pass_for_a_router_nor_come_without_certificate(fleet: Fleet, tmp_path: Path) -> None:
    where = address()
    other = Fleet(tmp_path / "other", POLICY, ["arm"])
    with Router(fleet["router-1"], RouterConfig.of([where])):
        with transport(other.homes["arm"], where) as stranger:
            assert not stranger.connected
        plain = ZenohTransport(NetworkConfig((Endpoint("tcp", "127.0.0.1", int(where.rpartition(":")[2])),)), None)
        assert not plain.connected
        plain.close()


def test_a_revoked_node_is_cut_off_by_the_router_while_it_runs(fleet: Fleet) -> None:
    where = address()
    point(fleet, where)
    with (
        Router(fleet["router-1"], RouterConfig.of([where])) as router,
        Node.open(fleet["arm"].path) as arm,
        Node.open(fleet["server"].path) as server,
    ):
        got: list[bytes] = []
        server.subscribe("log", lambda message: got.append(message.payload))
        arm.publisher("log").send(b"0")
        eventually(lambda: got == [b"0"])
        arm.home.accept(fleet.authority.revoke("server"))  # the arm passes it on to the router
        eventually(lambda: router.starts == 2)
        eventually(lambda: arm.connected)
        packets = server.subscriptions()[0].packets
        for _ in range(20):
            arm.publisher("log").send(b"1")
            time.sleep(0.01)
        time.sleep(0.3)
        assert server.subscriptions()[0].packets == packets  # not even sealed ones
        assert got == [b"0"]


# -- certificates ---------------------------------------------------------------------------------------------------------------


def test_a_certificate_is_renewed_while_messages_flow(fleet: Fleet, programs: Programs) -> None:
    where = address()
    point(fleet, where)
    programs.start("route", fleet["router-1"].path, where)
    listener = programs.start("listen", fleet["server"].path, "log")
    programs.start("publish", fleet["arm"].path, "log", 0.005)
    eventually(lambda: len(Heard.of(listener).numbers) > 50)
    renewed = time.monotonic()
    for name in ("arm", "server"):
        home = Home.open(fleet.homes[name].path)
        home.accept(fleet.authority.renew(home.request()))
    eventually(lambda: len([t for t in Heard.of(listener).times if t > renewed + 2.0]) > 100)
    heard = Heard.of(listener)
    assert heard.in_order
    assert heard.lost == 0
    assert heard.gap(renewed) < 2.5
