"""What each call of the gRPC gateway does. All of it runs on the gateway's event loop."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeout
from typing import TYPE_CHECKING, Any

import grpc

from tutelage.errors import ConfigError, TutelageError
from tutelage.sgc.access import Delivery, Kind, Lane
from tutelage.sgc.errors import NoKey, NotAllowed
from tutelage.sgc.proxies.counts import Counts
from tutelage.sgc.proxies.grpc_messages import messages
from tutelage.sgc.proxies.latched import Newcomer
from tutelage.sgc.proxies.queues import LoopQueue
from tutelage.sgc.transport.base import Congested, NoReply

if TYPE_CHECKING:
    from tutelage.sgc.messages import Message
    from tutelage.sgc.node import Node

MAX_QUEUE = 10_000
DEFAULT_QUEUE = 64
REQUEST_TIMEOUT = 2.0
ANSWER_TIMEOUT = 30.0
_RETRY = 0.002  # seconds
_BLOCKING = 64  # requests and answers that may be under way

_STATUS = {
    NotAllowed: grpc.StatusCode.PERMISSION_DENIED,
    NoKey: grpc.StatusCode.UNAVAILABLE,
    Congested: grpc.StatusCode.RESOURCE_EXHAUSTED,
    NoReply: grpc.StatusCode.DEADLINE_EXCEEDED,
    ConfigError: grpc.StatusCode.INVALID_ARGUMENT,
}


class ServeFailed(TutelageError):
    """The program that answers for a service failed, or took too long; the requester is told."""


class Calls:
    """The gateway's methods, by their names in tutelage.proto.

    Args:
        node: on the fleet's network.
        loop: the gateway's.
    """

    def __init__(self, node: Node, loop: asyncio.AbstractEventLoop) -> None:
        self.counts = Counts("published", "delivered", "dropped", "requests", "answers", "failed")
        self._node, self._loop = node, loop
        self._types = messages()
        self._serving: set[str] = set()
        self._pool = ThreadPoolExecutor(_BLOCKING, thread_name_prefix="grpc-call")

    def close(self) -> None:
        """Wait for nothing any more."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    async def publish(self, request: Any, context: Any) -> Any:
        """One message."""
        async with self._errors(context):
            self._node.publisher(request.topic).send(request.payload)
            self.counts.add("published")
        return self._types["PublishReply"](sent=1)

    async def publish_stream(self, requests: AsyncIterator[Any], context: Any) -> Any:
        """Many; while the network is busy, nothing more is read from the client."""
        sent = 0
        async with self._errors(context):
            async for request in requests:
                publisher = self._node.publisher(request.topic)
                while True:
                    try:
                        publisher.send(request.payload)
                        break
                    except Congested:
                        await asyncio.sleep(_RETRY)
                sent += 1
                self.counts.add("published")
        return self._types["PublishReply"](sent=sent)

    async def subscribe(self, request: Any, context: Any) -> AsyncIterator[Any]:
        """Messages until the client cancels."""
        async with self._errors(context):
            if request.queue > MAX_QUEUE:
                raise ConfigError(f"a queue holds {MAX_QUEUE} messages at most, not {request.queue}")
            queue: LoopQueue[Message] = LoopQueue(request.queue or DEFAULT_QUEUE, self._loop)
            reliable = self._node.access.entry(request.topic).rule.delivery is Delivery.RELIABLE
            newcomer = Newcomer()
            over = False

            def on_message(message: Message) -> None:
                for payload in newcomer.accept(message.sender, bytes(message.payload)):
                    each = message._replace(payload=payload)
                    if not reliable:
                        queue.put(each)
                    while reliable and not over and not queue.offer(each, 0.2):
                        pass  # the node holds back meanwhile, and fetches later what it cannot hold

            subscription = self._node.subscribe(request.topic, on_message, queue=request.queue or None)
            # The client knows from these headers that it will miss nothing from here on.
            await context.send_initial_metadata(())
            make = self._types["Message"]
            try:
                while True:
                    message = await queue.get()
                    yield make(
                        topic=message.topic,
                        payload=message.payload,
                        sender=message.sender,
                        sequence=message.sequence,
                        sent=message.sent,
                        received=message.received,
                        authentic=message.authentic,
                    )
                    self.counts.add("delivered")
            finally:
                over = True
                self.counts.add("dropped", queue.dropped)
                await asyncio.shield(asyncio.to_thread(subscription.close))

    async def request(self, request: Any, context: Any) -> Any:
        """Ask a service."""
        async with self._errors(context):
            self.counts.add("requests")
            timeout = request.timeout if 0 < request.timeout < 86_400 else REQUEST_TIMEOUT
            asked = self._loop.run_in_executor(
                self._pool, lambda: self._node.request(request.service, request.payload, timeout=timeout)
            )
            return self._types["ServiceReply"](payload=await asked)

    async def serve(self, answers: AsyncIterator[Any], context: Any) -> AsyncIterator[Any]:
        """Calls for the client to answer, until it cancels."""
        async with self._errors(context):
            first = await anext(answers, None)
            alias = first.service if first is not None else ""
            if alias in self._serving:
                await context.abort(grpc.StatusCode.ALREADY_EXISTS, f"another program answers for {alias}")
            served = _Served(alias, first.timeout if first is not None and first.timeout > 0 else ANSWER_TIMEOUT, self)
            self._serving.add(alias)
            try:
                handle = await asyncio.to_thread(self._node.serve, alias, served.on_request)
                reading = self._loop.create_task(served.read(answers))
                await context.send_initial_metadata(())
                try:
                    while True:
                        yield await served.calls.get()
                finally:
                    reading.cancel()
                    served.end()
                    await asyncio.shield(asyncio.to_thread(handle.close))
            finally:
                self._serving.discard(alias)

    async def peers(self, request: Any, context: Any) -> Any:
        """Who is there."""
        async with self._errors(context):
            present = await self._loop.run_in_executor(self._pool, self._node.peers)
            access = self._node.access
            topics = []
            for alias, entry in access.topics.items():
                rule = entry.rule
                lane = Lane.REQUEST if rule.kind is Kind.SERVICE else Lane.STREAM
                topics.append(
                    self._types["TopicInfo"](
                        alias=alias,
                        interface=rule.topic.interface,
                        type=rule.topic.type,
                        service=rule.kind is Kind.SERVICE,
                        may_send=rule.may_send(access.node, lane),
                        may_receive=rule.may_receive(access.node, lane),
                    )
                )
            peers = [self._types["Peer"](name=p.name, topics=p.topics, round_trip=p.round_trip) for p in present]
            return self._types["PeersReply"](node=self._node.name, peers=peers, topics=topics)

    @contextlib.asynccontextmanager
    async def _errors(self, context: Any) -> AsyncIterator[None]:
        """Errors that a client can act on become its status."""
        try:
            yield
        except TutelageError as error:
            self.counts.add("failed")
            status = next((code for kind, code in _STATUS.items() if isinstance(error, kind)), grpc.StatusCode.ABORTED)
            await context.abort(status, str(error))


class _Served:
    """A service that a client answers for."""

    def __init__(self, alias: str, timeout: float, calls: Calls) -> None:
        self._alias, self._timeout, self._owner = alias, timeout, calls
        self._types = messages()
        self._pending: dict[int, Future[bytes]] = {}
        self._number = 0
        self._ended = False
        self.calls: LoopQueue[Any] = LoopQueue(MAX_QUEUE, calls._loop)

    def on_request(self, message: Message) -> bytes:
        """On the node's threads: wait for the client's answer."""
        if self._ended or len(self._pending) >= MAX_QUEUE:
            raise ServeFailed(f"nobody answers for {self._alias} now")
        self._number += 1
        number = self._number
        future = self._pending[number] = Future()
        try:
            self.calls.put(self._types["Call"](id=number, payload=message.payload, sender=message.sender))
            answer = future.result(self._timeout)
        except FutureTimeout:
            raise ServeFailed(f"the program that answers for {self._alias} took longer than {self._timeout:g} s") from None
        finally:
            del self._pending[number]
        self._owner.counts.add("answers")
        return answer

    async def read(self, answers: AsyncIterator[Any]) -> None:
        """Take the client's answers."""
        async for answer in answers:
            future = self._pending.get(answer.id)
            if future is None or future.done():
                continue  # too late
            if answer.WhichOneof("result") == "error":
                future.set_exception(ServeFailed(answer.error[:500]))
            else:
                future.set_result(answer.payload)

    def end(self) -> None:
        """The client has gone; who waits is told."""
        self._ended = True
        for future in list(self._pending.values()):
            if not future.done():
                future.set_exception(ServeFailed(f"the program that answered for {self._alias} has gone"))
