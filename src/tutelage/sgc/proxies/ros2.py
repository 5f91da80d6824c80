"""The ROS 2 proxy: listed topics and services of DDS domains become topics of the fleet, and the other way round.

Nodes on the domains are unchanged ROS 2 nodes: they see publishers, subscriptions, servers and clients as if local. Messages
pass as they are, serialized (CDR), whatever their type. What is not listed stays on its domain.

    ROS node -> DDS reader -> bounded queue -> Node.publisher -> ... -> Node.subscribe -> DDS writer -> ROS node
"""

from __future__ import annotations

import logging
import threading
from functools import partial
from typing import TYPE_CHECKING, Any

from tutelage.errors import TutelageError
from tutelage.sgc.proxies.dds_domain import Domain
from tutelage.sgc.proxies.dds_services import DdsOffered, DdsUsed
from tutelage.sgc.proxies.rclpy_domain import RclpyDomain
from tutelage.sgc.proxies.rclpy_services import RclpyOffered, RclpyUsed
from tutelage.sgc.proxies.ros_hash import TypeHashes
from tutelage.sgc.proxies.ros_services import Client, Server
from tutelage.sgc.proxies.ros_topics import Inward, Outward
from tutelage.sgc.proxies.routes import Routes, ServiceRoute

if TYPE_CHECKING:
    from tutelage.sgc.node import Node

log = logging.getLogger(__name__)


class Ros2Proxy:
    """Carries routes between the DDS domains of this machine's network and the fleet.

    Args:
        node: on the fleet's network. Not closed by `close`.
        routes: what to carry.

    Raises:
        MissingExtraError: cyclonedds is not installed, or rosbags where the routes name a distribution.
        ConfigError: Cyclone DDS refuses a topic; a service goes through rclpy, and rclpy or its type is not installed.
        NotAllowed: the policy does not allow a route.
    """

    def __init__(self, node: Node, routes: Routes) -> None:
        self._node = node
        self._domains: dict[int, Domain] = {}
        self._rclpy_domains: dict[int, RclpyDomain] = {}
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
                self._add(self._service(service))
            threading.Thread(target=self._tend, name="ros2-tend", daemon=True).start()
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
        for rclpy in self._rclpy_domains.values():
            rclpy.close()
        self._parts.clear()
        self._domains.clear()
        self._rclpy_domains.clear()

    def __enter__(self) -> Ros2Proxy:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _tend(self) -> None:
        told: dict[Any, int] = {}
        while not self._closed.wait(0.5):
            try:
                self._tend_latched()
                for part in self._parts:
                    self._warn(part, told)
            except TutelageError as error:
                log.warning("%s", error)

    def _tend_latched(self) -> None:
        """See who has arrived, and repeat what such a node has missed."""
        latched = [part for part in self._parts if isinstance(part, Outward) and part.retained is not None]
        peers = self._node.peers() if latched else []
        for part in latched:
            assert part.retained is not None
            part.retained.tend(frozenset(peer.name for peer in peers if part.route.alias in peer.topics))

    def _warn(self, part: Outward | Inward | Client | Server, told: dict[Any, int]) -> None:
        """DDS does not connect ends whose quality of service does not fit, and says nothing; so we do."""
        count, policy = part.incompatible
        if count > told.get(part, 0):
            told[part] = count
            route = part.route
            log.warning(
                "%s on domain %d: %d ends of nodes do not fit the route's qos (%s); change it in the file of routes",
                route.name,
                route.domain,
                count,
                policy,
            )

    def _domain(self, number: int) -> Domain:
        if number not in self._domains:
            self._domains[number] = Domain(number)
        return self._domains[number]

    def _rclpy_domain(self, number: int) -> RclpyDomain:
        if number not in self._rclpy_domains:
            self._rclpy_domains[number] = RclpyDomain(number)
        return self._rclpy_domains[number]

    def _service(self, route: ServiceRoute) -> Client | Server:
        node, number = self._node, route.domain
        if route.through == "rclpy":
            rclpy = self._rclpy_domain(number)
            if route.outward:
                return Server(node, RclpyUsed(rclpy, route), route)
            return Client(node, partial(RclpyOffered, rclpy, route), route)
        dds = self._domain(number)
        if route.outward:
            return Server(node, DdsUsed(dds, route), route)
        return Client(node, partial(DdsOffered, dds, route), route)

    def _add(self, part: Any) -> Any:
        self._parts.append(part)
        return part
