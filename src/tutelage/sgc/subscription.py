"""Receiving: a thread of its own opens packets, puts messages in order, fetches what is missing and calls the application.

The network's thread only drops packets into a bounded inbox. When the inbox is full, a reliable subscription leaves further
packets unopened and fetches them again when the application has caught up; a lossy one drops the oldest.
"""

from __future__ import annotations

import logging
import queue as queues
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import get_ident
from types import TracebackType
from typing import Self

from tutelage.errors import ConfigError
from tutelage.sgc import delivery, frames, lanes
from tutelage.sgc.access import Authenticity, Delivery, Entry
from tutelage.sgc.assembler import Assembler
from tutelage.sgc.due import Due
from tutelage.sgc.messages import Message, make_message
from tutelage.sgc.outlet import Outlet
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.repairs import Repair, Repairs
from tutelage.sgc.sealing import Opener
from tutelage.sgc.transport.base import Transport, lent
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


@dataclass(frozen=True, slots=True)
class _Answer:
    """The end of a session handshake."""

    packet: bytes


class _Retry:
    """Something changed: look for repairs, try held packets again."""


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
        self.packets = self.deferred = self.repaired = 0
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
        self._repairs = Repairs(entry, transport, pool, opener.refusals, self._look_again)
        self.outlet = Outlet(alias, on_message, self._limit, lossy=self._lossy)
        self._called_back = on_message is not None
        started = time.monotonic()
        patience = delivery.PATIENCE if rule.max_age is None else min(delivery.PATIENCE, rule.max_age)
        self.delivery: delivery.Delivery = (
            delivery.Newest(started)
            if self._lossy
            else delivery.InOrder(started, patience, from_first_heard=rule.authenticity == Authenticity.SESSION)
        )
        self._assembler = Assembler(alias, opener.refusals, self.delivery.salts)
        self._inbox: queues.SimpleQueue[tuple[float, bytes] | _Answer | _Retry | None] = queues.SimpleQueue()
        self._inbox_limit = max(self._limit, 64)
        self._inbox_bytes = 0
        self._lock = threading.Lock()
        self._held: deque[tuple[float, bytes]] = deque(maxlen=HELD_PACKETS)
        self._asked: dict[str, float] = {}
        self._last_refusal: Reason | None = None
        self._twice: set[str] = set()  # senders of which it was said that two programs send at once
        self._offer_at = float("inf")
        self._turn = threading.Lock()  # whose turn it is to deal with packets, if direct: the network's thread or our own
        self._session = rule.authenticity == Authenticity.SESSION
        self._due: tuple[Due, delivery.Stream] | None = None  # what is due, and where it is delivered
        arrive = self._arrive_directly if direct else self._arrive
        self._handles = [transport.subscribe(lanes.key(entry.name, lanes.STREAM), arrive)]
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
        if self._called_back:
            raise ConfigError(f"the subscription of {self.alias} has a callback; it cannot be read from as well")
        return self.outlet.take(timeout)

    def close(self) -> None:
        """Stop; a callback that runs ends first."""
        if self.outlet.closed:
            return
        self.outlet.closed = True
        for handle in self._handles:
            handle.close()
        self._inbox.put(None)
        if threading.current_thread() is not self._thread:
            self._thread.join(5.0)
        self.outlet.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def closed(self) -> bool:
        """Has it been closed?"""
        return self.outlet.closed

    @property
    def lost(self) -> int:
        """Messages that are missing for good."""
        return self.delivery.tally.lost

    @property
    def queued(self) -> int:
        """Packets and messages that wait for the application."""
        return self._inbox.qsize() + len(self.outlet)

    def retry(self) -> None:
        """A key came: packets that waited for it may be opened now."""
        if self._held:
            self._look_again()

    def _look_again(self) -> None:
        """Wakes our thread."""
        self._inbox.put(_Retry())

    # -- on the network's threads ------------------------------------------------------------------------------------------

    def _arrive_directly(self, packet: bytes) -> None:
        if self.outlet.closed:
            return
        if not self._inbox.empty() or self.delivery.gapped or not self._turn.acquire(False):
            self._arrive(packet)
            return
        thread = get_ident()
        lent.add(thread)
        try:
            now = time.time_ns()
            expected = self._due
            if expected is None or (opened := expected[0].open(packet, expected[1].next, now)) is None:
                self._take(now * 1e-9, packet, self.outlet.give, now)
                self._expect()
            else:
                (due, stream), (payload, sent), received = expected, opened, now * 1e-9
                message = make_message((payload, due.sender, self.alias, stream.next, sent * 1e-9, received, True))
                stream.next += 1
                self.packets += 1
                self.outlet.give([message])
                self._heard(due.sender, sent, received)
        except Exception:
            log.exception("subscription of %s", self.alias)
        finally:
            lent.discard(thread)
            self._turn.release()
        if self.delivery.gapped:
            self._look_again()  # our thread sees to the gap

    def _arrive(self, packet: bytes) -> None:
        if self.outlet.closed:
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

    def _drop_oldest(self) -> None:
        try:
            oldest = self._inbox.get_nowait()
        except queues.Empty:
            return
        if isinstance(oldest, tuple):
            self.outlet.superseded += 1
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
        while not self.outlet.closed:
            wake = self._wake()
            item: tuple[float, bytes] | _Answer | _Retry | None
            try:
                item = self._inbox.get(timeout=None if wake is None else max(0.0, wake - time.monotonic()))
                if item is None:
                    return
            except queues.Empty:
                item = None
            with self._turn:
                try:
                    while (repair := self._repairs.take()) is not None:  # before the inbox: what it holds waits for them
                        self._repair(repair)
                    if item is not None:
                        self._deal_with(item)
                    if wake is not None or self._wake() is not None:
                        self._mend()
                except Exception:
                    log.exception("subscription of %s", self.alias)

    def _wake(self) -> float | None:
        wake = self.delivery.wake()
        return wake if not self._session else self._offer_at if wake is None else min(wake, self._offer_at)

    def _repair(self, repair: Repair) -> None:
        """What a publisher sent when it was asked."""
        received, refused = time.time(), 0
        for late in repair.packets:
            before = self.packets
            self._take(received, late, self.outlet.give)
            self.repaired += self.packets > before
            refused += self._last_refusal in FOR_GOOD if self.packets == before else 0
        ready = self.delivery.answered(repair.salt, repair.floor, time.monotonic(), in_vain=refused > 0)
        self.outlet.give(self._assembler.messages(ready, received))

    def _deal_with(self, item: tuple[float, bytes] | _Answer | _Retry) -> None:
        if isinstance(item, tuple):
            with self._lock:
                self._inbox_bytes -= len(item[1])
            if self._lossy:
                self._take_newest(item)
            else:
                self._take(*item, self.outlet.give)
        elif isinstance(item, _Answer):
            try:
                self.opener.complete_session(item.packet)
            except Refused:
                return  # counted by the opener; most answers are for others
            for replacement in self.opener.replacements():
                self._transport.publish(lanes.key(self._entry.name, lanes.OFFER), replacement)
        else:
            held, self._held = self._held, deque(maxlen=HELD_PACKETS)
            for received, packet in held:
                self._take(received, packet, self.outlet.give)

    def _take(
        self, received: float, packet: bytes | memoryview, give: Callable[[list[Message]], None], now: int | None = None
    ) -> None:
        """Open a packet, and give the messages that it completes.

        received: seconds since 1970.
        now: nanoseconds since 1970; None: the clock.
        """
        self._due = None
        try:
            opened = self.opener.open_many(packet, now=now)
        except Refused as refused:
            self._refused(refused.reason, received, packet)
            return
        self.packets += 1
        if opened:
            give(self._assembler.messages(self.delivery.accept_all(opened, time.monotonic()), received))
            self._heard(opened[-1].sender, opened[-1].sent, received)

    def _expect(self) -> None:
        """After a packet was taken: another whole message of the same stream, if nothing is missing before it."""
        due = self.opener.due()
        if due is not None and due.kind == frames.Kind.WHOLE and not self._assembler.unfinished:
            stream = self.delivery.current(due.sender)
            if stream is not None and stream.salt == due.salt and not stream.held:
                self._due = due, stream

    def _say_twice(self) -> None:
        for sender in sorted(self.delivery.twice - self._twice):
            log.warning(
                "two programs send %s as %s at once, and only the one that began later is heard: end them and start one, "
                "or give the other a node of its own (tutelage keys init HOME --node NAME)",
                self.alias, sender,
            )  # fmt: skip
        self._twice = set(self.delivery.twice)

    def _heard(self, sender: str, sent: int, received: float) -> None:
        took, before = received - sent * 1e-9, self.latency.get(sender)
        self.last_heard[sender] = received
        self.latency[sender] = took if before is None else before + 0.1 * (took - before)
        if before is None and self._held:
            self._look_again()  # those that waited for the introduction of this sender
        if len(self.delivery.twice) > len(self._twice):
            self._say_twice()

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

    def _mend(self) -> None:
        """What time brings: gaps that are asked for, and gaps that are given up."""
        now = time.monotonic()
        if now >= self._offer_at:
            self._offer()
        self.outlet.give(self._assembler.messages(self.delivery.due(now), time.time()))
        for salt, ranges in self.delivery.questions(now):
            if not self._repairs.ask(salt, ranges):
                self.delivery.answered(salt, 0, now)  # too busy: ask again later

    # -- to the application ------------------------------------------------------------------------------------------------

    def _take_newest(self, first: tuple[float, bytes]) -> None:
        """Lossy: everything that is there already is opened first; the application gets the newest."""
        messages: list[Message] = []
        item: tuple[float, bytes] | _Answer | _Retry | None = first
        while isinstance(item, tuple):
            self._take(*item, messages.extend)
            self.outlet.superseded += max(0, len(messages) - self._limit)
            del messages[: -self._limit]
            try:
                item = self._inbox.get_nowait()
            except queues.Empty:
                break
            if isinstance(item, tuple):
                with self._lock:
                    self._inbox_bytes -= len(item[1])
            else:
                self._inbox.put(item)
        self.outlet.give(messages)
