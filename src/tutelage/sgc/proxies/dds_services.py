"""Services over DDS, as the Cyclone DDS middleware of ROS 2 (rmw_cyclonedds) speaks them.

A request is a sample on rq/<name>Request, its reply one on rr/<name>Reply. Both start, after the 4 bytes of CDR, with 16
bytes that say whose request it is: the client's number and its sequence number. The fleet carries the message without them.

Fast DDS (rmw_fastrtps) writes that identity into the RTPS headers instead, where Cyclone DDS does not show it;
`rclpy_services` is for it. The two middlewares of ROS 2 do not understand each other's services.
"""

from __future__ import annotations

import secrets
import struct
import threading
import time
import uuid
from collections.abc import Callable

from tutelage.sgc.proxies.dds_domain import OTHER_MIDDLEWARE, Domain, Reader, Writer
from tutelage.sgc.proxies.dds_raw import HEADER
from tutelage.sgc.proxies.ros_names import service_channels
from tutelage.sgc.proxies.ros_services import Request, wait_for_reply, wait_for_server
from tutelage.sgc.proxies.routes import ServiceRoute

_IDENTITY = struct.Struct("<Qq")  # client, sequence number


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


class _DdsEnd:
    """What both ends have: a reader and a writer."""

    _reader: Reader
    _writer: Writer
    _malformed = 0

    @property
    def malformed(self) -> int:
        """How many samples came that are no requests or replies, those of another middleware among them."""
        return self._malformed + self._reader.foreign

    @property
    def incompatible(self) -> tuple[int, str]:
        """See `Reader.incompatible`."""
        return max(self._reader.incompatible, self._writer.incompatible)


class DdsOffered(_DdsEnd):
    """A service that is offered on a domain; see `ros_services.Offered`."""

    def __init__(self, domain: Domain, route: ServiceRoute, put: Callable[[Request], None]) -> None:
        self._put = put
        requests, replies = service_channels(route.name, route.type)
        ids = _service_id("serviceid")
        self._writer = domain.writer(replies, route.qos, ids)
        self._reader = domain.reader(requests, route.qos, self._on_request, pairs=ids, cyclone_only=True)

    def reply(self, asker: bytes, message: bytes) -> None:
        """See `Offered.reply`."""
        self._writer.write(*_with_identity(message, asker))

    def _on_request(self, sample: bytes) -> None:
        parts = _split(sample)
        if parts is None:
            self._malformed += 1
        else:
            self._put(Request(*parts))


class DdsUsed(_DdsEnd):
    """A service of a domain, used as a client; see `ros_services.Used`."""

    def __init__(self, domain: Domain, route: ServiceRoute) -> None:
        self._route = route
        self._client = secrets.randbits(63)
        self._sequence = 0
        self._waiting: dict[bytes, _Reply] = {}
        self._lock = threading.Lock()
        requests, replies = service_channels(route.name, route.type)
        ids = _service_id("clientid")
        self._reader = domain.reader(replies, route.qos, self._on_reply, pairs=ids, cyclone_only=True)
        self._writer = domain.writer(requests, route.qos, ids)

    def call(self, request: bytes) -> bytes:
        """See `Used.call`."""
        route = self._route
        until = time.monotonic() + route.timeout
        waiting = _Reply()
        with self._lock:
            self._sequence += 1
            identity = _IDENTITY.pack(self._client, self._sequence)
            self._waiting[identity] = waiting
        try:
            wait_for_server(lambda: bool(self._writer.matched and self._reader.matched), route, until)
            if self._writer.foreign:  # it would take the identity for the beginning of the request
                raise ConnectionRefusedError(f"{route.name}: {OTHER_MIDDLEWARE}")
            self._writer.write(*_with_identity(request, identity))
            wait_for_reply(waiting.event, route, until)
        finally:
            with self._lock:
                del self._waiting[identity]
        return waiting.message

    def _on_reply(self, sample: bytes) -> None:
        parts = _split(sample)
        if parts is None:
            self._malformed += 1
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
