"""The verb `tutelage ping`."""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tutelage.errors import ConfigError

if TYPE_CHECKING:
    from tutelage.sgc.node import Node


MAX_SECONDS = 3600.0
"""Of interval and timeout."""


def ping(
    home: Positional[Path],
    nodes: Positional[tuple[str, ...]] = (),
    count: int = 4,
    interval: float = 0.5,
    timeout: float = 2.0,
) -> None:
    """The round trip to other nodes through the routers and back, sealed and signed both ways.

    Args:
        home: the folder of the node that asks.
        nodes: names of the nodes to ask; default: all that are present on a topic of this node.
        count: how often each is asked.
        interval: seconds between two questions.
        timeout: seconds to wait for an answer, and at first for the network and the topics' keys.
    """
    from tutelage.sgc.node import Node
    from tutelage.sgc.transport.base import NoReply

    if count < 1 or not 0 <= interval <= MAX_SECONDS or not 0 < timeout <= MAX_SECONDS:
        raise ConfigError(
            f"ping needs a count of at least 1, an interval of at least 0 s and a timeout of more than 0 s, both at most "
            f"{MAX_SECONDS:g} s"
        )
    with Node.open(home) as node:
        _wait_for_network(node, timeout)
        asked = list(nodes) or _present(node, timeout)
        answers: dict[str, list[float]] = {name: [] for name in asked}
        for turn in range(count):
            for name in asked:
                try:
                    took = node.ping(name, timeout)
                except NoReply as error:
                    print(f"{name:<24} {error}", flush=True)
                else:
                    answers[name].append(took)
                    print(f"{name:<24} {1000 * took:8.2f} ms", flush=True)
            if turn < count - 1:
                time.sleep(interval)
    for name, times in answers.items():
        if times:
            low, middle, high = (1000 * f(times) for f in (min, statistics.median, max))
            spread = f"{low:.2f} / {middle:.2f} / {high:.2f} ms (least, median, most)"
            print(f"{name:<24} {len(times)} of {count} answered; {spread}")
    silent = [name for name, times in answers.items() if not times]
    if silent:
        raise NoReply(f"no answer from {', '.join(silent)}")


def _wait_for_network(node: Node, timeout: float) -> None:
    from tutelage.sgc.transport.base import NoReply

    until = time.monotonic() + timeout
    while not node.connected:
        if time.monotonic() > until:
            raise NoReply(f"{node.name} reaches none of its routers; see network.toml in {node.home.path}")
        time.sleep(0.02)


def _present(node: Node, timeout: float) -> list[str]:
    from tutelage.sgc.transport.base import NoReply

    until = time.monotonic() + timeout
    while True:
        found = [peer.name for peer in node.peers(min(0.5, timeout))]
        if found:
            return found
        if time.monotonic() > until:
            raise NoReply(f"nobody else is present on the topics of {node.name}")
        time.sleep(0.05)
