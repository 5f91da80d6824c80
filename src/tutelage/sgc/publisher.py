"""Sending: a message goes out at once while the publisher is idle; what queues up meanwhile is sealed together.

A signature costs as much as sealing a hundred small messages, so a publisher that is busy seals what has queued up as one
packet with one proof. An idle one seals in the caller's thread, so batching never delays a lone message.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from threading import get_ident
from types import TracebackType
from typing import Self

from tutelage.errors import ConfigError, TutelageError
from tutelage.sgc import frames, lanes
from tutelage.sgc.access import Authenticity, Delivery, Entry
from tutelage.sgc.backlog import Backlog, Batch
from tutelage.sgc.errors import NoKey
from tutelage.sgc.history import History, parse_request
from tutelage.sgc.packet import anchored
from tutelage.sgc.reasons import Refusals, Refused
from tutelage.sgc.sealing import Sealer
from tutelage.sgc.session import REPLACEMENT
from tutelage.sgc.transport.base import Congested, Transport, lent

log = logging.getLogger(__name__)

_WHOLE = frames.Kind.WHOLE

INLINE = 16 << 10
"""Bytes of the largest message that is sealed in any caller's thread: so much the system's own buffers always take."""

PATIENT = 5.0
"""Seconds after which the network gives up a link that takes nothing. Callers who would wait as long for room seal messages
in one packet in their own thread, too: two changes of threads less. Not in a direct callback: two nodes whose receiving
threads wait to send would hold up each other."""

SPACING = {Authenticity.SIGNATURE: 0.0004, Authenticity.SESSION: 0.0002, Authenticity.CHAIN: 0.0002}
"""Seconds between packets of a busy publisher. Receivers need 0.05 ms for one, 0.2 ms for a signed one; so they keep up."""

FIRST_LIFE, LAST_LIFE = 0.05, 5.0
"""Seconds of silence after which a reliable stream shows what it has sent so far; the pause doubles up to the second."""

WAIT_FOR_THE_SLOW = 0.1
"""Seconds for which a question of a subscriber that is far behind, and catching up, holds up what comes next."""

GREETINGS = 0.1
"""Seconds between two introductions that strangers may ask for."""


class Publisher:
    """Sends the messages of one topic. Safe to use from several threads."""

    def __init__(self, alias: str, entry: Entry, sealer: Sealer, transport: Transport, need_key: Callable[[], None]) -> None:
        """
        Args:
            entry: the topic.
            sealer: a new one; nobody else may use it.
            need_key: called when the topic's key is missing.
        """
        self.alias = alias
        self.refusals = Refusals()
        self.sent = self.packets = self.bytes = self.congested = self.superseded = self.answered = 0
        self._rule = entry.rule
        self._lossy = entry.rule.delivery == Delivery.LOSSY
        self._spacing = SPACING[entry.rule.authenticity]
        self._sealer = sealer
        self._transport = transport
        self._need_key = need_key
        self._key = lanes.key(entry.name, lanes.STREAM)
        self._answer_key = lanes.key(entry.name, lanes.ANSWER)
        self._history = History(max_age=entry.rule.max_age)
        self._born = time.monotonic()
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._queue = Backlog(1_000_000_000 if entry.rule.max_age is None else int(entry.rule.max_age * 1e8))
        self._offers: deque[bytes] = deque(maxlen=64)
        self._asked: deque[int] = deque(maxlen=64)  # first sequence numbers for which we waited
        self._busy = False
        self._closing = False
        self._failure: TutelageError | None = None
        self._waiting = 0
        self._free_at = self._greeted = 0.0
        self._wakes_at = float("-inf")
        session = entry.rule.authenticity == Authenticity.SESSION
        self._life_at = self._born if session else float("inf")  # receivers without a session learn that we are there
        self._pause = FIRST_LIFE
        self._first_life = float("inf") if self._lossy else FIRST_LIFE
        self._anchor_every: float = getattr(sealer, "anchor_every", 0.02)
        self._chain = entry.rule.authenticity == Authenticity.CHAIN
        self._anchor_at = float("inf")
        self._handles = [transport.subscribe(lanes.key(entry.name, lanes.HELLO), self._on_hello)]
        if session:
            self._handles.append(transport.subscribe(lanes.key(entry.name, lanes.OFFER), self._on_offer))
        if not self._lossy:
            self._handles.append(transport.serve(lanes.key(entry.name, lanes.REPLAY, sealer.salt.hex()), self._replay))
        self._thread = threading.Thread(target=self._work, name=f"sgc-publish-{alias}", daemon=True)
        self._thread.start()

    def send(self, payload: bytes | bytearray | memoryview, *, wait: float = 0.0) -> None:
        """Queue a message. An idle publisher sends it before this returns; a busy one seals what queued up in batches.

        Without the topic's key, messages wait in the queue until the owner has sent it. Lossy topics: a message that is
        still queued when the next one comes is replaced.

        wait: seconds to wait for room if the queue is full; with `PATIENT` or more, a message that fits into one packet is
            sent in this thread.

        Raises:
            Congested: reliable topics: the queue is full, as the network is slower than the sender. Nothing was queued.
            ConfigError: the message is too large, or the publisher is closed.
            NotIssued: the node's certificate has expired.
        """
        size = len(payload)
        if size > frames.MAX_MESSAGE:
            raise ConfigError(f"a message has at most {frames.MAX_MESSAGE >> 20} MiB, not {size:,} bytes")
        sent, now = time.time_ns(), time.monotonic()
        with self._lock:
            if self._closing or self._failure is not None:
                self._check()
            inline = size <= INLINE or (wait >= PATIENT and size <= frames.PIECE and get_ident() not in lent)
            alone = inline and now >= self._free_at and not self._busy and not self._queue
            if alone:
                self._busy = True
            else:
                self._enqueue(bytes(payload), sent, wait)
        if alone:
            self._ship([(payload if type(payload) is bytes else bytes(payload), sent)], now)

    def flush(self, timeout: float) -> bool:
        """Wait until everything queued has been handed to the transport; False: it was not within `timeout` seconds."""
        with self._changed:
            return self._wait(lambda: not self._queue and not self._busy, timeout)

    def close(self) -> None:
        """Send what is queued (at most a second), then stop."""
        self.flush(1.0)
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for handle in self._handles:
            handle.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(2.0)

    def key_came(self) -> None:
        """The topic's key may be there now."""
        with self._changed:
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        """Has it been closed?"""
        return self._closing

    @property
    def queued(self) -> int:
        """Messages that wait."""
        return len(self._queue)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    # -- queue; the lock is held -------------------------------------------------------------------------------------------

    def _check(self) -> None:
        if self._closing:
            raise ConfigError(f"the publisher of {self.alias} is closed")
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure

    def _enqueue(self, payload: bytes, sent: int, wait: float) -> None:
        if self._lossy:
            self.superseded += self._queue.drop()
        waiting = self._queue.add(payload, sent)
        if not waiting:
            self._wait_for_room(len(payload), wait)
            waiting = self._queue.add(payload, sent)
        if waiting == 1:  # else the worker knows that there is something to send
            self._changed.notify_all()

    def _wait_for_room(self, size: int, timeout: float) -> None:
        if not self._wait(lambda: self._closing or self._queue.room(size), timeout):
            self.congested += 1
            raise Congested(
                f"the queue of {self.alias} is full ({len(self._queue)} messages): the network is slower than the sender; "
                "send less, or use a lossy topic"
            )
        self._check()

    def _wait(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Until the worker or whoever sends has brought it about."""
        self._waiting += 1
        try:
            return self._changed.wait_for(condition, timeout)
        finally:
            self._waiting -= 1

    # -- sealing and sending; only whoever has set `_busy` does that -------------------------------------------------------

    def _ship(self, batch: Batch, now: float) -> None:
        """Seal and send; without a key, back into the queue."""
        try:
            payload, sent = batch[0]
            age, seal = now - self._born, self._sealer.seal
            if len(batch) > 1:
                packet = self._sealer.seal_many([each for each, _ in batch], label=frames.label(_WHOLE, age), now=sent)
                self._hand_over(len(batch), packet, now)
            elif len(payload) <= frames.PIECE:
                self._hand_over(1, seal(payload, label=frames.label(_WHOLE, age), now=sent), now)
            else:
                for label, piece in frames.pieces(memoryview(payload), age):
                    self._hand_over(1, seal(piece, label=label, now=sent), now)
            self.sent += len(batch)
            self.bytes += sum([len(each) for each, _ in batch])
        except NoKey:
            with self._changed:
                self._queue.put_back(batch)
                self._free_at = time.monotonic() + FIRST_LIFE
            self._need_key()
        except TutelageError as error:  # for instance NotIssued: told to the next who sends
            self._failure = error
        finally:
            self._idle()

    def _idle(self) -> None:
        now = time.monotonic()
        with self._lock:
            self._busy = False
            self._free_at = max(self._free_at, now + self._spacing)
            self._pause, self._life_at = FIRST_LIFE, now + self._first_life
            if self._chain:
                self._anchor_at = min(self._anchor_at, now + self._anchor_every)
            # The worker is woken only if it must do something sooner than it thinks: a wake costs more than a small message.
            wakes_at = self._wakes_at
            if self._queue or self._waiting or self._life_at < wakes_at or self._anchor_at < wakes_at:
                self._changed.notify_all()

    def _hand_over(self, count: int, packet: bytes | bytearray, now: float) -> None:
        """To the network, and into the history, which nobody can ask for it before it or a later one has gone out."""
        try:
            self._transport.publish(self._key, packet, reliable=not self._lossy)
        finally:
            self.packets += 1
            if not self._lossy:
                last = self._sealer.sequence  # an anchor has no message of its own: it belongs to the last one before it
                self._history.add(last + 1 - count, last, packet, now, confirms=self._chain and anchored(packet))

    # -- the worker --------------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        while True:
            with self._changed:
                job = self._next_job()
                if job is None:
                    return
            try:
                job()
            except TutelageError as error:
                self._failure = error
            except Exception:
                log.exception("publisher of %s", self.alias)

    def _next_job(self) -> Callable[[], None] | None:
        """Wait until there is something to do; None: closed."""
        while True:
            now = time.monotonic()
            if self._offers and not self._closing:
                offers = list(self._offers)
                self._offers.clear()
                return lambda: self._answer(offers)
            if not self._busy and self._queue and now >= self._free_at and not self._closing:
                self._busy = True
                batch = self._queue.take()
                return lambda: self._ship(batch, now)
            if self._closing:
                return None
            if not self._busy and now >= self._anchor_at:
                self._busy, self._anchor_at = True, float("inf")
                return self._anchor
            if not self._busy and now >= self._life_at:
                self._busy = True
                return self._show_life
            until = min(self._anchor_at, self._life_at, self._free_at if self._queue else float("inf"))
            if self._busy:  # whoever is busy looks after us
                until = float("inf")
            self._wakes_at = until
            self._changed.wait(None if until == float("inf") else max(0.0, until - now))
            self._wakes_at = float("-inf")

    def _show_life(self) -> None:
        try:
            now = time.monotonic()
            self._hand_over(1, self._sealer.seal(b"", label=frames.label(frames.Kind.LIFE, now - self._born)), now)
        except NoKey:
            self._need_key()
        finally:
            pause = self._pause
            self._idle()
            with self._changed:
                self._pause = min(2 * pause, LAST_LIFE)
                self._life_at = time.monotonic() + max(self._pause, self._first_life)

    def _anchor(self) -> None:
        """Chain mode: confirm what was sent."""
        try:
            packet = self._sealer.flush()
            if packet is not None:
                self._hand_over(1, packet, time.monotonic())
        finally:
            with self._changed:
                self._busy = False
                self._changed.notify_all()

    # -- what subscribers ask; on the transport's threads ------------------------------------------------------------------

    def _on_hello(self, packet: bytes) -> None:
        """Somebody does not know us: the next packet, at once, introduces us. Anyone may ask, so not often."""
        now = time.monotonic()
        with self._changed:
            if now - self._greeted < GREETINGS or self._closing:
                return
            self._greeted = now
            self._life_at = now
            self._changed.notify_all()
        self._sealer.introduce()

    def _on_offer(self, packet: bytes) -> None:
        with self._changed:
            self._offers.append(packet)
            self._changed.notify_all()

    def _answer(self, offers: list[bytes]) -> None:
        answered = False
        for offer in offers:
            try:
                if len(offer) == REPLACEMENT:
                    self._sealer.end_session(offer)
                    continue
                answer = self._sealer.accept_session(offer)
            except Refused as refused:
                self.refusals.add(refused.reason)
            except NoKey:
                self._need_key()
            else:
                self._transport.publish(self._answer_key, answer)
                answered = True
        if answered:
            with self._changed:
                self._life_at = time.monotonic()

    def _replay(self, request: bytes) -> bytes | None:
        """Somebody missed something. Whoever is so far behind that it will soon be gone is waited for, while it catches up;
        one that is stuck asks for the same again and again, and holds up nobody."""
        try:
            answer = self._history.answer(request)
            first = parse_request(request)[0][0]
            if first not in self._asked and self._history.nearly_gone(first):
                self._asked.append(first)
                with self._changed:
                    self._free_at = max(self._free_at, time.monotonic() + WAIT_FOR_THE_SLOW)
        except Refused as refused:
            self.refusals.add(refused.reason)
            return None
        self.answered += 1
        return answer
