"""Services of ROS 2 to the fleet and from it. How a domain speaks of them is the matter of an end: `dds_services`, or
`rclpy_services`; both give and take messages as topics do, serialized (CDR with its 4-byte header).
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from tutelage.errors import TutelageError
from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.counts import Counts
from tutelage.sgc.proxies.queues import BoundedQueue
from tutelage.sgc.proxies.routes import ServiceRoute

if TYPE_CHECKING:
    from tutelage.sgc.messages import Message
    from tutelage.sgc.node import Node

log = logging.getLogger(__name__)
_WORKERS = 8
_WAITING = 64
_READY_POLL = 0.02  # seconds


@dataclass(frozen=True, slots=True)
class Request:
    """What a client on a domain asks.

    Attributes:
        asker: who it is and which of its requests this is; goes back to `Offered.reply`.
        message: serialized.
    """

    asker: Any
    message: bytes


class _End(Protocol):
    @property
    def malformed(self) -> int:
        """How many samples came that are no requests or replies."""

    @property
    def incompatible(self) -> tuple[int, str]:
        """How many ends do not fit in their quality of service, and which policy of the last of them."""


class Offered(_End, Protocol):
    """A service that is offered on a domain. Made with a function that takes each `Request` and does not block."""

    def reply(self, asker: Any, message: bytes) -> None:
        """Answer.

        Raises:
            ValueError: not a message of the service.
            OSError: it could not be sent.
        """


class Used(_End, Protocol):
    """A service of a domain, used as a client."""

    def call(self, request: bytes) -> bytes:
        """Ask, and wait for the reply. Safe to use from several threads.

        Raises:
            ValueError: not a message of the service.
            OSError: there is no server, it did not answer in time, or the request could not be sent; the message says which.
        """


def wait_for_server(ready: Callable[[], bool], route: ServiceRoute, until: float) -> None:
    """Until discovery has found the server, and it us: a request that is sent before is lost.

    until: by `time.monotonic`.

    Raises:
        TimeoutError: there is none.
    """
    while not ready():
        if time.monotonic() > until:
            raise TimeoutError(f"there is no ROS 2 server of {route.name} on domain {route.domain}")
        time.sleep(_READY_POLL)


def wait_for_reply(answered: threading.Event, route: ServiceRoute, until: float) -> None:
    """Until the server has answered.

    Raises:
        TimeoutError: not in time.
    """
    if not answered.wait(max(0.0, until - time.monotonic())):
        raise TimeoutError(f"the ROS 2 server of {route.name} did not answer within {route.timeout:g} s")


class Client:
    """Clients are on the domain, the server somewhere in the fleet: requests are taken from the domain and answered into it.

    Args:
        offer: makes the end on the domain.
    """

    def __init__(self, node: Node, offer: Callable[[Callable[[Request], None]], Offered], route: ServiceRoute) -> None:
        self.route = route
        self._node = node
        self._counts = Counts("requests", "replies", "no_reply")
        self._queue: BoundedQueue[Request] = BoundedQueue(_WAITING)
        self._end = offer(self._queue.put)
        self._threads = [
            threading.Thread(target=self._run, name=f"ros2-client-{route.alias}-{i}", daemon=True) for i in range(_WORKERS)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def incompatible(self) -> tuple[int, str]:
        """How many ends do not fit, and which policy of the last of them."""
        return self._end.incompatible

    def counters(self) -> dict[str, int]:
        """Requests, and what became of them."""
        return self._counts.as_dict(malformed=self._end.malformed, requests_dropped=self._queue.dropped)

    def close(self) -> None:
        """Take no more requests."""
        self._queue.close()
        for thread in self._threads:
            thread.join(0.2)  # one that still waits for a reply is left to its timeout

    def _run(self) -> None:
        while (request := self._queue.get()) is not None:
            self._counts.add("requests")
            try:
                reply = self._node.request(self.route.alias, request.message, timeout=self.route.timeout)
                if not dds_raw.is_cdr(reply):
                    raise ValueError("the reply is no serialized message")
                self._end.reply(request.asker, reply)
                self._counts.add("replies")
            except (TutelageError, ValueError, OSError) as error:  # ROS 2 services cannot say "failed": clients time out
                self._counts.add("no_reply")
                log.warning("%s: no reply for a client on %s: %s", self.route.alias, self.route.name, error)


class Server:
    """The server is on the domain, clients somewhere in the fleet: requests are put to it as by a client of our own."""

    def __init__(self, node: Node, end: Used, route: ServiceRoute) -> None:
        self.route = route
        self._end = end
        self._counts = Counts("requests", "replies", "no_reply", "malformed")
        self._handle = node.serve(route.alias, self._on_request)

    @property
    def incompatible(self) -> tuple[int, str]:
        """How many ends do not fit, and which policy of the last of them."""
        return self._end.incompatible

    def counters(self) -> dict[str, int]:
        """Requests, and what became of them."""
        counts = self._counts.as_dict()
        return {**counts, "malformed": counts["malformed"] + self._end.malformed}

    def close(self) -> None:
        """Serve no more."""
        self._handle.close()

    def _on_request(self, message: Message) -> bytes:
        request = bytes(message.payload)
        try:
            if not dds_raw.is_cdr(request):
                raise ValueError("the request is no serialized message (CDR)")
            self._counts.add("requests")
            reply = self._end.call(request)
        except ValueError:
            self._counts.add("malformed")
            raise
        except OSError:
            self._counts.add("no_reply")
            raise
        self._counts.add("replies")
        return reply
