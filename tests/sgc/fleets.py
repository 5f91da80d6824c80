"""A fleet for tests: an authority, homes with certificates, and routers on loopback. All keys are real."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from tutelage.sgc.access import Role
from tutelage.sgc.authority import Authority
from tutelage.sgc.home import Home

CAMERA = """
version = 1

[topics.camera]
node = "drone"
interface = "/camera"
type = "sensor_msgs/msg/Image"
owner = "drone"
publish = ["drone"]
subscribe = ["server", "operator-*"]
"""


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


class Fleet:
    """An authority in a folder, and the homes that it has issued."""

    def __init__(self, folder: Path, policy: str, nodes: Iterable[str], routers: Iterable[str] = ()) -> None:
        self.folder = folder
        self.authority = Authority.create(folder / "authority", "acme")
        self.homes: dict[str, Home] = {}
        for name in routers:
            self.join(name, Role.ROUTER)
        for name in nodes:
            self.join(name)
        self.publish(policy)

    def join(self, name: str, role: Role = Role.NODE) -> Home:
        """A new member."""
        addresses = ["127.0.0.1", "localhost"] if role == Role.ROUTER else []
        home = self.homes[name] = Home.create(self.folder / name, name, role=role, addresses=addresses)
        home.accept(self.authority.issue(home.request()))
        return home

    def publish(self, policy: str) -> None:
        """A new policy, carried to all members."""
        text = policy if "version = 1" in policy else f"version = 1\n{policy}"
        (self.authority.path / "policy.toml").write_text(text)
        for name, bundle in self.authority.publish().items():
            self.homes[name].accept(bundle)

    def __getitem__(self, name: str) -> Home:
        return self.homes[name]


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
