"""How keys of topics travel: members ask the owner and are answered, and the owner hands out new ones unasked."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from tutelage.errors import TutelageError
from tutelage.sgc import lanes
from tutelage.sgc.access import Entry
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.reasons import Reason, Refusals, Refused
from tutelage.sgc.transport.base import Handle, NoReply, Transport
from tutelage.sgc.workers import Workers

log = logging.getLogger(__name__)

TIMEOUT = 1.0
"""Seconds to wait for the owner of a topic to send its key."""

AGAIN = 0.1, 2.0
"""Seconds until a key that did not come is asked for again: first, and at most."""


class KeyExchange:
    """Keeps a node in keys. Safe to use from several threads."""

    def __init__(
        self,
        keyring: Keyring,
        transport: Transport,
        pool: Workers,
        refusals: Refusals,
        wake: Callable[[], None],
        came: Callable[[str], None],
    ) -> None:
        """
        Args:
            pool: where questions to owners wait for their answers.
            refusals: counts what is refused.
            wake: asks for a call of `fetch`, soon.
            came: called with the alias of a topic whose key came.
        """
        self._keyring, self._transport, self._pool = keyring, transport, pool
        self._refusals, self._wake, self._came = refusals, wake, came
        self._lock = threading.Lock()
        self._asked: dict[str, tuple[float, float]] = {}  # alias -> when to ask again, and the pause after that

    def join(self, alias: str, entry: Entry) -> Handle:
        """Take part in a topic: answer for its keys if this node owns it, else take those that the owner hands out."""
        if self._keyring.owns(alias):
            return self._transport.serve(lanes.key(entry.name, lanes.KEYS), lambda asked: self._answer(alias, asked))
        return self._transport.subscribe(lanes.key(entry.name, lanes.GRANTS), lambda grant: self._accept(alias, grant))

    def fetch(self) -> float:
        """Ask owners for the keys that this node lacks. Returns the seconds until the next call that does something."""
        now = time.monotonic()
        for alias in self._keyring.wanted():
            with self._lock:
                at, pause = self._asked.get(alias, (now, AGAIN[0]))
                if at > now:
                    continue
                self._asked[alias] = (now + TIMEOUT + pause, min(2 * pause, AGAIN[1]))
            self._pool.submit(self._ask, alias)
        with self._lock:
            return min((at - now for at, _ in self._asked.values()), default=float("inf"))

    def hand_out(self) -> None:
        """Change the keys of own topics that are due, and send them to those who may have them."""
        for push in self._keyring.tend():
            entry = self._keyring.home.access.entry(push.alias)
            self._transport.publish(lanes.key(entry.name, lanes.GRANTS), push.grant)
            self._came(push.alias)

    def somebody_came(self, alias: str, who: str) -> None:
        """It may be the owner of a topic whose key we lack: ask at once."""
        with self._lock:
            waiting = self._asked.pop(alias, None)
        if waiting is not None:
            self._wake()

    def _answer(self, alias: str, request: bytes) -> bytes | None:
        try:
            return self._keyring.answer(alias, request)
        except Refused as refused:
            self._refusals.add(refused.reason)
        except TutelageError as error:
            log.warning("a key of %s could not be handed out: %s", alias, error)
        return None

    def _accept(self, alias: str, grant: bytes) -> None:
        before = self._keyring.version
        try:
            self._keyring.accept(alias, grant)
        except Refused as refused:
            if refused.reason != Reason.NOT_FOR_US:
                self._refusals.add(refused.reason)
            return
        if self._keyring.version != before:
            with self._lock:
                self._asked.pop(alias, None)
            self._came(alias)

    def _ask(self, alias: str) -> None:
        try:
            key = lanes.key(self._keyring.home.access.entry(alias).name, lanes.KEYS)
            self._accept(alias, self._transport.request(key, self._keyring.ask(alias), TIMEOUT))
        except NoReply:
            with self._lock:
                if alias in self._asked:
                    at, pause = self._asked[alias]
                    self._asked[alias] = (min(at, time.monotonic() + pause), pause)
            self._wake()
        except TutelageError as error:
            log.warning("no key of %s: %s", alias, error)
