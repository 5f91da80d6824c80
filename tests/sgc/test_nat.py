"""Behind address translation on both sides, and on the move: in network namespaces, where root is available."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sgc import netlab
from sgc.fleets import Fleet, Heard, Programs, eventually, topic

from tutelage.sgc.rules import Role
from tutelage.sgc.transport.config import Endpoint, NetworkConfig

pytest.importorskip("zenoh", reason="needs the extra sgc")
pytestmark = pytest.mark.skipif(bool(netlab.why_not()), reason=netlab.why_not() or "-")

POLICY = topic("log", ["robot"], ["server"]) + topic("command", ["server"], ["robot"])


TRIES = 3
"""A gap is measured by the clock of a machine that may be busy with something else; what is promised must be seen once."""


@contextmanager
def world(folder: Path, protocol: str) -> Iterator[tuple[netlab.Lab, Fleet, Programs]]:
    """A router in the open, which robot and server dial."""
    fleet = Fleet(folder, POLICY, ["robot", "server"])
    fleet.join("router", Role.ROUTER, addresses=(netlab.ROUTER,))
    fleet.publish((folder / "authority" / "policy.toml").read_text())
    for name in ("robot", "server"):
        NetworkConfig((Endpoint.parse(f"{protocol}/{netlab.ROUTER}:7447"),)).save(fleet.homes[name].path)
    with netlab.Lab() as lab, Programs(folder) as programs:
        programs.start("route", fleet["router"].path, f"{protocol}/0.0.0.0:7447", inside=lab.inside("router"))
        yield lab, fleet, programs


@pytest.mark.parametrize("protocol", ["tls", "quic", "wss"])
def test_both_sides_behind_translation_reach_each_other(tmp_path: Path, protocol: str) -> None:
    with world(tmp_path, protocol) as (lab, fleet, programs):
        at_server = programs.start("listen", fleet["server"].path, "log", inside=lab.inside("server"))
        at_robot = programs.start("listen", fleet["robot"].path, "command", inside=lab.inside("robot"))
        programs.start("publish", fleet["robot"].path, "log", 0.01, inside=lab.inside("robot"))
        programs.start("publish", fleet["server"].path, "command", 0.01, inside=lab.inside("server"))
        for listener in (at_server, at_robot):
            eventually(lambda listener=listener: len(Heard.of(listener).numbers) > 50)
            assert Heard.of(listener).in_order


@pytest.mark.parametrize(("protocol", "limit"), [("tls", 2.5), ("quic", 0.5)])
def test_a_robot_that_moves_to_another_address_is_missed_only_for_a_moment(
    tmp_path: Path, protocol: str, limit: float
) -> None:
    gaps: list[float] = []
    while not gaps or (gaps[-1] >= limit and len(gaps) < TRIES):
        gaps.append(gap_when_moved(tmp_path / str(len(gaps)), protocol, limit))
    print(f"gaps {', '.join(f'{gap:.2f}' for gap in gaps)} s")
    assert min(gaps) < limit


def gap_when_moved(folder: Path, protocol: str, limit: float) -> float:
    """The longest silence of a robot that moves, in seconds; nothing may be lost or reordered."""
    folder.mkdir()
    with world(folder, protocol) as (lab, fleet, programs):
        listener = programs.start("listen", fleet["server"].path, "log", inside=lab.inside("server"))
        programs.start("publish", fleet["robot"].path, "log", 0.01, inside=lab.inside("robot"))
        eventually(lambda: len(Heard.of(listener).numbers) > 100)
        moved = time.monotonic()
        lab.move_robot()
        eventually(lambda: len([t for t in Heard.of(listener).times if t > moved + limit]) > 100, timeout=20.0)
        heard = Heard.of(listener)
    assert heard.in_order
    assert heard.lost == 0
    return heard.gap(moved - 0.1)
