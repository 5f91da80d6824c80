"""Services of a rosbridge: clients call the fleet's services, and answer for services that they advertise."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeout
from typing import TYPE_CHECKING, Any, Protocol

from tutelage.errors import TutelageError
from tutelage.sgc.proxies.counts import Counts
from tutelage.sgc.proxies.rosbridge_topics import Codecs
from tutelage.sgc.proxies.routes import Routes, ServiceRoute

if TYPE_CHECKING:
    from tutelage.sgc.messages import Message
    from tutelage.sgc.node import Node
    from tutelage.sgc.transport.base import Handle

MAX_PENDING = 1000
"""Requests that may wait for one client's answer."""


class ServiceFailed(TutelageError):
    """The service answered that it failed, or could not be asked."""


class Provider(Protocol):
    """A client that answers for services."""

    def ask(self, message: dict[str, Any]) -> None:
        """Send it a call_service message. From any thread."""


class Service:
    """One of the fleet's services, as the clients of this rosbridge share it.

    Args:
        node: on the fleet's network.
        route: which service.
        codecs: by type.
        pool: for calls that block.
    """

    def __init__(self, node: Node, route: ServiceRoute, codecs: Codecs, pool: ThreadPoolExecutor) -> None:
        self.route = route
        self.counts = Counts("calls", "answers", "failed")
        self.provider: Provider | None = None
        self._node, self._codecs, self._pool = node, codecs, pool
        self._handle: Handle | None = None
        self._pending: dict[str, Future[bytes]] = {}
        self._number = 0

    async def call(self, arguments: Any, timeout: float | None = None) -> dict[str, Any]:
        """Ask the service; who answers for it on this rosbridge is asked directly, others through the fleet.

        arguments: of the request, by name, or in order.
        timeout: seconds; default: the route's.

        Raises:
            BadValue: the arguments do not fit.
            ServiceFailed, NoReply, RequestFailed, NotAllowed, ConfigError: no answer.
        """
        self.counts.add("calls")
        requests, responses = self._codecs.service(self.route.type)
        data = requests.serialize(_by_name(arguments, requests.serialize, self._fields(requests.type_name)))
        ask = self._ask_provider if self.provider is not None else self._ask_fleet
        loop = asyncio.get_running_loop()
        reply = await loop.run_in_executor(self._pool, ask, data, timeout or self.route.timeout)
        values = responses.values(reply)
        self.counts.add("answers")
        return values

    def advertise(self, provider: Provider) -> None:
        """Let a client answer for the service. Blocks.

        Raises:
            ServiceFailed: another client does already.
            NotAllowed: the policy does not let this node serve.
        """
        if self.provider is provider:
            return
        if self.provider is not None:
            raise ServiceFailed(f"another client answers for {self.route.name} already")
        self._codecs.service(self.route.type)
        self._handle = self._node.serve(self.route.alias, self._on_request)
        self.provider = provider

    def unadvertise(self, provider: Provider) -> None:
        """Let it answer no longer; who waits is told. Blocks."""
        if self.provider is not provider:
            return
        self.provider = None
        if self._handle is not None:
            self._handle.close()
        for future in list(self._pending.values()):
            if not future.done():
                future.set_exception(ServiceFailed(f"nobody answers for {self.route.name} any more"))

    def answer(self, ident: str, values: Any, good: bool) -> None:
        """A client's service_response.

        Raises:
            ServiceFailed: to no request that waits.
            BadValue: the values do not fit; the request is told, too.
        """
        future = self._pending.get(ident)
        if future is None or future.done():
            raise ServiceFailed(f"no request {ident[:40]!r} of {self.route.name} waits for an answer")
        try:
            if not good:
                raise ServiceFailed(str(values)[:200] if values else f"{self.route.name} failed")
            future.set_result(self._codecs.service(self.route.type)[1].serialize(values if values is not None else {}))
        except TutelageError as error:
            future.set_exception(error)
            if good:
                raise

    def _on_request(self, message: Message) -> bytes:
        return self._ask_provider(bytes(message.payload), self.route.timeout)

    def _ask_fleet(self, data: bytes, timeout: float) -> bytes:
        return self._node.request(self.route.alias, data, timeout=timeout)

    def _ask_provider(self, data: bytes, timeout: float) -> bytes:
        provider = self.provider
        if provider is None or len(self._pending) >= MAX_PENDING:
            raise ServiceFailed(f"{self.route.name} is not being answered for")
        arguments = self._codecs.service(self.route.type)[0].values(data)
        self._number += 1
        ident = f"service:{self.route.name}:{self._number}:{time.monotonic_ns()}"
        future = self._pending[ident] = Future()
        try:
            provider.ask({"op": "call_service", "id": ident, "service": self.route.name, "args": arguments})
            return future.result(timeout)
        except FutureTimeout:
            raise ServiceFailed(f"the client that answers for {self.route.name} took longer than {timeout:g} s") from None
        finally:
            del self._pending[ident]

    def _fields(self, type_name: str) -> list[str]:
        return [name for name, _ in self._codecs.types.store.fielddefs[type_name][1]]


def _by_name(arguments: Any, serialize: Any, fields: list[str]) -> Any:
    if not isinstance(arguments, list):
        return arguments
    return dict(zip(fields, arguments, strict=False)) if len(arguments) <= len(fields) else arguments


def rosapi(name: str, arguments: Any, routes: Routes) -> dict[str, Any]:
    """The part of rosapi that clients use to look around: what the rosbridge carries.

    Raises:
        ServiceFailed: another part of rosapi.
    """
    topics = {route.name: route.type for route in routes.topics}
    services = {route.name: route.type for route in routes.services}
    given = next(iter(arguments.values()), "") if isinstance(arguments, dict) else ""
    seconds, rest = divmod(time.time_ns(), 10**9)
    now = {"sec": seconds, "nanosec": rest, "secs": seconds, "nsecs": rest}  # roslibpy asks for the names of ROS 1
    answers: dict[str, dict[str, Any]] = {
        "topics": {"topics": list(topics), "types": list(topics.values())},
        "topic_type": {"type": topics.get(str(given), "")},
        "topics_for_type": {"topics": [name for name, kind in topics.items() if kind == given]},
        "services": {"services": list(services)},
        "service_type": {"type": services.get(str(given), "")},
        "services_for_type": {"services": [name for name, kind in services.items() if kind == given]},
        "get_time": {"time": now},
        "get_ros_version": {"version": 2, "distro": routes.distribution},
    }
    asked = name.removeprefix("/rosapi/")
    if asked not in answers:
        raise ServiceFailed(f"{name} is not offered; of rosapi there are {', '.join(sorted(answers))}")
    return answers[asked]
