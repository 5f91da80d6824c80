"""What both kinds of sockets share: who may open one, limits, and ending it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from tutelage.console.accounts import Session
from tutelage.console.context import Context, log
from tutelage.console.limits import Bucket
from tutelage.console.messages import LONGEST, MalformedError
from tutelage.console.plain import text
from tutelage.console.security import COOKIE, deny_socket

SILENT = 5.0
"""Seconds without a message after which a client is gone."""
FLOOD_END = 1000
"""How many messages too many end the socket."""
MALFORMED_END = 20
OPEN_MAX, OPEN_MAX_EACH = 512, 8
"""Sockets of a kind, in all and of one account."""
CHECK_EVERY = 0.5


class Socket(ABC):
    """One WebSocket of somebody who is logged in. Subclasses say what is received and sent."""

    open_now: Counter[str]
    """How many sockets of this kind each account has."""
    silent = SILENT
    flood = 150.0, 300
    """Messages a second, and at once."""

    def __init__(self, websocket: WebSocket, context: Context, session: Session) -> None:
        self.websocket, self.context, self.session, self.name = websocket, context, session, session.name
        self.wake = asyncio.Event()
        self._heard = time.monotonic()
        self._bucket, self._too_many, self._malformed = Bucket(*self.flood), 0, 0
        self._end: tuple[int, str] | None = None

    @abstractmethod
    async def received(self, message: str) -> None:
        """A message. Raises MalformedError."""

    @abstractmethod
    async def send_what_waits(self) -> float | None:
        """Send; returns after how many seconds to try again though nothing woke it, or None."""

    @abstractmethod
    def refuse(self, code: str, why: str, ref: int | str | None = None) -> None:
        """Say that something was not done."""

    async def begin(self) -> None:  # noqa: B027 - may do nothing
        """The socket is open."""

    async def finish(self) -> None:  # noqa: B027 - may do nothing
        """The socket is closed."""

    async def check(self) -> None:  # noqa: B027 - may do nothing
        """Twice a second."""

    def end(self, code: int, why: str) -> None:
        """Close it soon."""
        if self._end is None:
            self._end = code, why
        self.wake.set()

    def more(self) -> Sequence[Callable[[], Coroutine[Any, Any, None]]]:
        """What else goes on while the socket is open."""
        return ()

    def exempt(self, message: str) -> bool:
        """Whether a message is read even in a flood."""
        return False

    async def serve(self) -> None:
        """Until it ends."""
        await self.websocket.accept()
        type(self).open_now[self.name] += 1
        tasks: list[asyncio.Task[None]] = []
        try:
            await self.begin()
            tasks = [asyncio.create_task(part()) for part in (self._receive, self._send, self._check, *self.more())]
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        except WebSocketDisconnect:
            pass
        except Exception:
            log.exception("a socket of %s failed", self.name)
            self.end(1011, "an error of the server")
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            type(self).open_now[self.name] -= 1
            if not type(self).open_now[self.name]:
                del type(self).open_now[self.name]
            await self.finish()
            await self._close()

    async def _receive(self) -> None:
        while True:
            event = await self.websocket.receive()
            if event["type"] != "websocket.receive":
                return
            self._heard = time.monotonic()
            message = event.get("text")
            try:
                if message is None:
                    raise MalformedError("text, not bytes")
                if len(message) > LONGEST:
                    raise MalformedError("too long")
                if not self._bucket.take() and not self.exempt(message):
                    self._too_many += 1
                    if self._too_many == 1 or self._too_many % 100 == 0:
                        self.refuse("too_many", f"more than {self.flood[0]:.0f} messages a second; the rest is not read")
                    if self._too_many >= FLOOD_END:
                        self.end(1008, "a flood of messages")
                        return
                    continue
                await self.received(message)
            except MalformedError as error:
                self._malformed += 1
                self.refuse("malformed", error.text)
                if self._malformed >= MALFORMED_END:
                    self.end(1008, "too many malformed messages")
                    return

    async def _send(self) -> None:
        again: float | None = None
        while self._end is None:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self.wake.wait(), again)
            self.wake.clear()
            again = await self.send_what_waits()

    async def _check(self) -> None:
        while self._end is None:
            await asyncio.sleep(CHECK_EVERY)
            if time.monotonic() - self._heard > self.silent:
                self.end(4408, "nothing came for a while")
                return
            now = self.context.accounts.session_of(self.session.key)
            if now is None:
                self.end(4401, "the session is over")
                return
            if now.role is not self.session.role:
                self.end(4403, "another role")
                return
            await self.check()

    async def _close(self) -> None:
        code, why = self._end or (1000, "")
        with contextlib.suppress(RuntimeError, TimeoutError, WebSocketDisconnect):  # it may be closed already
            await asyncio.wait_for(self.websocket.close(code, why), 1.0)


async def admit(websocket: WebSocket, context: Context, kind: type[Socket]) -> Session | None:
    """Who opens a socket; None: it was refused."""
    token = websocket.cookies.get(COOKIE)
    session = context.accounts.session(token) if token else None
    if session is None:
        status, why = 401, "log in first"
    elif kind.open_now[session.name] >= OPEN_MAX_EACH or kind.open_now.total() >= OPEN_MAX:
        status, why = 429, "too many sockets"
    else:
        return session
    await websocket.receive()  # websocket.connect
    await deny_socket(websocket.scope, websocket.send, status, why)
    return None


def error(code: str, why: str, ref: int | str | None = None) -> str:
    """The message `error`."""
    return text({"type": "error", "code": code, "text": why, "ref": ref})
