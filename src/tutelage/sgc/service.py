"""Requests and replies, sealed both ways. A reply is bound to its request; a request is handled at most once.

What travels between the sealed packets is one byte of status, which is not trusted: it only tells a requester to introduce
itself and ask again. The identifier inside the sealed request keeps a repeated question from being handled twice.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from enum import IntEnum

from tutelage.errors import TutelageError
from tutelage.sgc.errors import NoKey
from tutelage.sgc.messages import Message
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.sealing import Opener, Sealer, ident
from tutelage.sgc.transport.base import NoReply, Transport

log = logging.getLogger(__name__)

REMEMBERED = 4096
"""Requests that a server recognises when they come again."""

_IDENTIFIER = 8
_PAUSE = 0.05


class RequestFailed(TutelageError):
    """The handler of a request raised; the message is the handler's."""


class Status(IntEnum):
    """First byte of what a server sends back."""

    SEALED = 0
    STRANGER = 1  # the server does not know the requester's credential (yet)
    NO_KEY = 2  # the request is sealed under a key that the server does not have (yet)


class Outcome(IntEnum):
    """First byte of a sealed reply."""

    DONE = 0
    FAILED = 1


class Requester:
    """Asks one service. Safe to use from several threads."""

    def __init__(
        self, alias: str, key: str, sealer: Sealer, opener: Opener, transport: Transport, need_key: Callable[[], None]
    ) -> None:
        self.alias = alias
        self.opener = opener
        self.sent = self.failed = self.unanswered = 0
        self._key = key
        self._sealer = sealer
        self._transport = transport
        self._need_key = need_key
        self._lock = threading.Lock()
        self._acquainted = False  # have we understood a reply of this service yet?

    def request(self, payload: bytes, timeout: float) -> Message:
        """Ask, and wait for the reply; see `Node.request`."""
        until = time.monotonic() + timeout
        body = os.urandom(_IDENTIFIER) + bytes([self._acquainted]) + payload
        self.sent += 1
        why = f"nobody answered {self.alias} within {timeout:g} s"
        while (left := until - time.monotonic()) > 0:
            try:
                packet = self._sealer.seal(body)
            except NoKey as error:
                self._need_key()
                why = str(error)
                time.sleep(min(_PAUSE, left))
                continue
            try:
                reply = self._transport.request(self._key, packet, left)
            except NoReply:
                time.sleep(max(0.0, min(_PAUSE, until - time.monotonic())))  # no server yet, or no connection
                continue
            status = reply[0] if reply else Status.SEALED
            if status == Status.SEALED:
                return self._read(reply[1:], ident(packet))
            why = f"a server of {self.alias} answered, but it does not know us or our key yet"
            self._sealer.introduce()
            self._need_key()
            time.sleep(max(0.0, min(_PAUSE, until - time.monotonic())))
        self.unanswered += 1
        raise NoReply(why)

    def _read(self, reply: bytes, bind: bytes) -> Message:
        received = time.time()
        try:
            opened = self.opener.open(reply, bind=bind)
        except Refused as refused:
            self.unanswered += 1
            raise NoReply(f"the reply of {self.alias} was refused: {refused}") from None
        self._acquainted = True
        body = bytes(opened.payload)
        if body[:1] == bytes([Outcome.DONE]):
            return Message(body[1:], opened.sender, self.alias, opened.sequence, opened.sent * 1e-9, received)
        self.failed += 1
        raise RequestFailed(f"{opened.sender} could not serve {self.alias}: {body[1:].decode(errors='replace')}")


class Server:
    """Answers one service. `answer` may run on several threads at a time."""

    def __init__(self, alias: str, sealer: Sealer, opener: Opener, handler: Callable[[Message], bytes]) -> None:
        self.alias = alias
        self.opener = opener
        self.received = self.failed = 0
        self._sealer = sealer
        self._handler = handler
        self._lock = threading.Lock()
        self._handled: set[tuple[str, bytes]] = set()
        self._order: deque[tuple[str, bytes]] = deque()

    def answer(self, packet: bytes) -> bytes | None:
        """The reply to a request; None: it is refused, and counted."""
        received = time.time()
        try:
            with self._lock:
                opened = self.opener.open(packet)
                body = bytes(opened.payload)
                if len(body) <= _IDENTIFIER:
                    self.opener.refusals.add(Reason.MALFORMED)
                    return None
                if not self._is_new((opened.sender, body[:_IDENTIFIER])):
                    self.opener.refusals.add(Reason.REPLAYED)
                    return None
        except Refused as refused:
            if refused.reason == Reason.UNKNOWN_SENDER:
                return bytes([Status.STRANGER])
            return bytes([Status.NO_KEY]) if refused.reason == Reason.UNKNOWN_EPOCH else None
        self.received += 1
        message = Message(body[_IDENTIFIER + 1 :], opened.sender, self.alias, opened.sequence, opened.sent * 1e-9, received)
        try:
            result = bytes([Outcome.DONE]) + self._handler(message)
        except Exception as error:
            self.failed += 1
            log.exception("the handler of %s", self.alias)
            result = bytes([Outcome.FAILED]) + f"{type(error).__name__}: {error}".encode()[:1000]
        try:
            with self._lock:
                if not body[_IDENTIFIER]:
                    self._sealer.introduce()  # a first-time requester cannot verify our reply otherwise
                return bytes([Status.SEALED]) + self._sealer.seal(result, bind=opened.ident)
        except TutelageError as error:
            log.warning("a reply of %s could not be sealed: %s", self.alias, error)
            return None

    def _is_new(self, request: tuple[str, bytes]) -> bool:
        if request in self._handled:
            return False
        self._handled.add(request)
        self._order.append(request)
        if len(self._order) > REMEMBERED:
            self._handled.discard(self._order.popleft())
        return True
