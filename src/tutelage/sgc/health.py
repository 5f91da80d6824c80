"""What a node or router counts, as a tree and as Prometheus text, and whether it is well. Over HTTP: `health_server`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

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
            "received": subscription.outlet.received,
            "packets": subscription.packets,
            "bytes": subscription.outlet.bytes,
            "queued": subscription.queued,
            "lost": tally.lost,
            "gaps": tally.gaps,
            "late": tally.late,
            "repaired": subscription.repaired,
            "deferred": subscription.deferred,
            "superseded": subscription.outlet.superseded,
            "failed": subscription.outlet.failed,
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
    if missing := node.lacking():
        problems.append(f"no key yet of: {', '.join(missing)}")
    problems += node.diagnosis.problems()
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
