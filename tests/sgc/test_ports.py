"""Ports that nobody else uses."""

from __future__ import annotations

import socket

import pytest

from tutelage.sgc import ports


def test_ports_are_free_different_and_not_those_of_outgoing_connections() -> None:
    found = ports.free_ports(20)
    assert len(set(found)) == 20
    assert max(found) < 32_768  # where Linux begins with the ports of outgoing connections
    for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
        with socket.socket(type=kind) as taken:
            taken.bind(("127.0.0.1", found[0]))


def test_a_port_in_use_is_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        monkeypatch.setattr(ports, "_FIRST", taken.getsockname()[1])
        monkeypatch.setattr(ports, "_COUNT", 1)
        with pytest.raises(OSError, match=r"no 1 ports of 127\.0\.0\.1 are free"):
            ports.free_ports(1)
