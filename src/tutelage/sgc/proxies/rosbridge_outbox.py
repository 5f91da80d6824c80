"""What waits to be sent to one rosbridge client: bounded a subscription, oldest out, and fair between subscriptions."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tutelage.sgc.proxies.ros_values import BadMessage
from tutelage.sgc.proxies.rosbridge_wire import fragments

if TYPE_CHECKING:
    from tutelage.sgc.proxies.rosbridge_topics import Outgoing, Topic

Frame = str | bytes
Frames = Sequence[Frame]
"""A message: one frame, or its fragments."""
MAX_CONTROL = 256
"""Replies and status messages that may wait. A client that lets more pile up does not read; it is disconnected."""
PATIENCE = 5.0
"""Seconds that a client may leave replies unread."""
SEND_QUEUE = 64
"""Messages of a subscription that may wait for a slow client."""
MAX_QUEUE = 1000
"""The longest queue_length that a client gets."""
MIN_FRAGMENT = 64
_STRONGEST = ("cbor-raw", "cbor", "png", "none")


class TooSlow(Exception):
    """A client that does not read what it asked for."""


class Outbox:
    """Frames for one client. Lives on the event loop."""

    def __init__(self) -> None:
        self._control: deque[Frame] = deque()
        self._turns: deque[deque[Frames]] = deque()
        self._filled = asyncio.Event()
        self._read = asyncio.Event()
        self.dropped = 0

    def control(self, frame: Frame) -> None:
        """A reply or status message; these are never dropped.

        Raises:
            TooSlow: too many wait.
        """
        if len(self._control) >= MAX_CONTROL:
            raise TooSlow
        self._control.append(frame)
        self._filled.set()

    def data(self, queue: deque[Frames], frames: Frames) -> None:
        """A message of a subscription, which has a queue of its own; its oldest message goes if that is full."""
        if len(queue) == queue.maxlen:
            self.dropped += 1
        else:
            self._turns.append(queue)
        queue.append(frames)
        self._filled.set()

    async def room(self) -> None:
        """Wait while many replies wait: nothing more is to be read from a client that does not read.

        Raises:
            TooSlow: they wait for too long.
        """
        while len(self._control) > MAX_CONTROL // 4:
            self._read.clear()
            try:
                await asyncio.wait_for(self._read.wait(), PATIENCE)
            except TimeoutError:
                raise TooSlow from None

    async def get(self) -> Frames:
        """The next message to send; replies first."""
        while True:
            if self._control:
                self._read.set()
                return (self._control.popleft(),)
            while self._turns:
                queue = self._turns.popleft()
                if queue:  # empty if it was cleared
                    return queue.popleft()
            self._filled.clear()
            await self._filled.wait()


@dataclass(frozen=True)
class Wish:
    """What a subscribe message asks for.

    Attributes:
        throttle: seconds between two messages.
        queue: messages that wait because of the throttle; 0: none, what comes too early is dropped.
        fragment: characters of a message above which it is sent in fragments; None: never.
        compression: none, png, cbor or cbor-raw.
    """

    throttle: float = 0.0
    queue: int = 0
    fragment: int | None = None
    compression: str = "none"


@dataclass
class ClientSubscription:
    """One client on one topic. It may have asked several times, with an id each; then the gentlest wish counts.

    Attributes:
        wishes: by id.
    """

    topic: Topic
    outbox: Outbox
    loop: asyncio.AbstractEventLoop
    wishes: dict[Any, Wish] = field(default_factory=dict)
    _wish: Wish = field(default_factory=Wish)
    _ready: deque[Frames] = field(default_factory=lambda: deque(maxlen=SEND_QUEUE))
    _held: deque[Outgoing] = field(default_factory=deque)
    _next: float = 0.0
    _timer: asyncio.TimerHandle | None = None
    _number: int = 0

    def wish(self, ident: Any, wish: Wish) -> None:
        """Add or replace what was asked for under an id."""
        self.wishes[ident] = wish
        self._combine()

    def forget(self, ident: Any) -> bool:
        """Take back what was asked for under an id, or everything for None. True if nothing is left."""
        if ident is None:
            self.wishes.clear()
        else:
            self.wishes.pop(ident, None)
        self._combine()
        return not self.wishes

    def offer(self, outgoing: Outgoing) -> None:
        """Send a message now, later or never, as the throttle has it."""
        wish = self._wish
        if wish.throttle == 0 or (self._timer is None and self.loop.time() >= self._next):
            self._emit(outgoing)
        elif wish.queue:
            self._held.append(outgoing)
            if self._timer is None:
                self._timer = self.loop.call_at(self._next, self._release)

    def close(self) -> None:
        """Send nothing any more."""
        if self._timer is not None:
            self._timer.cancel()
        self._held.clear()
        self._ready.clear()

    def _combine(self) -> None:
        wishes = list(self.wishes.values()) or [Wish()]
        sizes = [wish.fragment for wish in wishes if wish.fragment is not None]
        self._wish = Wish(
            throttle=min(wish.throttle for wish in wishes),
            queue=max(wish.queue for wish in wishes),
            fragment=max(MIN_FRAGMENT, min(sizes)) if sizes else None,
            compression=next(kind for kind in _STRONGEST if any(wish.compression == kind for wish in wishes)),
        )
        self._held = deque(self._held, maxlen=max(1, self._wish.queue))

    def _release(self) -> None:
        self._timer = None
        if self._held:
            self._emit(self._held.popleft())
        if self._held:
            self._timer = self.loop.call_at(self._next, self._release)

    def _emit(self, outgoing: Outgoing) -> None:
        self._next = self.loop.time() + self._wish.throttle
        try:
            frame = outgoing.frame(self._wish.compression)
        except BadMessage:
            self.topic.counts.add("unreadable")
            return
        size = self._wish.fragment
        if size is None or isinstance(frame, bytes) or len(frame) <= size:
            self.outbox.data(self._ready, (frame,))
            return
        self._number += 1
        self.outbox.data(self._ready, fragments(frame, size, f"{self.topic.route.name}:{self._number}"))
