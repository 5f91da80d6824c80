"""Ports for programs that listen on loopback, where nobody gave one."""

from __future__ import annotations

import secrets
import socket
from contextlib import ExitStack

_FIRST, _COUNT = 15_000, 17_000
"""Below those that systems give to outgoing connections, which could take one between our look and its use."""
_ATTEMPTS = 1000


def free_ports(count: int) -> list[int]:
    """Different ports of 127.0.0.1 that nobody uses now, neither over TCP nor over UDP.

    Raises:
        OSError: there are none.
    """
    found: list[int] = []
    with ExitStack() as stack:
        for _ in range(_ATTEMPTS):
            if len(found) == count:
                return found
            port = _FIRST + secrets.randbelow(_COUNT)
            try:
                for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
                    stack.enter_context(socket.socket(type=kind)).bind(("127.0.0.1", port))
            except OSError:
                continue
            found.append(port)
    raise OSError(f"no {count} ports of 127.0.0.1 are free")


def free_port() -> int:
    """One of them."""
    return free_ports(1)[0]
