"""One client of a rosbridge: its operations, each checked. Whatever it sends, the answer is at worst a status message."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from tutelage.errors import TutelageError
from tutelage.sgc.proxies.ros_names import full_name, full_type
from tutelage.sgc.proxies.rosbridge_outbox import ClientSubscription, Outbox, TooSlow
from tutelage.sgc.proxies.rosbridge_requests import MAX_ID, BadRequest, ident_of, parse, text_of, wish_of
from tutelage.sgc.proxies.rosbridge_services import Service, ServiceFailed, rosapi
from tutelage.sgc.proxies.rosbridge_topics import Topic
from tutelage.sgc.proxies.rosbridge_wire import Defragmenter, dump_json

if TYPE_CHECKING:
    from tutelage.sgc.proxies.rosbridge import Bridge

LEVELS = ("none", "error", "warning", "info")
MAX_CALLS = 32
"""Service calls of one client that may be under way."""
MAX_WISHES = 64
"""Subscriptions that one client may hold on one topic."""


class Session:
    """Lives on the bridge's event loop.

    Args:
        bridge: whose client this is.
    """

    def __init__(self, bridge: Bridge) -> None:
        self.outbox = Outbox()
        self._bridge = bridge
        self._level = "error"
        self._subscriptions: dict[str, ClientSubscription] = {}
        self._advertised: set[str] = set()
        self._calls: set[asyncio.Task[None]] = set()
        self._fragments = Defragmenter(bridge.max_message)
        self._operations: dict[str, Callable[[dict[str, Any]], Awaitable[None]]] = {
            "advertise": self._advertise,
            "unadvertise": self._unadvertise,
            "publish": self._publish,
            "subscribe": self._subscribe,
            "unsubscribe": self._unsubscribe,
            "call_service": self._call_service,
            "advertise_service": self._advertise_service,
            "unadvertise_service": self._unadvertise_service,
            "service_response": self._service_response,
            "fragment": self._fragment,
            "set_level": self._set_level,
            "status": self._status,
        }

    async def handle(self, frame: str | bytes) -> None:
        """Obey one frame.

        Raises:
            TooSlow: the client does not read its answers.
        """
        try:
            message = parse(frame)
        except BadRequest as error:
            self._bridge.counts.add("refused")
            self.status("error", str(error))
        else:
            await self._obey(message)

    async def _obey(self, message: dict[str, Any]) -> None:
        try:
            operation = self._operations.get(message["op"])
            if operation is None:
                known = ", ".join(sorted(self._operations))
                raise BadRequest(f"unknown operation {message['op'][:40]!r}; there are {known}")
            await operation(message)
        except TutelageError as error:
            self._bridge.counts.add("refused")
            self.status("error", str(error), ident_of(message))

    def status(self, level: str, text: str, ident: Any = None) -> None:
        """Tell the client, if it wants to know things of that level.

        Raises:
            TooSlow: see `handle`.
        """
        if LEVELS.index(level) <= LEVELS.index(self._level):
            self._reply({"op": "status", "level": level, "msg": text}, ident)

    def ask(self, message: dict[str, Any]) -> None:
        """Send a call_service message. From any thread; see `rosbridge_services.Provider`."""
        self._bridge.loop.call_soon_threadsafe(self._ask, message)

    async def close(self) -> None:
        """The client has gone: take back what it had asked for."""
        for task in self._calls:
            task.cancel()
        for name in list(self._subscriptions):
            await self._drop(name)
        for service in self._bridge.services.values():
            if service.provider is self:
                await asyncio.to_thread(service.unadvertise, self)

    def _reply(self, message: dict[str, Any], ident: Any) -> None:
        self.outbox.control(dump_json(message if ident is None else {**message, "id": ident}))

    def _ask(self, message: dict[str, Any]) -> None:
        try:
            self.outbox.control(dump_json(message))
        except TooSlow:  # the service's timeout tells who asked
            self._bridge.counts.add("refused")

    # --- topics

    def _topic(self, message: dict[str, Any]) -> Topic:
        name = full_name(text_of(message, "topic"))
        topic = self._bridge.topics.get(name)
        if topic is None:
            raise BadRequest(f"there is no topic {name} here; there are {', '.join(self._bridge.topics) or 'none'}")
        given = message.get("type")
        if given is not None and full_type(text_of(message, "type")) != topic.route.type:
            raise BadRequest(f"topic {name} is of type {topic.route.type}, not {given}")
        return topic

    async def _advertise(self, message: dict[str, Any]) -> None:
        topic = self._topic(message)
        self._may_publish(topic)
        text_of(message, "type")
        self._advertised.add(topic.route.name)
        self.status("info", f"{topic.route.name} is advertised", ident_of(message))

    async def _unadvertise(self, message: dict[str, Any]) -> None:
        name = self._topic(message).route.name
        if name not in self._advertised:
            self.status("warning", f"{name} was not advertised", ident_of(message))
        self._advertised.discard(name)

    async def _publish(self, message: dict[str, Any]) -> None:
        topic = self._topic(message)
        self._may_publish(topic)
        await topic.publish(topic.codec.serialize(message.get("msg", {})))  # until that is done, nothing more is read

    def _may_publish(self, topic: Topic) -> None:
        if not topic.route.outward:
            raise BadRequest(f"clients may not publish on {topic.route.name}: the policy or the routes do not allow it")

    async def _subscribe(self, message: dict[str, Any]) -> None:
        topic = self._topic(message)
        if not topic.route.inward:
            raise BadRequest(f"clients may not subscribe to {topic.route.name}: the policy or the routes do not allow it")
        wish = wish_of(message)
        if wish.compression != "cbor-raw":
            _ = topic.codec  # now, not with each message: is the type known?
        subscription = self._subscriptions.get(topic.route.name)
        if subscription is None:
            subscription = ClientSubscription(topic, self.outbox, self._bridge.loop)
            topic.add(subscription)
            self._subscriptions[topic.route.name] = subscription
        elif len(subscription.wishes) >= MAX_WISHES:
            raise BadRequest(f"more than {MAX_WISHES} subscriptions to {topic.route.name}")
        subscription.wish(ident_of(message), wish)
        self.status("info", f"subscribed to {topic.route.name}", ident_of(message))

    async def _unsubscribe(self, message: dict[str, Any]) -> None:
        name = self._topic(message).route.name
        if name not in self._subscriptions:
            self.status("warning", f"not subscribed to {name}", ident_of(message))
        elif self._subscriptions[name].forget(ident_of(message)):
            await self._drop(name)

    async def _drop(self, name: str) -> None:
        subscription = self._subscriptions.pop(name)
        subscription.close()
        finish = subscription.topic.remove(subscription)
        if finish is not None:
            await asyncio.to_thread(finish)

    # --- services

    def _service(self, message: dict[str, Any]) -> Service:
        name = full_name(text_of(message, "service"))
        service = self._bridge.services.get(name)
        if service is None:
            raise BadRequest(f"there is no service {name} here; there are {', '.join(self._bridge.services) or 'none'}")
        given = message.get("type")
        if given is not None and full_type(text_of(message, "type"), "srv") != service.route.type:
            raise BadRequest(f"service {name} is of type {service.route.type}, not {given}")
        return service

    async def _call_service(self, message: dict[str, Any]) -> None:
        if len(self._calls) >= MAX_CALLS:
            raise BadRequest(f"more than {MAX_CALLS} service calls at a time")
        task = self._bridge.loop.create_task(self._call(message))
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)

    async def _call(self, message: dict[str, Any]) -> None:
        name = str(message.get("service"))[:MAX_ID]
        reply: dict[str, Any] = {"op": "service_response", "service": name, "result": True}
        arguments = message.get("args", {})
        try:
            if full_name(text_of(message, "service")).startswith("/rosapi/"):
                reply["values"] = rosapi(full_name(name), arguments, self._bridge.routes)
            else:
                timeout = message.get("timeout")
                limit = timeout if isinstance(timeout, int | float) and 0 < timeout < 86_400 else None
                reply["values"] = await self._service(message).call(arguments, limit)
        except TutelageError as error:
            self._bridge.counts.add("refused")
            reply.update(result=False, values=str(error))
        try:
            self._reply(reply, ident_of(message))
        except TooSlow:
            self._bridge.counts.add("refused")

    async def _advertise_service(self, message: dict[str, Any]) -> None:
        service = self._service(message)
        if not service.route.outward:
            raise BadRequest(f"clients may not answer for {service.route.name}: the policy or the routes do not allow it")
        await asyncio.to_thread(service.advertise, self)

    async def _unadvertise_service(self, message: dict[str, Any]) -> None:
        service = self._service(message)
        if service.provider is not self:
            self.status("warning", f"{service.route.name} was not advertised", ident_of(message))
        await asyncio.to_thread(service.unadvertise, self)

    async def _service_response(self, message: dict[str, Any]) -> None:
        service = self._service(message)
        if service.provider is not self:
            raise ServiceFailed(f"{service.route.name} is not answered for by this client")
        service.answer(str(ident_of(message)), message.get("values"), message.get("result") is not False)

    # --- the protocol itself

    async def _fragment(self, message: dict[str, Any]) -> None:
        try:
            text = self._fragments.add(message)
        except ValueError as error:
            raise BadRequest(str(error)) from None
        if text is not None:
            inner = parse(text)
            if inner["op"] == "fragment":
                raise BadRequest("fragments within fragments")
            await self._obey(inner)

    async def _set_level(self, message: dict[str, Any]) -> None:
        level = message.get("level")
        if level not in LEVELS:
            raise BadRequest(f"level must be one of {', '.join(LEVELS)}")
        self._level = level

    async def _status(self, message: dict[str, Any]) -> None:
        """A client's own status messages need no answer."""
