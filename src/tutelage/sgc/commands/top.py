"""The verb `tutelage top`."""

from __future__ import annotations

import contextlib
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from tyro.conf import Positional

from tutelage.errors import ConfigError

if TYPE_CHECKING:
    from tutelage.sgc.messages import Message
    from tutelage.sgc.node import Node
    from tutelage.sgc.subscription import Subscription


MAX_SECONDS = 3600.0
"""Between two looks."""


@dataclass
class Heard:
    """Of one sender on one topic, since the last look."""

    messages: int = 0
    bytes: int = 0
    latency: float = 0.0  # seconds, of the newest message


def top(
    home: Positional[Path],
    topics: tuple[str, ...] = (),
    interval: float = 1.0,
    count: int = 0,
) -> None:
    """Who is there, and what they send: rates, latency, losses. Subscribes to the topics, so it sees what a subscriber sees.

    Args:
        home: the folder of a node that may subscribe, such as an operator's own.
        topics: aliases; default: all streams to which the node may subscribe.
        interval: seconds between two looks.
        count: looks before it ends; 0: until Ctrl-C.
    """
    from tutelage.sgc.access import Kind
    from tutelage.sgc.commands.stopping import until_stopped
    from tutelage.sgc.node import Node

    if not 0 < interval <= MAX_SECONDS or count < 0:
        raise ConfigError(f"top needs an interval of more than 0 and at most {MAX_SECONDS:g} s, and a count of at least 0")
    console = Console(markup=False, width=None if sys.stdout.isatty() else 160)
    with contextlib.ExitStack() as stack:
        node = stack.enter_context(Node.open(home))
        rules = {alias: entry.rule for alias, entry in node.access.topics.items()}
        chosen = topics or [a for a, rule in rules.items() if rule.kind == Kind.STREAM and rule.may_receive(node.name)]
        heard: dict[tuple[str, str], Heard] = defaultdict(Heard)
        subscriptions = [stack.enter_context(node.subscribe(alias, _count(heard))) for alias in chosen]
        stop = stack.enter_context(until_stopped())
        live = stack.enter_context(Live(console=console, auto_refresh=False)) if sys.stdout.isatty() else None
        looks, before = 0, time.monotonic()
        while not stop.wait(interval) and (looks := looks + 1):
            now = time.monotonic()
            state = "connected" if node.connected else "not connected to a router"
            page = Group(f"{node.name}: {state}", _nodes(node), _topics(subscriptions, heard, now - before))
            before = now
            if live is not None:
                live.update(page, refresh=True)
            else:
                console.print(page)
            if looks == count:
                return


def _count(heard: dict[tuple[str, str], Heard]) -> Callable[[Message], None]:
    def count(message: Message) -> None:
        entry = heard[message.topic, message.sender]
        entry.messages += 1
        entry.bytes += len(message.payload)
        entry.latency = message.latency

    return count


def _nodes(node: Node) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    for head in ("node", "round trip", "shared topics"):
        table.add_column(head, justify="right" if head == "round trip" else "left")
    for peer in node.peers(0.3):
        table.add_row(peer.name, f"{1000 * peer.round_trip:.2f} ms", " ".join(peer.topics))
    return table


def _topics(subscriptions: list[Subscription], heard: dict[tuple[str, str], Heard], seconds: float) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    for head in ("topic", "sender", "messages/s", "KB/s", "latency", "lost", "repaired", "refused"):
        table.add_column(head, justify="left" if head in ("topic", "sender") else "right")
    for subscription in subscriptions:
        refused = sum(subscription.opener.refusals.as_dict().values())
        totals = [f"{subscription.lost:,}", f"{subscription.repaired:,}", f"{refused:,}"]
        senders = [sender for alias, sender in sorted(heard) if alias == subscription.alias]
        for sender in senders:
            entry = heard[subscription.alias, sender]
            rates = [f"{entry.messages / seconds:,.1f}", f"{entry.bytes / seconds / 1000:,.1f}"]
            table.add_row(subscription.alias, sender, *rates, f"{1000 * entry.latency:.2f} ms", *totals)
            totals = ["", "", ""]  # of the topic, not of the sender
            entry.messages = entry.bytes = 0
        if not senders:
            table.add_row(subscription.alias, "-", "0.0", "0.0", "", *totals)
    return table
