"""What a node or router counts, as a tree, as Prometheus text, and over HTTP: `/healthz` and `/metrics` on loopback.

`/healthz` answers 200 while the node is connected to a router, holds its topics' keys, and its certificate is valid for
another five minutes; else 503. The body says why, in JSON.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from tutelage.errors import ConfigError

if TYPE_CHECKING:
    from tutelage.sgc.node import Node
    from tutelage.sgc.router import Router

Tree = dict[str, Any]

EXPIRES_SOON = 300.0
"""Seconds before the end of its certificate from which a node calls itself unhealthy."""


def counters(node: Node) -> Tree:
    """Everything that a node counts. Leaves are numbers; times in seconds, sizes in bytes."""
    topics: Tree = {}
    for alias, publisher in node.publishers().items():
        topics.setdefault(alias, {})["publisher"] = {
            "sent": publisher.sent,
            "packets": publisher.packets,
            "bytes": publisher.bytes,
            "queued": publisher.queued,
            "congested": publisher.congested,
            "superseded": publisher.superseded,
            "replayed": publisher.answered,
            "refused": {**publisher.refusals.as_dict()},
        }
    for subscription in node.subscriptions():
        tally = subscription.delivery.tally
        mine = {
            "received": subscription.received,
            "packets": subscription.packets,
            "bytes": subscription.bytes,
            "queued": subscription.queued,
            "lost": tally.lost,
            "gaps": tally.gaps,
            "late": tally.late,
            "repaired": subscription.repaired,
            "deferred": subscription.deferred,
            "superseded": subscription.superseded,
            "failed": subscription.failed,
            "refused": subscription.opener.refusals.as_dict(),
            "latency": dict(subscription.latency),
        }
        before = topics.setdefault(subscription.alias, {}).get("subscriber")
        topics[subscription.alias]["subscriber"] = mine if before is None else _sum(before, mine)
    for alias, requester in node.requesters().items():
        topics.setdefault(alias, {})["requester"] = {
            "sent": requester.sent,
            "failed": requester.failed,
            "unanswered": requester.unanswered,
            "refused": requester.opener.refusals.as_dict(),
        }
    for alias, server in node.servers().items():
        topics.setdefault(alias, {})["server"] = {
            "received": server.received,
            "failed": server.failed,
            "refused": server.opener.refusals.as_dict(),
        }
    return {
        "connected": int(node.connected),
        "certificate_expires_in": node.home.expires - time.time(),
        "refused": {**node.refusals.as_dict(), **node.keyring.refusals.as_dict()},
        "topics": topics,
    }


def node_health(node: Node) -> Tree:
    """Is a node well, and if not, why? `ok` is True or False."""
    left = node.home.expires - time.time()
    problems = []
    if not node.connected:
        problems.append("not connected to a router")
    if left < EXPIRES_SOON:
        problems.append(f"the certificate ends in {left:.0f} s" if left > 0 else "the certificate has expired")
    wanted = node.keyring.wanted()
    missing = [alias for alias in wanted if node.keyring.epoch(alias) is None]
    if missing:
        problems.append(f"no key yet of: {', '.join(missing)}")
    return {"ok": not problems, "node": node.name, "problems": problems, "certificate_expires_in": left}


def router_health(router: Router) -> Tree:
    """Is a router well, and if not, why? `ok` is True or False."""
    left = router.home.expires - time.time()
    problems = [] if router.running else ["it does not listen"]
    if left < EXPIRES_SOON:
        problems.append(f"the certificate ends in {left:.0f} s" if left > 0 else "the certificate has expired")
    return {"ok": not problems, "router": router.home.name, "problems": problems, "certificate_expires_in": left}


def router_counters(router: Router) -> Tree:
    """What a router counts."""
    links = router.links
    return {
        "connected_nodes": sum(not is_router for _, is_router in links),
        "connected_routers": sum(is_router for _, is_router in links),
        "starts": router.starts,
        "certificate_expires_in": router.home.expires - time.time(),
        "refused": router.refusals.as_dict(),
    }


_LABELS = {"topics": "topic", "refused": "reason", "latency": "sender"}


def prometheus(tree: Tree, prefix: str = "tutelage_sgc") -> str:
    """Counters in Prometheus' text format, version 0.0.4: a path in the tree is a name, keys that vary become labels."""
    lines = [f"{name}{labels} {value:.9g}" for name, labels, value in _flatten(tree, prefix, {})]
    return "\n".join(sorted(lines)) + "\n"


def _flatten(tree: Tree, name: str, labels: dict[str, str]) -> Iterator[tuple[str, str, float]]:
    for key, value in tree.items():
        if key in _LABELS and isinstance(value, dict):
            for each, below in value.items():
                deeper = {**labels, _LABELS[key]: each}
                inner = below if isinstance(below, dict) else {key: below}
                yield from _flatten(inner, name, deeper)
        elif isinstance(value, dict):
            yield from _flatten(value, f"{name}_{key}", labels)
        else:
            yield f"{name}_{key}", _text(labels), float(value)


def _text(labels: dict[str, str]) -> str:
    escaped = (
        f'{name}="{value.translate({92: chr(92) * 2, 34: chr(92) + chr(34), 10: chr(92) + "n"})}"'
        for name, value in labels.items()
    )
    return "{" + ",".join(escaped) + "}" if labels else ""


def _sum(a: Tree, b: Tree) -> Tree:
    """Two subscriptions of one topic as one."""
    total = dict(a)
    for key, value in b.items():
        both = isinstance(value, dict) and isinstance(total.get(key), dict)
        total[key] = _sum(total[key], value) if both else value if key not in total else total[key] + value
    return total


class HealthServer:
    """Serves `/healthz` and `/metrics`."""

    def __init__(self, address: str, health: Callable[[], Tree], metrics: Callable[[], Tree]) -> None:
        """
        Args:
            address: HOST:PORT; loopback unless somebody else is meant to see how many messages go where.

        Raises:
            ConfigError: the address is impossible or in use.
        """
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit() or int(port) > 65535:
            raise ConfigError(f"{address!r} is no address to serve health on; write HOST:PORT, such as 127.0.0.1:9090")

        class Handler(BaseHTTPRequestHandler):
            timeout = 5.0

            def do_GET(self) -> None:
                path = self.path.partition("?")[0]
                if path == "/healthz":
                    state = health()
                    self._answer(200 if state["ok"] else 503, "application/json", json.dumps(state) + "\n")
                elif path == "/metrics":
                    self._answer(200, "text/plain; version=0.0.4; charset=utf-8", prometheus(metrics()))
                else:
                    self._answer(404, "text/plain; charset=utf-8", "there are /healthz and /metrics\n")

            def _answer(self, code: int, kind: str, text: str) -> None:
                body = text.encode()
                self.send_response(code)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: Any) -> None:
                return

        try:
            self._server = ThreadingHTTPServer((host.strip("[]"), int(port)), Handler)
        except OSError as error:
            raise ConfigError(f"cannot serve health on {address}: {error.strerror}") from None
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.2,), name="sgc-health", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop."""
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
