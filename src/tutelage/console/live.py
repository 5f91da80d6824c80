"""The socket /api/live: what happens goes to the page, what people do comes from it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Iterator, Sequence
from typing import Any

import numpy as np
from starlette.websockets import WebSocket

from tutelage.console import messages
from tutelage.console.accounts import Role, Session
from tutelage.console.context import BusyError, log
from tutelage.console.fleet_api import describe
from tutelage.console.hub import Hub, message_of, state_message
from tutelage.console.limits import Bucket
from tutelage.console.plain import plain, text
from tutelage.console.sockets import Socket, error
from tutelage.console.states import Denied
from tutelage.errors import TutelageError

WAITING_MAX = 512
"""Events that a slow page may have before it; then it is told to come back and see the newest."""
HISTORY = 600
FINISH_SECONDS = 5.0
ASKED_MAX = 64
"""Requests of one page that wait to be carried out."""


class LiveSocket(Socket):
    """One page."""

    open_now: Counter[str] = Counter()

    def __init__(self, websocket: WebSocket, hub: Hub, session: Session) -> None:
        super().__init__(websocket, hub.context, session)
        self.hub = hub
        self._events: deque[str] = deque()
        self._state: str | None = None
        self._stop_rate = Bucket(20.0, 40)
        self._asked: asyncio.Queue[Any] = asyncio.Queue(ASKED_MAX)
        self._stops: asyncio.Queue[Any] = asyncio.Queue(ASKED_MAX)
        self._doing: set[asyncio.Future[None]] = set()
        self._delays: deque[float] = deque(maxlen=500)
        self._commands = self._dropped = 0
        self._next_link = time.monotonic() + 1

    @property
    def helps(self) -> bool:
        return self.session.role >= Role.OPERATOR

    # -- to the page --------------------------------------------------------------------------------------------

    def tell(self, message: str) -> None:
        if len(self._events) >= WAITING_MAX:
            self.end(1013, "too slow; come back")
            return
        self._events.append(message)
        self.wake.set()

    def show(self, state: str) -> None:
        self._state = state
        self.wake.set()

    def refuse(self, code: str, why: str, ref: int | str | None = None) -> None:
        self.tell(error(code, why, ref))

    async def send_what_waits(self) -> float | None:
        while self._events:
            await self.websocket.send_text(self._events.popleft())
        if self._state is not None:
            state, self._state = self._state, None
            await self.websocket.send_text(state)
        return None

    async def begin(self) -> None:
        supervision = self.context.supervision
        no_seat = await self.hub.join(self)
        newest = supervision.snapshot()
        rows = await self.context.slow.run(lambda: plain(supervision.metrics()[-HISTORY:]))
        me = {"name": self.name, "role": self.session.role.name.lower(), "seat": self.hub.seats.get(self.name)}
        hello = {"type": "hello", "me": me, "fleet": describe(self.websocket.app), "metrics": rows}
        hello["study"] = self.context.study.state() if self.context.study else None
        standing = [text(message_of(event)) for event in supervision.standing(self.name)]
        # What was told while it joined comes after hello, and may be among what stands.
        self._events = deque([text(hello | {"server_time": time.time()}), *standing, *self._events])
        self.show(state_message(newest))
        if no_seat:
            self.refuse("no_seat", no_seat)

    async def finish(self) -> None:
        """What the page said before it went is done, stops first."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FINISH_SECONDS):
                await asyncio.gather(*self._doing)
                for queue in (self._stops, self._asked):
                    while not queue.empty():
                        await self._carry_out(queue.get_nowait())
        await self.hub.leave(self)

    async def check(self) -> None:
        now = time.monotonic()
        if now < self._next_link:
            return
        self._next_link = now + 1
        p50, p99 = np.percentile(self._delays, [50, 99]).tolist() if self._delays else (None, None)
        link = {"p50": p50, "p99": p99}
        counts = {"commands": self._commands, "dropped": self._dropped}
        self.tell(text({"type": "link", "command_latency_ms": link, **counts}))

    # -- from the page ------------------------------------------------------------------------------------------

    def exempt(self, message: str) -> bool:
        return '"estop"' in message and self._stop_rate.take()

    def more(self) -> Sequence[Callable[[], Coroutine[Any, Any, None]]]:
        return (lambda: self._work(self._asked), lambda: self._work(self._stops))

    async def received(self, message: str) -> None:
        began = time.perf_counter()
        said = messages.parse_live(message)
        if isinstance(said, messages.Ping):
            self.tell(text({"type": "pong", "n": said.n, "time": said.time, "server_time": time.time()}))
        elif not self.helps:
            self.refuse("forbidden", "viewers look only", said.ref)
        elif isinstance(said, messages.Command | messages.Renew):
            with self._refusing(said):
                self._at_once(said, began)
        else:
            queue = self._stops if isinstance(said, messages.Stop) else self._asked
            try:
                queue.put_nowait(said)
            except asyncio.QueueFull:
                self.refuse("too_many", "too many requests wait", said.ref)

    def _at_once(self, said: messages.Command | messages.Renew, began: float) -> None:
        """What comes many times a second, and waits for nothing."""
        if isinstance(said, messages.Renew):
            self.context.supervision.renew(self.name, said.lease)
            return
        self._commands += 1
        used = self.context.supervision.command(
            self.name, said.robot, said.lease, said.seq, said.action, said.assist, said.push
        )
        self._dropped += not used
        self._delays.append(1000 * (time.perf_counter() - began))

    async def _work(self, queue: asyncio.Queue[Any]) -> None:
        """Do what was asked for, in its order. Stops and their ends have an order of their own, which nothing holds up."""
        while True:
            said = await queue.get()
            task = asyncio.ensure_future(self._carry_out(said))
            self._doing.add(task)
            task.add_done_callback(self._doing.discard)
            await asyncio.shield(task)  # what was begun is done, though the page may be gone

    async def _carry_out(self, said: Any) -> None:
        with self._refusing(said):
            await self._do(said)
            self.tell(text({"type": "ack", "ref": said.ref}))

    @contextlib.contextmanager
    def _refusing(self, said: Any) -> Iterator[None]:
        """Say why something was not done."""
        try:
            yield
        except Denied as denied:
            self._dropped += isinstance(said, messages.Command)
            self.refuse(denied.code, denied.text, said.ref)
        except BusyError as busy:
            self.refuse("too_many", str(busy), said.ref)
        except TutelageError as problem:
            self.refuse("held", str(problem), said.ref)
        except Exception:
            log.exception("what %s asked for failed", self.name)
            self.refuse("internal", "an error of the server; its log says more", said.ref)

    async def _do(self, said: Any) -> None:
        """What may wait for a lock or for a robot, in a thread."""
        s, run, me = self.context.supervision, self.context.control.run, self.name
        match said:
            case messages.OnRobot():
                await run(getattr(s, said.type), me, said.robot)
            case messages.HandOver():
                await run(s.hand_over, me, said.robot, said.to)
            case messages.Stop():
                await self.context.stops.run(s.estop if said.type == "estop" else s.clear_estop, me, said.robot)
            case messages.Available():
                if me not in self.hub.seats and said.yes:
                    no_seat = await self.hub.sit(me)
                    if no_seat:
                        raise Denied("no_seat", no_seat)
                await run(s.available, me, said.yes)
