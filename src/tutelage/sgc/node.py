"""A node on the network: publish, subscribe, request and serve by alias, sealed end to end.

with Node.open(Path("drone-1")) as node:
    camera = node.publisher("camera")
    camera.send(jpeg)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tutelage.sgc.access import Access
from tutelage.sgc.home import Home
from tutelage.sgc.messages import Message
from tutelage.sgc.transport.base import Handle, Transport


class Publisher:
    """Sends the messages of one topic. Safe to use from several threads."""

    def send(self, payload: bytes | bytearray | memoryview) -> None:
        """Queue a message. An idle publisher sends it before this returns; a busy one seals what queued up in batches.

        Lossy topics: a message that is still queued when the next one comes is replaced.

        Raises:
            Congested: reliable topics: the queue is full, as the network is slower than the sender. Nothing was queued.
            NoKey: the topic's key has not come from its owner yet.
        """
        raise NotImplementedError

    def flush(self, timeout: float) -> bool:
        """Wait until everything queued has been handed to the transport; False: it was not within `timeout` seconds."""
        raise NotImplementedError

    def close(self) -> None:
        """Send what is queued, then stop."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class Subscription:
    """Receives the messages of one topic, in order and each once, on its own thread. Iterate if there is no callback."""

    def __iter__(self) -> Iterator[Message]:
        """Messages as they come, until the subscription is closed. For subscriptions without callback."""
        raise NotImplementedError

    def receive(self, timeout: float | None = None) -> Message | None:
        """The next message; None: none came within `timeout` seconds. For subscriptions without callback."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop; a callback that runs ends first."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


@dataclass(frozen=True)
class Peer:
    """Another node that is present.

    Attributes:
        name: of the node.
        topics: aliases of topics that it shares with us.
        round_trip: seconds of the last ping, None before the first.
    """

    name: str
    topics: tuple[str, ...]
    round_trip: float | None


class Node:
    """One per program. Everything it starts ends with `close`."""

    home: Home

    @classmethod
    def open(cls, home: Path | Home, transport: Transport | None = None) -> Node:
        """Come up, with or without a network: topics work as soon as a router and the topic's key are there.

        home: the node's folder (`tutelage keys`).
        transport: None: Zenoh, as the folder's `network.toml` says. A transport that is given is not closed by `close`.

        Raises:
            KeysError, NotIssued, ConfigError: the folder, certificate or `network.toml` cannot be used.
            MissingExtraError: a package of the extra sgc is missing.
        """
        raise NotImplementedError

    @property
    def name(self) -> str:
        """Of this node."""
        raise NotImplementedError

    @property
    def access(self) -> Access:
        """What this node may do: `access.topics` by alias."""
        raise NotImplementedError

    @property
    def connected(self) -> bool:
        """Is there a connection to a router?"""
        raise NotImplementedError

    def publisher(self, alias: str) -> Publisher:
        """The publisher of a topic; the same one each time, until it is closed.

        Raises:
            NotAllowed: the policy does not let this node publish there.
        """
        raise NotImplementedError

    def subscribe(self, alias: str, on_message: Callable[[Message], None] | None = None, *, queue: int = 64) -> Subscription:
        """Receive a topic's messages.

        on_message: called on a thread of the subscription's own; may take its time. An exception is logged and counted.
        queue: messages that may wait for the application. Beyond: on a reliable topic, the rest is fetched again from the
            publisher when there is room; on a lossy one the newest win.

        Raises:
            NotAllowed: the policy does not let this node subscribe there.
        """
        raise NotImplementedError

    def request(self, alias: str, payload: bytes, timeout: float = 2.0) -> bytes:
        """Ask a service. Blocks.

        Raises:
            NotAllowed: the policy does not let this node request there.
            NoReply: nobody answered in time.
            RequestFailed: the handler raised; the message is its own.
        """
        raise NotImplementedError

    def serve(self, alias: str, handler: Callable[[Message], bytes]) -> Handle:
        """Answer a service's requests; each is handled once, on one of a few threads. An exception becomes RequestFailed.

        Raises:
            NotAllowed: the policy does not let this node serve there.
        """
        raise NotImplementedError

    def peers(self) -> list[Peer]:
        """Who else is present on the topics of this node."""
        raise NotImplementedError

    def counters(self) -> dict[str, Any]:
        """Everything that is counted, as a tree of numbers: topics/<alias>/sent, received, lost, refused/<reason>, ..."""
        raise NotImplementedError

    def close(self) -> None:
        """Close publishers, subscriptions, services and, if `open` made it, the transport."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
