"""Who is present under a key, on one Zenoh session: a subscription to changes, and a question to the router's roll.

A subscription that also tells who is there already costs the router a look at all tokens, so it is used only where no router
keeps a roll. The subscription is declared before the question is sent, and routers deal with both in that order. Hence:

- Of somebody who came or went after that, the subscription tells; its last word is right, and no answer counts against it.
- Of the others an answer tells. It may be a moment old, so routers answer again when the roll changes; the last is right.
- Who is known from answers alone is unknown to Zenoh, which would not call them gone when the connection is lost: `cut_off`.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tutelage.sgc.roll import read

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

PATIENCE = 10.0
"""Seconds for an answer, and for all that follow it."""


class Watch:
    """From `Watch()` to `undeclare`, or to the end of the session."""

    def __init__(
        self,
        library: Any,
        session: zenoh.Session,
        key: str,
        on_change: Callable[[str, bool], None],
        later: Callable[[Callable[[], None]], bool],
    ) -> None:
        """
        Args:
            library: the module zenoh.
            key: may hold wildcards. The roll is asked if only its last chunk is one.
            on_change: as in `Transport.watch`.
            later: calls on another thread.
        """
        self._zenoh, self._session, self._key, self._on_change, self._later = library, session, key, on_change, later
        self._lock = threading.Lock()
        self._ended = self._answered = False
        self._asking = True
        self._heard: set[str] = set()  # of whom the subscription told while we were asking
        self._learned: set[str] = set()  # present by the last answer; the subscription never told of them
        self._changes: deque[tuple[str, bool]] = deque()
        self._telling = False
        self._names, _, last = key.rpartition("/")
        ask = last == "*" and "*" not in self._names
        self._whole = not ask
        self._subscribers = [self._subscribe(self._whole)]
        if ask:
            handler = library.handlers.Callback(self._replied, self._asked, indirect=False)
            with contextlib.suppress(library.ZError):  # the session has closed: the next one begins anew
                # Without consolidation, which would keep the answers back until the last one.
                session.get(key, handler, timeout=PATIENCE, consolidation=library.ConsolidationMode.NONE)

    def cut_off(self) -> None:
        """The connection is lost. When there is another, Zenoh itself tells who is present then."""
        with self._lock:
            self._changes += [(key, False) for key in self._learned]
            self._learned = set()
        self._tell()

    def undeclare(self) -> None:
        """Tell nothing more."""
        with self._lock:
            self._ended = True
            self._changes.clear()
            subscribers = list(self._subscribers)
        for each in subscribers:
            each.undeclare()

    def _subscribe(self, whole: bool) -> Any:
        """whole: with those who are there already."""

        def changed(sample: zenoh.Sample) -> None:
            if whole or not self._whole:
                self._changed(sample)

        handler = self._zenoh.handlers.Callback(changed, indirect=False)
        return self._session.liveliness().declare_subscriber(self._key, handler, history=whole)

    def _changed(self, sample: zenoh.Sample) -> None:
        key, present = str(sample.key_expr), sample.kind == self._zenoh.SampleKind.PUT
        with self._lock:
            if self._asking:
                self._heard.add(key)
            told = present and key in self._learned
            self._learned.discard(key)
            if not (told or self._ended):
                self._changes.append((key, present))
        self._tell()

    def _replied(self, reply: zenoh.Reply) -> None:
        there = read(reply.ok.payload.to_bytes()) if reply.ok is not None else None
        if there is None:
            return
        with self._lock:
            if self._ended:
                return
            self._answered = True
            learned = {f"{self._names}/{who}" for who in there} - self._heard
            self._changes += [(key, False) for key in self._learned - learned]
            self._changes += [(key, True) for key in learned - self._learned]
            self._learned = learned
        self._tell()

    def _asked(self) -> None:
        """No reply comes any more."""
        with self._lock:
            self._asking = False
            self._heard.clear()
            done = self._answered or self._ended
        if not done:
            log.debug("no router has a roll for %s", self._key)
            self._later(self._fall_back)

    def _fall_back(self) -> None:
        """No router keeps a roll, or none can be reached now: Zenoh shall tell who is there, now or when one is reached."""
        with contextlib.suppress(self._zenoh.ZError):  # the session has closed: the next one begins anew
            fresh = self._subscribe(whole=True)
            with self._lock:
                # The first one stays, and tells no more: Zenoh would take leave of both at the router with one of them.
                self._whole = True
                self._subscribers.append(fresh)
                ended = self._ended
            if ended:
                fresh.undeclare()

    def _tell(self) -> None:
        """Tell what has changed, in order, though threads may meet here; without the lock, as listeners do as they like."""
        with self._lock:
            if self._telling:
                return
            self._telling = True
        while True:
            with self._lock:
                if not self._changes:
                    self._telling = False
                    return
                key, present = self._changes.popleft()
            try:
                self._on_change(key, present)
            except Exception:  # the next change is to be told all the same
                log.exception("a change of presence could not be dealt with")
