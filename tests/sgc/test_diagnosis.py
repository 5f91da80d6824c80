"""A node that hears nothing says why, once, and what helps."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
from sgc.fleets import Fleet, eventually, free_port, topic

from tutelage.sgc import diagnosis
from tutelage.sgc.access import Kind, Route
from tutelage.sgc.health import node_health
from tutelage.sgc.names import Name
from tutelage.sgc.node import Node
from tutelage.sgc.router import Router, RouterConfig
from tutelage.sgc.rules import Role
from tutelage.sgc.transport.config import Endpoint, NetworkConfig
from tutelage.sgc.transport.memory import MemoryTransport, Network

POLICY = topic("camera", ["arm"], ["server"])


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosis, "PATIENCE", 0.2)
    monkeypatch.setattr(diagnosis, "AGAIN", 0.1)
    monkeypatch.setattr(diagnosis, "_TIMEOUT", 0.5)


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return Fleet(tmp_path, POLICY, ["arm", "server"], ["router"])


@pytest.fixture
def router(fleet: Fleet) -> Iterator[Router]:
    pytest.importorskip("zenoh", reason="needs the extra sgc")
    where = f"tls/127.0.0.1:{free_port()}"
    for name in ("arm", "server"):
        NetworkConfig((Endpoint.parse(where),)).save(fleet[name].path)
    with Router(fleet["router"], RouterConfig.of([where])) as running:
        yield running


def said(caplog: pytest.LogCaptureFixture, text: str) -> int:
    return sum(text in record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING)


def test_a_node_without_a_router_says_so_once_and_is_unwell(fleet: Fleet, caplog: pytest.LogCaptureFixture) -> None:
    network = Network()
    network.up = False
    with Node.open(fleet["server"], MemoryTransport(network)) as server:
        eventually(lambda: said(caplog, "server reaches none of the routers of its network.toml"))
        assert any("reaches none" in problem for problem in node_health(server)["problems"])
        server.diagnosis.look()
        assert said(caplog, "reaches none") == 1


def test_a_silent_owner_is_named_and_its_return_is_told(fleet: Fleet, caplog: pytest.LogCaptureFixture) -> None:
    network = Network()
    with Node.open(fleet["server"], MemoryTransport(network)) as server:
        eventually(lambda: said(caplog, "server has no key of camera, as arm, who owns it, does not answer"))
        with Node.open(fleet["arm"], MemoryTransport(network)):
            eventually(lambda: said(caplog, "server: all is well again"))
        assert not server.diagnosis.problems()


def test_a_router_that_does_not_know_a_node_is_told_of(
    fleet: Fleet, router: Router, caplog: pytest.LogCaptureFixture
) -> None:
    late = fleet.join("late", Role.NODE)  # issued, and nobody carried the router's new bundle to it
    late.accept(fleet.authority.issue(late.request()))
    NetworkConfig((router.config.listen[0],)).save(late.path)
    with Node.open(late):
        eventually(lambda: said(caplog, "late is connected to a router that does not let it speak, as it does not know it"))


def test_a_router_with_an_older_policy_is_told_of(fleet: Fleet, router: Router, caplog: pytest.LogCaptureFixture) -> None:
    (fleet.authority.path / "policy.toml").write_text("version = 1\n" + POLICY + topic("log", ["arm"], ["server"]))
    bundles = fleet.authority.publish()
    fleet["server"].accept(bundles["server"])
    with Node.open(fleet["server"].path) as server:
        eventually(lambda: said(caplog, "the router of server has an older policy, without its part in log"))
        fleet["router"].accept(bundles["router"])
        eventually(lambda: not any("older policy" in problem for problem in server.diagnosis.problems()), 20.0)


def test_a_router_tells_nothing_about_what_the_asker_does_not_name() -> None:
    name, other = Name(bytes(32)), Name(b"\1" * 32)
    routes = [Route(name, Kind.STREAM, "o" * 32, frozenset({"a" * 32}), frozenset())]
    assert diagnosis.answer(b"a" * 32 + bytes(name) + bytes(other), routes) == b"\1\0"
    assert diagnosis.answer(b"b" * 32 + bytes(name), routes) == b"\0"
    assert diagnosis.answer(b"a" * 32, routes) == b""
    for junk in (b"", b"a" * 31, b"a" * 40, b"\xff" * 63, b"a" * 32 + bytes(32 * 5000)):
        assert diagnosis.answer(junk, routes) is None
