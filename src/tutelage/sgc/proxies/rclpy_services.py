"""Services through rclpy: those of whatever middleware RMW_IMPLEMENTATION names, such as ROS 2's default, rmw_fastrtps.

Messages are serialized again on their way, to the bytes that topics have, so that the other side may be of any kind.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from tutelage.errors import ConfigError
from tutelage.sgc.proxies.rclpy_domain import RclpyDomain, service_type
from tutelage.sgc.proxies.ros_qos import QosProfile
from tutelage.sgc.proxies.ros_services import Request, wait_for_reply, wait_for_server
from tutelage.sgc.proxies.routes import ServiceRoute


class _RclpyEnd:
    """What both ends have. rclpy hands out nothing malformed, and does not tell of services whose quality does not fit."""

    malformed = 0
    incompatible = (0, "")

    def __init__(self, domain: RclpyDomain, route: ServiceRoute) -> None:
        self._domain = domain
        self._route = route
        self._type = service_type(route.type)

    def _made(self, make: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return make(self._type, self._route.name, *arguments, qos_profile=_rclpy_qos(self._route.qos))
        except Exception as error:  # rclpy has no common class of errors
            raise ConfigError(f"rclpy refuses the service {self._route.name} of type {self._route.type}: {error}") from None

    def _parsed(self, message: bytes, part: Any) -> Any:
        from rclpy.serialization import deserialize_message

        try:
            return deserialize_message(message, part)
        except Exception:  # the class of the error depends on the distribution
            raise ValueError(f"not a message of {self._route.type}") from None


class RclpyOffered(_RclpyEnd):
    """A service that is offered on a domain; see `ros_services.Offered`."""

    def __init__(self, domain: RclpyDomain, route: ServiceRoute, put: Callable[[Request], None]) -> None:
        super().__init__(domain, route)
        self._put = put
        # rclpy's executor sends what the callback returns, at once. A reply from the fleet takes its time, and may not come
        # at all. So the callback returns the request, and instead of being sent it is put in the queue.
        self._service = self._made(domain.node.create_service, lambda request, _: request)
        self._send: Callable[[Any, Any], None] = self._service.send_response
        self._service.send_response = self._on_request

    def reply(self, asker: Any, message: bytes) -> None:
        """See `Offered.reply`."""
        response = self._parsed(message, self._type.Response)
        try:
            self._send(response, asker)
        except Exception as error:  # the node is closed, or the client has left
            raise OSError(f"rclpy could not reply: {error}") from None

    def _on_request(self, request: Any, header: Any) -> None:
        from rclpy.serialization import serialize_message

        self._put(Request(header, serialize_message(request)))


class RclpyUsed(_RclpyEnd):
    """A service of a domain, used as a client; see `ros_services.Used`."""

    def __init__(self, domain: RclpyDomain, route: ServiceRoute) -> None:
        super().__init__(domain, route)
        self._client = self._made(domain.node.create_client)

    def call(self, request: bytes) -> bytes:
        """See `Used.call`."""
        from rclpy.serialization import serialize_message

        route = self._route
        until = time.monotonic() + route.timeout
        parsed = self._parsed(request, self._type.Request)
        wait_for_server(self._client.service_is_ready, route, until)
        if self._domain.other_proxy_serves(route.name):
            raise ConnectionRefusedError(
                f"another proxy brings {route.name} to domain {route.domain}; the request would go round"
            )
        answered = threading.Event()
        try:
            future = self._client.call_async(parsed)
        except Exception as error:  # such as: the node is closed
            raise OSError(f"rclpy could not ask {route.name}: {error}") from None
        future.add_done_callback(lambda _: answered.set())
        try:
            wait_for_reply(answered, route, until)
        except TimeoutError:
            self._client.remove_pending_request(future)
            raise
        return bytes(serialize_message(future.result()))


def _rclpy_qos(profile: QosProfile) -> Any:
    from rclpy.duration import Duration
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    promises = {"lifespan": profile.lifespan, "deadline": profile.deadline}
    return QoSProfile(
        reliability=ReliabilityPolicy[profile.reliability.upper()],
        durability=DurabilityPolicy[profile.durability.upper()],
        history=HistoryPolicy[profile.history.upper()],
        depth=profile.depth,
        **{name: Duration(seconds=seconds) for name, seconds in promises.items() if seconds is not None},
    )
