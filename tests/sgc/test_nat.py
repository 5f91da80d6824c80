"""Behind address translation on both sides, and on the move: in network namespaces, where root is available."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from sgc import netlab
from sgc.fleets import Fleet, Heard, Programs, eventually, topic

from tutelage.sgc.rules import Role
from tutelage.sgc.transport.config import Endpoint, NetworkConfig

pytest.importorskip("zenoh", reason="needs the extra sgc")
pytestmark = pytest.mark.skipif(bool(netlab.why_not()), reason=netlab.why_not() or "-")

POLICY = topic("log", ["robot"], ["server"]) + topic("command", ["server"], ["robot"])


@pytest.fixture
def lab() -> Iterator[netlab.Lab]:
    with netlab.Lab() as built:
        yield built


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    made = Fleet(tmp_path, POLICY, ["robot", "server"])
    made.join("router", Role.ROUTER, addresses=(netlab.ROUTER,))
    made.publish((tmp_path / "authority" / "policy.toml").read_text())
    return made


@pytest.fixture
def programs(tmp_path: Path) -> Iterator[Programs]:
    with Programs(tmp_path) as running:
        yield running


def start(lab: netlab.Lab, fleet: Fleet, programs: Programs, protocol: str) -> None:
    """A router in the open, which robot and server dial."""
    for name in ("robot", "server"):
        NetworkConfig((Endpoint.parse(f"{protocol}/{netlab.ROUTER}:7447"),)).save(fleet.homes[name].path)
    where = f"{protocol}/0.0.0.0:7447"
    programs.start("route", fleet["router"].path, where, inside=lab.inside("router"))


@pytest.mark.parametrize("protocol", ["tls", "quic", "wss"])
def test_both_sides_behind_translation_reach_each_other(
    lab: netlab.Lab, fleet: Fleet, programs: Programs, protocol: str
) -> None:
    start(lab, fleet, programs, protocol)
    at_server = programs.start("listen", fleet["server"].path, "log", inside=lab.inside("server"))
    at_robot = programs.start("listen", fleet["robot"].path, "command", inside=lab.inside("robot"))
    programs.start("publish", fleet["robot"].path, "log", 0.01, inside=lab.inside("robot"))
    programs.start("publish", fleet["server"].path, "command", 0.01, inside=lab.inside("server"))
    for listener in (at_server, at_robot):
        eventually(lambda listener=listener: len(Heard.of(listener).numbers) > 50)
        assert Heard.of(listener).in_order


@pytest.mark.parametrize(("protocol", "limit"), [("tls", 2.5), ("quic", 0.5)])
def test_a_robot_that_moves_to_another_address_is_missed_only_for_a_moment(
    lab: netlab.Lab, fleet: Fleet, programs: Programs, protocol: str, limit: float
) -> None:
    start(lab, fleet, programs, protocol)
    listener = programs.start("listen", fleet["server"].path, "log", inside=lab.inside("server"))
    programs.start("publish", fleet["robot"].path, "log", 0.01, inside=lab.inside("robot"))
    eventually(lambda: len(Heard.of(listener).numbers) > 100)
    moved = time.monotonic()
    lab.move_robot()
    eventually(lambda: len([t for t in Heard.of(listener).times if t > moved + 4.0]) > 100, timeout=20.0)
    heard = Heard.of(listener)
    assert heard.in_order  # nothing lost, nothing reordered
    assert heard.lost == 0
    print(f"gap {heard.gap(moved - 0.1):.2f} s")
    assert heard.gap(moved - 0.1) < limit
