"""What the clients of a rosbridge share: the fleet's topics, each subscribed once, each message converted once a form."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

from tutelage.sgc.access import Delivery
from tutelage.sgc.proxies.counts import Counts
from tutelage.sgc.proxies.latched import Newcomer
from tutelage.sgc.proxies.queues import LoopQueue
from tutelage.sgc.proxies.ros_types import RosTypes
from tutelage.sgc.proxies.ros_values import Codec
from tutelage.sgc.proxies.rosbridge_wire import dump_cbor, dump_json, dump_png
from tutelage.sgc.proxies.routes import TopicRoute
from tutelage.sgc.transport.base import Congested

if TYPE_CHECKING:
    from tutelage.sgc.messages import Message
    from tutelage.sgc.node import Node
    from tutelage.sgc.publisher import Publisher
    from tutelage.sgc.subscription import Subscription

_RETRY, _GIVE_UP = 0.005, 2.0  # seconds: who publishes faster than the network takes it is held back, then told


class Codecs:
    """Converters by type, made when first needed."""

    def __init__(self, types: RosTypes) -> None:
        self.types = types
        self._known: dict[str, Codec] = {}

    def __getitem__(self, type_name: str) -> Codec:
        if type_name not in self._known:
            self._known[type_name] = Codec(self.types, type_name)
        return self._known[type_name]

    def service(self, type_name: str) -> tuple[Codec, Codec]:
        """Of a service's requests and responses."""
        request, response = self.types.need_service(type_name)
        return self[request], self[response]


class Outgoing:
    """A message on its way to clients, in whatever form each of them wants."""

    def __init__(self, topic: Topic, data: bytes, received: float) -> None:
        self._topic, self._data, self._received = topic, data, received

    def frame(self, compression: str) -> str | bytes:
        """The rosbridge message of a compression: none, png, cbor or cbor-raw.

        Raises:
            BadMessage: the bytes are no message of the topic's type.
            ConfigError: the type is not known.
        """
        if compression == "none":
            return self._text
        if compression == "png":
            return self._png
        return self._cbor if compression == "cbor" else self._raw

    def _publish(self, message: Any) -> dict[str, Any]:
        return {"op": "publish", "topic": self._topic.route.name, "msg": message}

    @cached_property
    def _text(self) -> str:
        return dump_json(self._publish(self._topic.codec.values(self._data)))

    @cached_property
    def _png(self) -> str:
        return dump_json({"op": "png", "data": dump_png(self._text)})

    @cached_property
    def _cbor(self) -> bytes:
        return dump_cbor(self._publish(self._topic.codec.values(self._data, arrays=True)))

    @cached_property
    def _raw(self) -> bytes:
        seconds, rest = divmod(self._received, 1)
        raw = {"secs": int(seconds), "nsecs": int(rest * 1e9), "bytes": self._data}
        return dump_cbor(self._publish(raw))


class Listener(Protocol):
    """A client's subscription."""

    def offer(self, outgoing: Outgoing) -> None:
        """Here is a message. Called on the event loop."""


class Topic:
    """One of the fleet's topics, as the clients of this rosbridge share it. Lives on the event loop.

    Args:
        node: on the fleet's network.
        route: which topic.
        codecs: by type.
        loop: of the clients.
    """

    def __init__(self, node: Node, route: TopicRoute, codecs: Codecs, loop: asyncio.AbstractEventLoop) -> None:
        self.route = route
        self.counts = Counts("published", "received", "unreadable")
        self._node, self._codecs, self._loop = node, codecs, loop
        self._listeners: list[Listener] = []
        self._newcomer = Newcomer()
        self._latched: deque[Outgoing] = deque(maxlen=route.qos.depth)
        self._queue: LoopQueue[tuple[bytes, float]] = LoopQueue(route.queue, loop)
        # While we wait, the node holds back, and fetches again what it could not hold; lossy topics move on.
        reliable = node.access.entry(route.alias).rule.delivery is Delivery.RELIABLE
        self._patience = _GIVE_UP if reliable else 0.0
        self._subscription: Subscription | None = None
        self._task: asyncio.Task[None] | None = None
        self._publisher: Publisher | None = None

    @property
    def codec(self) -> Codec:
        """Of the topic's type.

        Raises:
            ConfigError: the type is not known.
        """
        return self._codecs[self.route.type]

    @property
    def dropped(self) -> int:
        """Messages that came faster than they could be converted."""
        return self._queue.dropped

    @property
    def is_latched(self) -> bool:
        """Does a late subscription get the last messages? Then they are fetched even while nobody listens."""
        return self.route.inward and self.route.qos.durability == "transient_local"

    def start(self) -> None:
        """Fetch a latched topic. On the event loop."""
        if self.is_latched:
            self._open()

    def add(self, listener: Listener) -> None:
        """Let a subscription hear what comes; the first one subscribes to the fleet's topic.

        Raises:
            NotAllowed: the policy does not let this node subscribe.
        """
        self._open()
        for outgoing in self._latched:
            listener.offer(outgoing)
        self._listeners.append(listener)

    def remove(self, listener: Listener) -> Callable[[], None] | None:
        """Let it hear no more. If it was the last one: what ends the subscription; it may block, so not on the loop."""
        if listener in self._listeners:
            self._listeners.remove(listener)
        if self._listeners or self._subscription is None or self.is_latched:
            return None
        close, self._subscription = self._subscription.close, None
        if self._task is not None:
            self._task.cancel()
        return close

    async def publish(self, data: bytes) -> None:
        """Send a message to the fleet and, without that way round, to the clients here.

        Raises:
            NotAllowed, Congested, NoKey: see `Publisher.send`; Congested after some time of trying.
        """
        until = self._loop.time() + _GIVE_UP
        while self._subscription is not None and self._queue.full and self._loop.time() < until:
            await asyncio.sleep(_RETRY)
        if self._publisher is None:
            self._publisher = self._node.publisher(self.route.alias)
        while True:
            try:
                self._publisher.send(data)
                break
            except Congested:
                if self._loop.time() > until:
                    raise
            await asyncio.sleep(_RETRY)
        self.counts.add("published")
        if self._subscription is not None:
            self._queue.put((data, 0.0))

    async def close(self) -> None:
        """End the subscription, whoever listens."""
        self._listeners.clear()
        if self._task is not None:
            self._task.cancel()
        if self._subscription is not None:
            await asyncio.to_thread(self._subscription.close)

    def _open(self) -> None:
        if self._subscription is None:
            self._newcomer = Newcomer()
            self._subscription = self._node.subscribe(self.route.alias, self._on_message, queue=self.route.queue)
            self._task = self._loop.create_task(self._deliver())

    def _on_message(self, message: Message) -> None:
        if message.sender != self._node.name:
            for data in self._newcomer.accept(message.sender, bytes(message.payload)):
                self._queue.put((data, message.received), self._patience)

    async def _deliver(self) -> None:
        while True:
            data, received = await self._queue.get()
            self.counts.add("received")
            outgoing = Outgoing(self, data, received)
            if self.is_latched:
                self._latched.append(outgoing)
            for listener in tuple(self._listeners):
                listener.offer(outgoing)
            await asyncio.sleep(0)  # a fast topic leaves room for the others
