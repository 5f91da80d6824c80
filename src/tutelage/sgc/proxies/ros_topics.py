"""Topics of ROS 2 to the fleet and from it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from tutelage.sgc.errors import NoKey
from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.counts import Counts
from tutelage.sgc.proxies.dds_domain import Domain, Writer
from tutelage.sgc.proxies.latched import Newcomer, Retained
from tutelage.sgc.proxies.queues import BoundedQueue
from tutelage.sgc.proxies.ros_hash import TypeHashes
from tutelage.sgc.proxies.ros_names import topic_channel
from tutelage.sgc.proxies.routes import TopicRoute
from tutelage.sgc.transport.base import Congested

if TYPE_CHECKING:
    from tutelage.sgc.messages import Message
    from tutelage.sgc.node import Node

log = logging.getLogger(__name__)
_RETRY = 0.005  # seconds between two attempts while the network is busy
_GIVE_UP = 2.0  # seconds after which a message that the network does not take is dropped


class Outward:
    """A topic from a domain to the fleet."""

    def __init__(
        self,
        node: Node,
        domain: Domain,
        route: TopicRoute,
        hashes: TypeHashes,
        others: list[Callable[[bytes], None]],
    ) -> None:
        self.route = route
        self._publisher = node.publisher(route.alias)
        self._domain = domain
        self._others = others
        self._queue: BoundedQueue[bytes] = BoundedQueue(route.queue)
        self._keep_all = route.qos.history == "keep_all"
        self._counts = Counts("out", "congested", "without_key")
        self._closed = False
        latched = route.qos.durability == "transient_local"
        self.retained = Retained(route.qos.depth, self._send) if latched else None
        self._thread = threading.Thread(target=self._run, name=f"ros2-out-{route.alias}", daemon=True)
        self._thread.start()
        channel = topic_channel(route.name, route.type)
        # A writer that keeps all waits for its readers; so with KEEP_ALL samples stay with DDS while the queue is full.
        room: dict[str, Any] = {"room": lambda: self._queue.room} if self._keep_all else {}
        qos = replace(route.qos, depth=max(route.qos.depth, route.queue))
        self._reader = domain.reader(channel, qos, self._queue.put, pairs=hashes.pairs(route.type), **room)

    @property
    def incompatible(self) -> tuple[int, str]:
        """See `Reader.incompatible`."""
        return self._reader.incompatible

    def counters(self) -> dict[str, int]:
        """Messages sent, and dropped by reason."""
        return self._counts.as_dict(out_dropped=self._queue.dropped, from_proxies=self._reader.ignored)

    def close(self) -> None:
        """Stop; what waits is still tried once."""
        self._closed = True
        self._queue.close()
        self._thread.join(5.0)

    def _run(self) -> None:
        while (data := self._queue.get()) is not None:
            if self._keep_all:
                self._domain.wake()
            for other in self._others:
                other(data)
            if self.retained is not None:
                self.retained.send(data)
            else:
                self._send(data)

    def _send(self, data: bytes) -> None:
        until = time.monotonic() + _GIVE_UP
        while True:
            try:
                self._publisher.send(data)
            except Congested:
                if time.monotonic() < until and not self._closed:
                    time.sleep(_RETRY)
                    continue
                self._counts.add("congested")
            except NoKey:
                self._counts.add("without_key")
            else:
                self._counts.add("out")
            return


class Inward:
    """A topic from the fleet to a domain."""

    def __init__(self, node: Node, domain: Domain, route: TopicRoute, hashes: TypeHashes) -> None:
        self.route = route
        self._name = node.name
        self._newcomer = Newcomer(route.qos.depth if route.qos.durability == "transient_local" else 0)
        self._counts = Counts("in", "not_cdr", "in_dropped")
        channel = topic_channel(route.name, route.type)
        self._writer: Writer = domain.writer(channel, route.qos, hashes.pairs(route.type))
        self._subscription = node.subscribe(route.alias, self._on_message, queue=route.queue)

    def write(self, data: bytes) -> None:
        """Write a message on the domain."""
        if not dds_raw.is_cdr(data):
            self._counts.add("not_cdr")
            return
        try:
            self._counts.add("in" if self._writer.write(data) else "in_dropped")
        except (ValueError, OSError) as error:
            self._counts.add("in_dropped")
            log.warning("%s: %s", self.route.alias, error)

    @property
    def incompatible(self) -> tuple[int, str]:
        """See `Writer.incompatible`."""
        return self._writer.incompatible

    def counters(self) -> dict[str, int]:
        """Messages written, refused as they are no CDR, dropped as readers were too slow."""
        return self._counts.as_dict()

    def close(self) -> None:
        """Stop."""
        self._subscription.close()

    def _on_message(self, message: Message) -> None:
        if message.sender != self._name:
            for data in self._newcomer.accept(message.sender, bytes(message.payload)):
                self.write(data)
