"""Who is there, by name, among ten thousand names."""

from __future__ import annotations

import pytest
from sgc.fleets import eventually

from tutelage.sgc import directory as module
from tutelage.sgc.directory import Directory
from tutelage.sgc.names import Name
from tutelage.sgc.transport.memory import MemoryTransport, Network


def name(k: int) -> Name:
    return Name(k.to_bytes(32, "big"))


def test_names_that_are_followed_are_known_by_who_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "GRACE", 0.05)
    network = Network()
    arm, server = Directory(MemoryTransport(network)), Directory(MemoryTransport(network))
    came: list[str] = []
    server.subscribe(name(1), came.append)
    assert server.present(name(1)) == frozenset()
    with arm.publish(name(1), "ab"), arm.publish(name(2), "ab"):
        assert server.present(name(1)) == {"ab"}
        assert server.present(name(2)) == frozenset()  # not followed
        server.subscribe(name(1), came.append)  # a second listener learns who is there
        assert came == ["ab", "ab"]
    assert server.present(name(1)) == {"ab"}  # it may only be changing the router
    eventually(lambda: server.present(name(1)) == frozenset())


def test_somebody_who_comes_back_soon_was_never_gone() -> None:
    network = Network()
    arm, server = Directory(MemoryTransport(network)), Directory(MemoryTransport(network))
    server.subscribe(name(1))
    arm.publish(name(1), "ab").close()
    assert server.present(name(1)) == {"ab"}
    arm.publish(name(1), "ab")
    assert server.present(name(1)) == {"ab"}


def test_many_names() -> None:
    network = Network()
    arm, server = Directory(MemoryTransport(network)), Directory(MemoryTransport(network))
    for k in range(300):
        server.subscribe(name(k))
        arm.publish(name(k), "ab")
    assert len(server) == 300
    assert all(server.present(name(k)) == {"ab"} for k in range(300))
    server.close()
    assert len(server) == 0
