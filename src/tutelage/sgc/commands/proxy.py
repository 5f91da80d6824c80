"""ROS 2, rosbridge and gRPC on the fleet's topics: ros2, rosbridge, grpc, proto, topics."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from tyro.conf import Positional

from tutelage.errors import ConfigError

if TYPE_CHECKING:
    from tutelage.sgc.node import Node
    from tutelage.sgc.proxies.listen import Tls
    from tutelage.sgc.proxies.routes import Routes


MAX_SECONDS = 86400.0
"""To listen to discovery."""


class _Proxy(Protocol):
    def counters(self) -> dict[str, Any]: ...


def ros2(home: Positional[Path], routes: Positional[Path], health: str | None = None) -> None:
    """Carry the listed topics, services and actions between ROS 2 (DDS domains) and the fleet, with no change to any node.

    Args:
        home: the node's folder (tutelage keys).
        routes: the list, a TOML file; see the documentation. What is not listed stays on its domain.
        health: HOST:PORT at which to serve /healthz and /metrics; without it, neither is served.
    """
    from tutelage.sgc.proxies.ros2 import Ros2Proxy
    from tutelage.sgc.proxies.routes import load_routes

    with _node(home) as node:
        listed = load_routes(routes, node.access)
        with Ros2Proxy(node, listed) as proxy:
            domains = sorted({route.domain for route in listed.topics} | {route.domain for route in listed.services})
            where = f"DDS domain{'s' if len(domains) > 1 else ''} {', '.join(map(str, domains))}"
            _run(node, proxy, f"{_size(listed)} between {where} and the fleet", health)


def rosbridge(
    home: Positional[Path],
    listen: str = "127.0.0.1:9090",
    routes: Path | None = None,
    types: tuple[Path, ...] = (),
    origins: tuple[str, ...] = (),
    token_file: Path | None = None,
    certificate: Path | None = None,
    key: Path | None = None,
    clients: Path | None = None,
    health: str | None = None,
) -> None:
    """Let roslibpy, roslibjs and web pages use the fleet's topics, by the rosbridge protocol over WebSocket.

    Args:
        home: the node's folder (tutelage keys).
        listen: HOST:PORT; beyond this machine it needs TLS, and a token or client certificates.
        routes: which topics and services, and under which names (TOML); default: all of the node's, by the policy's names.
        types: folders of .msg and .srv files, laid out as <package>/msg/*.msg, for types that are not standard; none: the
            standard types, and those of the ROS 2 installation in AMENT_PREFIX_PATH.
        origins: pages, such as https://operators.example, whose scripts may connect; those of this machine always may, and
            without origins only those.
        token_file: clients must bring this file's content, as "Authorization: Bearer ..." or "?token=..."; without it they
            need none.
        certificate: PEM, for TLS (wss://); without it, plain WebSocket, on loopback only.
        key: PEM, the certificate's; needed with it.
        clients: PEM, an authority; clients must have a certificate of it. Without it they need none.
        health: HOST:PORT at which to serve /healthz and /metrics; without it, neither is served.
    """
    from tutelage.sgc.proxies.listen import parse_address, read_token
    from tutelage.sgc.proxies.ros_types import RosTypes
    from tutelage.sgc.proxies.rosbridge import Bridge
    from tutelage.sgc.proxies.routes import all_routes, load_routes

    host, port = parse_address(listen)
    token, tls = read_token(token_file) if token_file else None, _tls(certificate, key, clients)
    with _node(home) as node:
        listed = load_routes(routes, node.access) if routes else all_routes(node.access)
        known = RosTypes(listed.distribution, types)
        with Bridge(node, listed, known, host=host, port=port, token=token, origins=origins, tls=tls) as bridge:
            host, port = bridge.address
            _run(node, bridge, f"{_size(listed)} at {'wss' if tls else 'ws'}://{host}:{port}", health)


def grpc(
    home: Positional[Path],
    listen: str = "127.0.0.1:50051",
    token_file: Path | None = None,
    certificate: Path | None = None,
    key: Path | None = None,
    clients: Path | None = None,
    health: str | None = None,
) -> None:
    """Let programs in any language use the fleet's topics, by gRPC; `tutelage proxy proto` prints the interface.

    Args:
        home: the node's folder (tutelage keys).
        listen: HOST:PORT or unix:PATH; beyond this machine it needs TLS, and a token or client certificates.
        token_file: clients must bring this file's content in the metadata, as "authorization: Bearer ..."; without it they
            need none.
        certificate: PEM, for TLS; without it, plain text, on this machine only. Not the node's own: gRPC's library does not
            take Ed25519.
        key: PEM, the certificate's; needed with it.
        clients: PEM, an authority; clients must have a certificate of it. Without it they need none.
        health: HOST:PORT at which to serve /healthz and /metrics; without it, neither is served.
    """
    from tutelage.sgc.proxies.grpc import Gateway
    from tutelage.sgc.proxies.listen import read_token

    token, tls = read_token(token_file) if token_file else None, _tls(certificate, key, clients)
    with _node(home) as node, Gateway(node, listen=listen, token=token, tls=tls) as gateway:
        _run(node, gateway, f"{len(node.access.topics)} topics and services at {gateway.address}", health)


def proto() -> None:
    """Print tutelage.proto, the interface of the gRPC gateway, for your language's compiler."""
    from importlib import resources

    print((resources.files("tutelage.sgc.proxies") / "tutelage.proto").read_text(encoding="utf-8"), end="")


def topics(domain: int = 0, seconds: float = 3.0) -> None:
    """What there is on a DDS domain: topics and services of ROS 2, to write a list of routes from.

    Args:
        domain: ROS_DOMAIN_ID.
        seconds: how long to listen.
    """
    from tutelage.sgc.proxies.dds_discovery import discover
    from tutelage.sgc.proxies.dds_domain import Domain
    from tutelage.sgc.proxies.routes import MAX_DOMAIN

    if not 0 <= domain <= MAX_DOMAIN:
        raise ConfigError(f"DDS domains go from 0 to {MAX_DOMAIN}, not {domain}")
    if not 0 <= seconds <= MAX_SECONDS:
        raise ConfigError(f"one can listen for 0 to {MAX_SECONDS:g} seconds, not {seconds:g}")
    with Domain(domain) as joined:
        found = discover(joined, seconds)
    if not found:
        print(f"nothing of ROS 2 was seen on domain {domain} within {seconds:g} s")
    for entry in found:
        ends = "clients, servers" if entry.service else "publishers, subscriptions"
        counts = f"{entry.writers} / {entry.readers} {ends}"
        print("  ".join(["service" if entry.service else "topic", entry.name, entry.type, counts, *sorted(entry.qos)]))


VERBS: dict[str, Callable[..., None]] = {
    "ros2": ros2,
    "rosbridge": rosbridge,
    "grpc": grpc,
    "proto": proto,
    "topics": topics,
}


def _node(home: Path) -> Node:
    from tutelage.sgc.node import Node

    return Node.open(home)


def _tls(certificate: Path | None, key: Path | None, clients: Path | None) -> Tls | None:
    from tutelage.sgc.proxies.listen import Tls

    if certificate is None and key is None and clients is None:
        return None
    if certificate is None or key is None:
        raise ConfigError("TLS needs both --certificate and --key")
    return Tls(certificate, key, clients)


def _size(routes: Routes) -> str:
    def count(number: int, what: str) -> str:
        return f"{number} {what}{'' if number == 1 else 's'}"

    return f"{count(len(routes.topics), 'topic')} and {count(len(routes.services), 'service')}"


def _run(node: Node, proxy: _Proxy, what: str, health: str | None) -> None:
    """Say what runs, then wait for Ctrl-C or SIGTERM."""
    from tutelage.sgc.commands.stopping import until_stopped
    from tutelage.sgc.health import node_health
    from tutelage.sgc.health_server import HealthServer

    with contextlib.ExitStack() as stack:
        if health is not None:
            stack.enter_context(
                HealthServer(health, lambda: node_health(node), lambda: {**node.counters(), "proxy": proxy.counters()})
            )
        stop = stack.enter_context(until_stopped())
        print(f"{node.name}: {what}; Ctrl-C ends it", flush=True)
        stop.wait()
