"""The ROS 2 proxy: listed topics and services of DDS domains become topics of the fleet, and the other way round.

Nodes on the domains are unchanged ROS 2 nodes: they see publishers, subscriptions, servers and clients as if local. Messages
pass as they are, serialized (CDR), whatever their type. What is not listed stays on its domain.

    ROS node -> DDS reader -> bounded queue -> Node.publisher -> ... -> Node.subscribe -> DDS writer -> ROS node
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tutelage.errors import TutelageError
from tutelage.sgc.errors import NoKey
from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.counts import Counts
from tutelage.sgc.proxies.dds_domain import Domain, Writer
from tutelage.sgc.proxies.latched import Newcomer, Retained
from tutelage.sgc.proxies.queues import BoundedQueue
from tutelage.sgc.proxies.ros_hash import TypeHashes
from tutelage.sgc.proxies.ros_names import topic_channel
from tutelage.sgc.proxies.ros_services import Client, Server
from tutelage.sgc.proxies.routes import Routes, TopicRoute
from tutelage.sgc.transport.base import Congested

if TYPE_CHECKING:
    from tutelage.sgc.messages import Message
    from tutelage.sgc.node import Node

log = logging.getLogger(__name__)
_RETRY = 0.005  # seconds between two attempts while the network is busy
_GIVE_UP = 2.0  # seconds after which a message that the network does not take is dropped


class Ros2Proxy:
    """Carries routes between the DDS domains of this machine's network and the fleet.

    Args:
        node: on the fleet's network. Not closed by `close`.
        routes: what to carry.

    Raises:
        MissingExtraError: cyclonedds is not installed, or rosbags where the routes name a distribution.
        ConfigError: Cyclone DDS refuses a topic.
        NotAllowed: the policy does not allow a route.
    """

    def __init__(self, node: Node, routes: Routes) -> None:
        self._node = node
        self._domains: dict[int, Domain] = {}
        self._closed = threading.Event()
        self._parts: list[Outward | Inward | Client | Server] = []
        hashes = TypeHashes(routes.distribution)
        try:
            inward = [self._add(Inward(node, self._domain(r.domain), r, hashes)) for r in routes.topics if r.inward]
            for route in routes.topics:
                if route.outward:
                    # What this node sends it does not take in; so what goes out also goes to this proxy's other domains.
                    others = [i for i in inward if i.route.alias == route.alias and i.route.domain != route.domain]
                    self._add(Outward(node, self._domain(route.domain), route, hashes, [other.write for other in others]))
            for service in routes.services:
                kind = Server if service.outward else Client
                self._add(kind(node, self._domain(service.domain), service))
            if any(isinstance(part, Outward) and part.retained for part in self._parts):
                threading.Thread(target=self._tend, name="ros2-latched", daemon=True).start()
        except BaseException:
            self.close()
            raise

    def counters(self) -> dict[str, Any]:
        """What was carried and what was not: topics/<alias>/..., of all routes of the alias together."""
        topics: dict[str, dict[str, int]] = {}
        for part in self._parts:
            counts = topics.setdefault(part.route.alias, {})
            for name, count in part.counters().items():
                counts[name] = counts.get(name, 0) + count
        return {"topics": topics}

    def close(self) -> None:
        """Leave the domains; the node stays."""
        self._closed.set()
        for part in self._parts:
            part.close()
        for domain in self._domains.values():
            domain.close()
        self._parts.clear()
        self._domains.clear()

    def __enter__(self) -> Ros2Proxy:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _tend(self) -> None:
        """Latched topics: see who has arrived."""
        while not self._closed.wait(0.5):
            try:
                peers = self._node.peers()
            except TutelageError as error:
                log.warning("who is there cannot be told now: %s", error)
                continue
            for part in self._parts:
                if isinstance(part, Outward) and part.retained is not None:
                    part.retained.tend(frozenset(peer.name for peer in peers if part.route.alias in peer.topics))

    def _domain(self, number: int) -> Domain:
        if number not in self._domains:
            self._domains[number] = Domain(number)
        return self._domains[number]

    def _add(self, part: Any) -> Any:
        self._parts.append(part)
        return part


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
        ready = (lambda: not self._queue.full) if self._keep_all else (lambda: True)
        self._reader = domain.reader(channel, route.qos, self._queue.put, ready=ready, pairs=hashes.pairs(route.type))

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
