"""The seam between this package and the network: bytes under keys, nothing else. A transport is never trusted.

It may lose, repeat, reorder, delay or invent packets; what is built on it (`sealing`, `delivery`) holds whatever it does.
A key is chunks of letters, digits and hyphens with "/" between them, such as "75/e0/...0fc/stream"; in `subscribe` and
`watch` a chunk may be "*" and stands for any one chunk.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import Self

from tutelage.errors import ConfigError, TutelageError

MAX_PACKET = 64 << 20
"""Bytes of the largest packet that a transport has to carry."""

_KEY = re.compile(r"[A-Za-z0-9-]+(/[A-Za-z0-9-]+)*\Z")
_PATTERN = re.compile(r"(\*|[A-Za-z0-9-]+)(/(\*|[A-Za-z0-9-]+))*\Z")


lent: set[int] = set()
"""Threads of a transport, by identifier, that an application's callback has for the moment: they must not wait to send."""


class Congested(TutelageError):
    """The queue towards the network is full: the network is slower than the sender. Nothing was sent; try again later."""


class NoReply(TutelageError):
    """Nobody answered a request in time."""


class Handle:
    """Something that a transport does until it is told to stop. Closing twice is allowed."""

    def __init__(self, stop: Callable[[], None]) -> None:
        self._stop: Callable[[], None] | None = stop

    def close(self) -> None:
        """Stop."""
        stop, self._stop = self._stop, None
        if stop is not None:
            stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class Transport(ABC):
    """Publish, subscribe, request, reply and presence over keys. Safe to use from several threads.

    Callbacks run on the transport's threads. They must return at once and must not raise; `on_request` may take its time.

    Attributes:
        routed: do packets pass routers, which have rules of their own?
    """

    routed = True

    @property
    @abstractmethod
    def connected(self) -> bool:
        """Is there a connection to at least one router now?"""

    @abstractmethod
    def publish(self, key: str, payload: bytes | bytearray, *, reliable: bool = True) -> None:
        """Send to all subscribers. Without connection or subscribers the packet is lost.

        key: without wildcard.
        reliable: wait while the network is busy (at most the transport's stall limit); False: drop the packet instead.

        Raises:
            Congested: the network took nothing for longer than the limit.
        """

    @abstractmethod
    def subscribe(self, key: str, on_packet: Callable[[bytes], None]) -> Handle:
        """Call `on_packet` with each packet under the key, which may hold wildcards."""

    @abstractmethod
    def serve(self, key: str, on_request: Callable[[bytes], bytes | None], *, slow: bool = False) -> Handle:
        """Answer requests under the key; None: no answer.

        slow: answers take their time, so they get threads of their own, rather than those that all keys share.
        """

    @abstractmethod
    def request(self, key: str, payload: bytes | bytearray, timeout: float) -> bytes:
        """Ask whoever serves the key; the first answer counts.

        timeout: seconds.

        Raises:
            NoReply: no answer in that time.
        """

    @abstractmethod
    def announce(self, key: str) -> Handle:
        """Be present under the key until the handle is closed or the connection is lost."""

    @abstractmethod
    def watch(self, key: str, on_change: Callable[[str, bool], None]) -> Handle:
        """Call `on_change(key, present)` for each presence under the key, which may hold wildcards: those that are there
        already and every change. What has been told may be told again."""

    def renew(self) -> None:
        """The identity on disk has changed: use the new one from now on, without losing packets. May deliver some twice."""
        return

    @abstractmethod
    def close(self) -> None:
        """Close all handles and connections."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def check_key(key: str, *, wildcard: bool = False) -> str:
    """The key itself.

    Raises:
        ConfigError: characters that a key may not have.
    """
    if not (_PATTERN if wildcard else _KEY).match(key):
        raise ConfigError(f"a key is chunks of letters, digits and hyphens with '/' between, not {key!r}")
    return key


def matches(pattern: str, key: str) -> bool:
    """Does a key fall under a pattern, in which a chunk may be "*"?"""
    if "*" not in pattern:
        return pattern == key
    chunks, others = pattern.split("/"), key.split("/")
    return len(chunks) == len(others) and all(a in ("*", b) for a, b in zip(chunks, others, strict=True))
