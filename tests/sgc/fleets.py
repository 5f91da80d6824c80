"""Policies, routers and patience for the tests of the network."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from members import Fleet

from tutelage.sgc.rules import Role


def topic(alias: str, publish: Iterable[str], subscribe: Iterable[str], **fields: object) -> str:
    """A table of the policy; the first publisher owns the topic."""
    publish = list(publish)
    content = {
        "node": publish[0],
        "interface": f"/{alias}",
        "type": "std_msgs/msg/String",
        "owner": publish[0],
        "publish": publish,
        "subscribe": list(subscribe),
    }
    return table(alias, content | fields)


def service(alias: str, serve: Iterable[str], request: Iterable[str], **fields: object) -> str:
    """A table of the policy for a service; the first server owns it."""
    serve = list(serve)
    content = {
        "node": serve[0],
        "interface": f"/{alias}",
        "type": "std_srvs/srv/Trigger",
        "owner": serve[0],
        "kind": "service",
        "serve": serve,
        "request": list(request),
    }
    return table(alias, content | fields)


def table(alias: str, content: dict[str, object]) -> str:
    """As TOML."""
    lines = [
        f"{name} = {str(value).replace(chr(39), chr(34)) if isinstance(value, list) else _text(value)}"
        for name, value in content.items()
    ]
    return "\n".join(["", f"[topics.{alias}]", *lines, ""])


def _text(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)


def make_fleet(folder: Path, policy: str, nodes: Iterable[str], routers: Iterable[str] = ()) -> Fleet:
    """A fleet whose keys are still to be handed out."""
    text = policy if "version = 1" in policy else f"version = 1\n{policy}"
    fleet = Fleet(folder, nodes, text, share=False)
    for name in routers:
        fleet.join(name, Role.ROUTER)
    fleet.publish(text)
    return fleet


def free_port() -> int:
    """A TCP port of loopback that nobody uses, and no other test of this run is given."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def eventually(condition: Callable[[], object], timeout: float = 10.0, every: float = 0.005) -> None:
    """Wait until the condition holds, or fail."""
    until = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < until, "it did not happen in time"
        time.sleep(every)
