"""Brings what the supervision tells to every socket: the newest state at most ten times a second, events one by one."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from tutelage.console.context import Context, log
from tutelage.console.plain import plain, text
from tutelage.console.states import Denied, LeaseEnded, LeaseGranted, Metrics, Notice, Offer, Snapshot, Stepped, Told
from tutelage.errors import TutelageError

if TYPE_CHECKING:
    from tutelage.console.supervision import Supervision

STATE_EVERY = 0.09
"""Seconds between two states: a little less than a tenth, so that a loop at 10 Hz is seen whole."""


class Listener(Protocol):
    """A socket."""

    name: str

    @property
    def helps(self) -> bool:
        """Whether the person may help robots."""

    def tell(self, message: str) -> None:
        """An event: each one counts."""

    def show(self, state: str) -> None:
        """A state: only the newest counts."""

    def end(self, code: int, why: str) -> None:
        """Close it."""


def message_of(event: Told) -> dict[str, Any] | None:
    """What a page is told of an event; a state is told otherwise."""
    match event:
        case Offer():
            return {"type": "offer", "robot": event.robot, "reason": event.reason, "expires_in": event.expires_in}
        case LeaseGranted():
            return {"type": "lease", "robot": event.lease.robot, "id": event.lease.id, "reason": event.lease.reason}
        case LeaseEnded():
            return {"type": "lease_end", "robot": event.robot, "id": event.lease, "why": event.why}
        case Metrics():
            return {"type": "metrics", "row": event.row}
        case Notice():
            return {"type": "notice", "level": event.level, "text": event.text}
    return None


class Hub:
    """All live sockets. For the event loop's thread only, but for what the supervision calls.

    Attributes:
        seats: the seat of each operator who is here.
    """

    def __init__(self, context: Context) -> None:
        self.context = context
        self.seats: dict[str, int] = {}
        self._listeners: set[Listener] = set()
        self._names: Counter[str] = Counter()
        self._newest: Snapshot | None = None
        self._study: str | None = None
        self._stepped = asyncio.Event()
        self._locks: dict[str, asyncio.Lock] = {}
        self._task: asyncio.Task[None] | None = None
        self._unsubscribe: Callable[[], None] = lambda: None

    @property
    def operators(self) -> set[str]:
        """Who has a live socket and may help robots."""
        return {listener.name for listener in self._listeners if listener.helps}

    def counts(self) -> dict[str, float]:
        """For /metrics."""
        return {"sockets": len(self._listeners), "people": len(self._names), "seats_taken": len(self.seats)}

    def start(self) -> None:
        """Listen to the supervision."""
        self._listen(asyncio.get_running_loop())
        self._task = asyncio.create_task(self._show_states())

    async def stop(self) -> None:
        """Listen no more."""
        self._unsubscribe()
        if self._task:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

    def _listen(self, loop: asyncio.AbstractEventLoop) -> None:
        def later(call: Callable[..., None], *args: Any) -> None:
            with contextlib.suppress(RuntimeError):  # the event loop ended
                loop.call_soon_threadsafe(call, *args)

        self._unsubscribe = self.context.supervision.subscribe(lambda event: later(self._told, event))
        if self.context.study:
            self.context.study.changed = lambda: later(self._stepped.set)

    def switch(self, supervision: Supervision) -> None:
        """From now on people work with another supervision: their sockets end, and come back to it."""
        self._unsubscribe()
        self.context.supervision, self._newest = supervision, None
        self.seats.clear()
        self._listen(asyncio.get_running_loop())
        for listener in list(self._listeners):
            listener.end(1012, "the next part begins; come back")

    async def join(self, listener: Listener) -> str | None:
        """A socket opens; who may help takes a seat. Returns why they have none, or None."""
        async with self._lock(listener.name):
            self._listeners.add(listener)
            self._names[listener.name] += 1
            return await self.sit(listener.name) if listener.helps else None

    async def sit(self, name: str) -> str | None:
        """Take a seat, if there is one. Returns why there is none, or None."""
        try:
            self.seats[name] = await self.context.control.run(self.context.supervision.join, name)
        except Denied as denied:
            return denied.text
        return None

    async def leave(self, listener: Listener) -> None:
        """A socket is gone; with the last one of a person, they are gone."""
        if listener not in self._listeners:
            return
        self._listeners.discard(listener)
        async with self._lock(listener.name):
            self._names[listener.name] -= 1
            if self._names[listener.name] > 0:
                return
            del self._names[listener.name]
            if self.seats.pop(listener.name, None) is not None:
                try:
                    await self.context.control.run(self.context.supervision.leave, listener.name)
                except TutelageError as error:
                    log.warning("%s left: %s", listener.name, error)
        if listener.name not in self._names:
            self._locks.pop(listener.name, None)

    def _lock(self, name: str) -> asyncio.Lock:
        """Coming and going of one person, one after the other."""
        return self._locks.setdefault(name, asyncio.Lock())

    def _told(self, event: Told) -> None:
        if isinstance(event, Stepped):
            self._newest = event.snapshot
            self._stepped.set()
            return
        content = message_of(event)
        if content is None:
            return
        message = text(content)
        for listener in self._listeners:
            if event.operator is None or event.operator == listener.name:
                listener.tell(message)

    async def _show_states(self) -> None:
        while True:
            await self._stepped.wait()
            self._stepped.clear()
            if self._newest is not None and self._listeners:
                state = state_message(self._newest)
                for listener in self._listeners:
                    listener.show(state)
            if self.context.study:
                study = text({"type": "study"} | self.context.study.state())
                if study != self._study:
                    self._study = study
                    for listener in self._listeners:
                        listener.tell(study)
            await asyncio.sleep(STATE_EVERY)


def state_message(snapshot: Snapshot) -> str:
    """The message `state`."""
    return text({"type": "state"} | plain(snapshot.to_json()))
