"""Receiving: a thread of its own opens packets, puts messages in order, fetches what is missing and calls the application.

The network's thread only drops packets into a bounded inbox. When the inbox is full, a reliable subscription leaves further
packets unopened and fetches them again when the application has caught up; a lossy one drops the oldest.
"""

from __future__ import annotations

import contextlib
import logging
import queue as queues
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from tutelage.errors import ConfigError
from tutelage.sgc import delivery, frames, lanes
from tutelage.sgc.access import Authenticity, Delivery, Entry
from tutelage.sgc.history import make_request, parse_answer
from tutelage.sgc.messages import Message
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.sealing import Opened, Opener
from tutelage.sgc.transport.base import NoReply, Transport
from tutelage.sgc.workers import Workers

log = logging.getLogger(__name__)

INBOX_BYTES = 16 << 20
"""Much less than what a publisher keeps: what is left unopened is missed only when all before it has been opened."""

HELD_PACKETS = 256
"""Packets that wait until we know their sender or have the key for them."""

ASK = 0.2
"""Seconds between two greetings, session offers or questions of the same kind."""

OFFER_EVERY = 600.0
"""Seconds after which a session is replaced by a new one, long before the certificates behind it expire."""

FOR_GOOD = frozenset(
    {Reason.NO_SESSION, Reason.TOO_OLD, Reason.OLD_EPOCH, Reason.STALE, Reason.EXPIRED, Reason.REVOKED, Reason.NOT_ALLOWED}
)
"""Refusals that fetching a packet again does not change."""

ANSWER_TIMEOUT = 0.5, 4.0
"""Seconds to wait for a publisher to send what is missing: at first, and at most. It doubles when nothing comes: the way may
be slow, or the question went down with a connection."""


@dataclass(frozen=True, slots=True)
class _Repair:
    """What a publisher sent when it was asked for missing messages."""

    salt: bytes
    floor: int
    packets: list[memoryview]


@dataclass(frozen=True, slots=True)
class _Answer:
    """The end of a session handshake."""

    packet: bytes


class _Retry:
    """Something changed: try held packets again."""


class Subscription:
    """Receives the messages of one topic, in order and each once, on its own thread. Iterate if there is no callback."""

    def __init__(
        self,
        alias: str,
        entry: Entry,
        opener: Opener,
        transport: Transport,
        need_key: Callable[[], None],
        pool: Workers,
        on_message: Callable[[Message], None] | None,
        queue: int | None,
        direct: bool = False,
    ) -> None:
        """
        Args:
            entry: the topic.
            opener: a new one; nobody else may use it.
            need_key: called when a packet is sealed under a key that we do not have.
            pool: where questions to publishers wait for their answers.
            on_message, queue, direct: see `Node.subscribe`.
        """
        if direct and on_message is None:
            raise ConfigError(f"a direct subscription of {alias} needs a callback")
        if queue is not None and queue < 1:
            raise ConfigError(f"a queue holds at least one message, not {queue}")
        self.alias = alias
        self.opener = opener
        self.received = self.packets = self.bytes = self.deferred = self.superseded = self.repaired = self.failed = 0
        self.last_heard: dict[str, float] = {}
        """When a packet of a sender was last opened, by name; seconds since 1970."""
        self.latency: dict[str, float] = {}
        """Seconds from sender to receiver, by name; smoothed over some ten packets, as exact as the two clocks agree."""
        rule = entry.rule
        self._lossy = rule.delivery == Delivery.LOSSY
        self._limit = queue if queue is not None else 1 if self._lossy else 64
        self._entry = entry
        self._transport = transport
        self._need_key = need_key
        self._pool = pool
        self._on_message = on_message
        started = time.monotonic()
        patience = delivery.PATIENCE if rule.max_age is None else min(delivery.PATIENCE, rule.max_age)
        self.delivery: delivery.Delivery = (
            delivery.Newest(started)
            if self._lossy
            else delivery.InOrder(started, patience, from_first_heard=rule.authenticity == Authenticity.SESSION)
        )
        self._assemblies: dict[bytes, frames.Assembly] = {}
        self._inbox: queues.SimpleQueue[tuple[float, bytes] | _Answer | _Retry | None] = queues.SimpleQueue()
        self._repairs: deque[_Repair] = deque()  # before the inbox: what it holds waits for them
        self._inbox_limit = max(self._limit, 64)
        self._inbox_bytes = 0
        self._lock = threading.Lock()
        self._held: deque[tuple[float, bytes]] = deque(maxlen=HELD_PACKETS)
        self._asked: dict[str, float] = {}
        self._last_refusal: Reason | None = None
        self._timeouts: dict[bytes, float] = {}
        self._offer_at = float("inf")
        self._out: queues.Queue[Message | None] = queues.Queue(self._limit)
        self._closed = threading.Event()
        self._direct = direct
        self._turn = threading.Lock()  # whose turn it is to deal with packets, if direct: the network's thread or our own
        self._session = rule.authenticity == Authenticity.SESSION
        self._handles = [transport.subscribe(lanes.key(entry.name, lanes.STREAM), self._on_packet)]
        if self._session:
            self._handles.append(transport.subscribe(lanes.key(entry.name, lanes.ANSWER), self._on_answer))
        self._thread = threading.Thread(target=self._work, name=f"sgc-subscribe-{alias}", daemon=True)
        self._thread.start()

    # -- for the application -----------------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Message]:
        """Messages as they come, until the subscription is closed. For subscriptions without callback."""
        while (message := self.receive()) is not None:
            yield message

    def receive(self, timeout: float | None = None) -> Message | None:
        """The next message; None: none came within `timeout` seconds, or the subscription is closed.

        Raises:
            ConfigError: the subscription has a callback.
        """
        if self._on_message is not None:
            raise ConfigError(f"the subscription of {self.alias} has a callback; it cannot be read from as well")
        try:
            message = self._out.get(timeout=timeout)
        except queues.Empty:
            return None
        if message is None:
            self._out.put(None)  # for whoever else waits
        return message

    def close(self) -> None:
        """Stop; a callback that runs ends first."""
        if self._closed.is_set():
            return
        self._closed.set()
        for handle in self._handles:
            handle.close()
        self._inbox.put(None)
        if threading.current_thread() is not self._thread:
            self._thread.join(5.0)
        while True:  # whoever reads gets what is there, then the end
            try:
                self._out.put_nowait(None)
                return
            except queues.Full:
                self._out.get_nowait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def closed(self) -> bool:
        """Has it been closed?"""
        return self._closed.is_set()

    @property
    def lost(self) -> int:
        """Messages that are missing for good."""
        return self.delivery.tally.lost

    @property
    def queued(self) -> int:
        """Packets and messages that wait for the application."""
        return self._inbox.qsize() + self._out.qsize()

    def retry(self) -> None:
        """A key came: packets that waited for it may be opened now."""
        if self._held:
            self._inbox.put(_Retry())

    # -- on the network's threads ------------------------------------------------------------------------------------------

    def _on_packet(self, packet: bytes) -> None:
        if self._direct and self._inbox.empty() and not self.delivery.crowded and self._turn.acquire(blocking=False):
            try:
                self._at_once(packet)
            finally:
                self._turn.release()
            return
        with self._lock:
            waiting, size = self._inbox.qsize(), self._inbox_bytes + len(packet)
            full = waiting >= self._inbox_limit or size > INBOX_BYTES or self.delivery.crowded
            if full and not self._lossy:
                self.deferred += 1  # not opened, so not marked as seen: it can be fetched again
                return
            self._inbox_bytes += len(packet)
        if full:
            self._drop_oldest()
        self._inbox.put((time.time(), packet))

    def _at_once(self, packet: bytes) -> None:
        """Deal with a packet on the network's thread; what takes time or has to wait is left to our own."""
        if self._closed.is_set():
            return
        try:
            self._pass_on(self._take(time.time(), packet))
        except Exception:
            log.exception("subscription of %s", self.alias)
        if self.delivery.wake() is not None:
            self._inbox.put(_Retry())  # wakes our thread, which then sees to the gap

    def _drop_oldest(self) -> None:
        try:
            oldest = self._inbox.get_nowait()
        except queues.Empty:
            return
        if isinstance(oldest, tuple):
            self.superseded += 1
            with self._lock:
                self._inbox_bytes -= len(oldest[1])
        else:
            self._inbox.put(oldest)

    def _on_answer(self, packet: bytes) -> None:
        if self._inbox.qsize() < 2 * self._inbox_limit:
            self._inbox.put(_Answer(packet))

    # -- on the subscription's thread --------------------------------------------------------------------------------------

    def _work(self) -> None:
        if self._session:
            self._offer()
        while not self._closed.is_set():
            wake = self._wake()
            item: tuple[float, bytes] | _Answer | _Retry | None = None
            with contextlib.suppress(queues.Empty):
                item = self._inbox.get(timeout=None if wake is None else max(0.0, wake - time.monotonic()))
                if item is None:
                    return
            with self._turn:
                try:
                    while self._repairs:
                        self._repair(self._repairs.popleft())
                    if item is not None:
                        self._deal_with(item)
                    if wake is not None or self._wake() is not None:
                        self._mend()
                except Exception:
                    log.exception("subscription of %s", self.alias)

    def _wake(self) -> float | None:
        wake = self.delivery.wake()
        return wake if not self._session else self._offer_at if wake is None else min(wake, self._offer_at)

    def _repair(self, repair: _Repair) -> None:
        """What a publisher sent when it was asked."""
        received, refused = time.time(), 0
        for late in repair.packets:
            before = self.packets
            self._pass_on(self._take(received, late))
            self.repaired += self.packets > before
            refused += self._last_refusal in FOR_GOOD if self.packets == before else 0
        ready = self.delivery.answered(repair.salt, repair.floor, time.monotonic(), in_vain=refused > 0)
        self._pass_on(self._messages(ready, received))

    def _deal_with(self, item: tuple[float, bytes] | _Answer | _Retry) -> None:
        if isinstance(item, tuple):
            with self._lock:
                self._inbox_bytes -= len(item[1])
            if self._lossy:
                self._pass_on_newest(self._take(*item))
            else:
                self._pass_on(self._take(*item))
        elif isinstance(item, _Answer):
            try:
                self.opener.complete_session(item.packet)
            except Refused:
                return  # counted by the opener; most answers are for others
        else:
            held, self._held = self._held, deque(maxlen=HELD_PACKETS)
            for received, packet in held:
                self._pass_on(self._take(received, packet))

    def _take(self, received: float, packet: bytes | memoryview) -> list[Message]:
        """Open a packet; the messages that it completes."""
        try:
            opened = self.opener.open_many(packet)
        except Refused as refused:
            self._refused(refused.reason, received, packet)
            return []
        self.packets += 1
        if not opened:
            return []
        self._heard(opened[-1], received)
        return self._messages(self.delivery.accept_all(opened, time.monotonic()), received)

    def _heard(self, opened: Opened, received: float) -> None:
        sender, took = opened.sender, received - opened.sent * 1e-9
        before = self.latency.get(sender)
        self.last_heard[sender] = received
        self.latency[sender] = took if before is None else before + 0.1 * (took - before)
        if before is None and self._held:
            self._inbox.put(_Retry())  # those that waited for the introduction of this sender

    def _refused(self, reason: Reason, received: float, packet: bytes | memoryview) -> None:
        self._last_refusal = reason
        if reason == Reason.UNKNOWN_EPOCH:
            self._held.append((received, bytes(packet)))
            self._need_key()
        elif reason == Reason.UNKNOWN_SENDER:
            self._held.append((received, bytes(packet)))
            if self._may_ask(lanes.HELLO):
                self._transport.publish(lanes.key(self._entry.name, lanes.HELLO), b"")
        elif reason == Reason.NO_SESSION and self._may_ask(lanes.OFFER):
            self._offer()

    def _offer(self) -> None:
        self._offer_at = time.monotonic() + OFFER_EVERY
        try:
            self._transport.publish(lanes.key(self._entry.name, lanes.OFFER), self.opener.offer_session())
        except Refused:
            return

    def _may_ask(self, what: str) -> bool:
        now = time.monotonic()
        if now - self._asked.get(what, float("-inf")) < ASK:
            return False
        self._asked[what] = now
        return True

    def _messages(self, opened: list[Opened], received: float) -> list[Message]:
        """Frames in order become messages."""
        messages, alias = [], self.alias
        for frame, sender, sequence, salt, sent, _, authentic, _ in opened:
            try:
                payload = (self._assemblies.get(salt) or self._begin(salt)).take(sequence, frame)
            except Refused as refused:
                self.opener.refusals.add(refused.reason)
                continue
            if payload is not None:
                messages.append(Message(payload, sender, alias, sequence, sent * 1e-9, received, authentic))
        return messages

    def _begin(self, salt: bytes) -> frames.Assembly:
        """A sender has started; what an earlier start of it left incomplete is forgotten."""
        present = self.delivery.salts()
        self._assemblies = {each: assembly for each, assembly in self._assemblies.items() if each in present}
        assembly = self._assemblies[salt] = frames.Assembly()
        return assembly

    def _mend(self) -> None:
        """What time brings: gaps that are asked for, and gaps that are given up."""
        now = time.monotonic()
        if now >= self._offer_at:
            self._offer()
        self._pass_on(self._messages(self.delivery.due(now), time.time()))
        for salt, ranges in self.delivery.questions(now):
            if not self._pool.submit(self._ask, salt, ranges):
                self.delivery.answered(salt, 0, now)  # too busy: ask again later

    def _ask(self, salt: bytes, ranges: list[tuple[int, int]]) -> None:
        """On the pool: ask the publisher for what is missing."""
        repair, first = _Repair(salt, 0, []), ANSWER_TIMEOUT[0]
        timeout = self._timeouts.get(salt, first)
        try:
            key = lanes.key(self._entry.name, lanes.REPLAY, salt.hex())
            repair = _Repair(salt, *parse_answer(self._transport.request(key, make_request(ranges), timeout)))
            self._timeouts.pop(salt, None)
        except NoReply:
            self._timeouts = {salt: min(2 * timeout, ANSWER_TIMEOUT[1])}  # of the stream in trouble; others begin anew
        except Refused as refused:
            self.opener.refusals.add(refused.reason)
        self._repairs.append(repair)
        self._inbox.put(_Retry())

    # -- to the application ------------------------------------------------------------------------------------------------

    def _pass_on_newest(self, messages: list[Message]) -> None:
        """Lossy: everything that is there already is opened first; the application gets the newest."""
        newest = deque(messages, maxlen=self._limit)
        count = len(messages)
        while True:
            try:
                item = self._inbox.get_nowait()
            except queues.Empty:
                break
            if not isinstance(item, tuple):
                self._inbox.put(item)
                break
            with self._lock:
                self._inbox_bytes -= len(item[1])
            more = self._take(*item)
            newest += more
            count += len(more)
        self.superseded += count - len(newest)
        self._pass_on(list(newest))

    def _pass_on(self, messages: list[Message]) -> None:
        for message in messages:
            self.received += 1
            self.bytes += len(message.payload)
            if self._on_message is None:
                self._put(message)
                continue
            try:
                self._on_message(message)
            except Exception:
                self.failed += 1
                log.exception("the callback of %s", self.alias)

    def _put(self, message: Message) -> None:
        while not self._closed.is_set():
            try:
                self._out.put(message, block=not self._lossy, timeout=0.1)
                return
            except queues.Full:
                if self._lossy:
                    with contextlib.suppress(queues.Empty):
                        self._out.get_nowait()
                        self.superseded += 1
