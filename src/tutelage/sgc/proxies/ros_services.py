"""Services over DDS, as the Cyclone DDS middleware of ROS 2 (rmw_cyclonedds) speaks them.

A request is a sample on rq/<name>Request, its reply one on rr/<name>Reply. Both start, after the 4 bytes of CDR, with 16
bytes that say whose request it is: the client's number and its sequence number. The fleet carries the message without them.

Fast DDS (rmw_fastrtps) writes that identity into the RTPS headers instead, so its services cannot be carried; nor do the two
middlewares of ROS 2 understand each other's services.
"""

from __future__ import annotations

import logging
import secrets
import struct
import threading
import time
import uuid
from typing import TYPE_CHECKING

from tutelage.errors import TutelageError
from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.counts import Counts
from tutelage.sgc.proxies.dds_domain import Domain
from tutelage.sgc.proxies.dds_raw import HEADER
from tutelage.sgc.proxies.queues import BoundedQueue
from tutelage.sgc.proxies.ros_names import service_channels
from tutelage.sgc.proxies.routes import ServiceRoute

if TYPE_CHECKING:
    from tutelage.sgc.messages import Message
    from tutelage.sgc.node import Node

log = logging.getLogger(__name__)
_IDENTITY = struct.Struct("<Qq")  # client, sequence number
_MATCH_POLL = 0.02  # seconds
_WORKERS = 8
_WAITING = 64


def _with_identity(message: bytes, identity: bytes) -> tuple[bytes, bytes, bytes]:
    """The pieces of a sample: CDR header, identity, content. 16 bytes keep the content's alignment."""
    return message[:HEADER], identity, message[HEADER:]


def _split(sample: bytes) -> tuple[bytes, bytes] | None:
    """Identity and message of a sample; None if it is too short."""
    start = HEADER + _IDENTITY.size
    if len(sample) <= start:
        return None
    return sample[HEADER:start], sample[:HEADER] + sample[start:]


def _service_id(kind: str) -> dict[str, str]:
    """serviceid / clientid in USER_DATA: by it, ROS 2 knows which reader and writer belong together."""
    return {kind: ".".join(f"{byte:x}" for byte in uuid.uuid4().bytes)}


class Client:
    """Clients are on the domain, the server somewhere in the fleet: requests are taken from DDS and answered into it."""

    def __init__(self, node: Node, domain: Domain, route: ServiceRoute) -> None:
        self.route = route
        self._node = node
        self._counts = Counts("requests", "replies", "no_reply", "malformed")
        requests, replies = service_channels(route.name, route.type)
        ids = _service_id("serviceid")
        self._queue: BoundedQueue[bytes] = BoundedQueue(_WAITING)
        self._writer = domain.writer(replies, route.qos, ids)
        self._threads = [
            threading.Thread(target=self._run, name=f"ros2-client-{route.alias}-{i}", daemon=True) for i in range(_WORKERS)
        ]
        for thread in self._threads:
            thread.start()
        self._reader = domain.reader(requests, route.qos, self._queue.put, pairs=ids)

    @property
    def incompatible(self) -> tuple[int, str]:
        """See `Reader.incompatible`."""
        here: tuple[int, str] = max(self._reader.incompatible, self._writer.incompatible)
        return here

    def counters(self) -> dict[str, int]:
        """Requests, and what became of them."""
        return self._counts.as_dict(requests_dropped=self._queue.dropped)

    def close(self) -> None:
        """Take no more requests."""
        self._queue.close()
        for thread in self._threads:
            thread.join(0.2)  # one that still waits for a reply is left to its timeout

    def _run(self) -> None:
        while (sample := self._queue.get()) is not None:
            parts = _split(sample)
            if parts is None:
                self._counts.add("malformed")
                continue
            identity, request = parts
            self._counts.add("requests")
            try:
                reply = self._node.request(self.route.alias, request, timeout=self.route.timeout)
                if not dds_raw.is_cdr(reply):
                    raise ValueError("the reply is no serialized message")
                self._writer.write(*_with_identity(reply, identity))
                self._counts.add("replies")
            except (TutelageError, ValueError, OSError) as error:  # ROS 2 services cannot say "failed": clients time out
                self._counts.add("no_reply")
                log.warning("%s: no reply for a client on %s: %s", self.route.alias, self.route.name, error)


class Server:
    """The server is on the domain, clients somewhere in the fleet: requests are written to DDS as a client of our own."""

    def __init__(self, node: Node, domain: Domain, route: ServiceRoute) -> None:
        self.route = route
        self._counts = Counts("requests", "replies", "no_reply", "malformed")
        self._client = secrets.randbits(63)
        self._sequence = 0
        self._waiting: dict[bytes, _Reply] = {}
        self._lock = threading.Lock()
        requests, replies = service_channels(route.name, route.type)
        ids = _service_id("clientid")
        self._reader = domain.reader(replies, route.qos, self._on_reply, pairs=ids)
        self._writer = domain.writer(requests, route.qos, ids)
        self._handle = node.serve(route.alias, self._on_request)

    @property
    def incompatible(self) -> tuple[int, str]:
        """See `Reader.incompatible`."""
        here: tuple[int, str] = max(self._reader.incompatible, self._writer.incompatible)
        return here

    def counters(self) -> dict[str, int]:
        """Requests, and what became of them."""
        return self._counts.as_dict()

    def close(self) -> None:
        """Serve no more."""
        self._handle.close()

    def _on_request(self, message: Message) -> bytes:
        request = bytes(message.payload)
        if not dds_raw.is_cdr(request):
            self._counts.add("malformed")
            raise ValueError("the request is no serialized message (CDR)")
        until = time.monotonic() + self.route.timeout
        waiting = _Reply()
        with self._lock:
            self._sequence += 1
            self._counts.add("requests")
            identity = _IDENTITY.pack(self._client, self._sequence)
            self._waiting[identity] = waiting
        try:
            self._wait_for_server(until)
            self._writer.write(*_with_identity(request, identity))
            if not waiting.event.wait(max(0.0, until - time.monotonic())):
                raise TimeoutError(f"the ROS 2 server of {self.route.name} did not answer within {self.route.timeout:g} s")
        except TimeoutError:
            self._counts.add("no_reply")
            raise
        finally:
            with self._lock:
                del self._waiting[identity]
        self._counts.add("replies")
        return waiting.message

    def _wait_for_server(self, until: float) -> None:
        """A request that is written before discovery has found the server, or the server us, is lost."""
        while not (self._writer.matched and self._reader.matched):
            if time.monotonic() > until:
                raise TimeoutError(f"there is no ROS 2 server of {self.route.name} on domain {self.route.domain}")
            time.sleep(_MATCH_POLL)

    def _on_reply(self, sample: bytes) -> None:
        parts = _split(sample)
        if parts is None:
            self._counts.add("malformed")
            return
        with self._lock:
            waiting = self._waiting.get(parts[0])  # None: another client's, or too late
        if waiting is not None:
            waiting.message = parts[1]
            waiting.event.set()


class _Reply:
    """A reply that somebody waits for."""

    def __init__(self) -> None:
        self.event = threading.Event()
        self.message = b""
