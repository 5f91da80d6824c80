"""The routing information base of section 8.4 as a router keeps it: by name, the pseudonyms that are present under it.

Zenoh compares a new subscriber to presence with all tokens, 0.3 us each; the roll is a look-up. A node first subscribes to
changes and then asks the roll who is there. The router's session hears of a change some time after the router has dealt with
it, so an answer may lack somebody who came, or hold somebody who left, just before the node's subscription counted. So each
question is kept for a while after its answer, and answered again whenever the name changes: the last answer is right for all
of whom the subscription says nothing, and the subscription is right for the others (see `transport.watch`).

Changes are fetched rather than called back: a router tells all who follow a name one after the other. If it waited for
Python in between, what it says of a node that comes back at once might overtake what it says of its leaving.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tutelage.sgc import lanes

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

EVERYBODY = tuple(f"{digit}$*/*/*/{lanes.HERE}/*" for digit in "0123456789abcdef")
"""The keys of all presence. In parts, as Zenoh compares a new name with all others of the same part: 1 ms for 10,000."""

HOLD = 0.5
"""Seconds for which a question is kept after its first answer; the router's session lags by milliseconds."""

PERIOD = 0.05
"""Seconds between two looks at what has changed and what has been kept long enough. Questions are a look, too."""

WAITING = 1 << 20
"""Changes that may wait for a look, and tokens of a mesh that a router joins; with more, the network waits."""

HELD = 8192
"""Questions kept at a time. Beyond, the oldest is let go: it has had its time, as a router answers fewer a second."""

KNOWN = 1 << 18
"""Tokens that a roll holds. With more it answers nothing any more, and who asks turns to Zenoh: slower, still right."""

MOST = 4096
"""Pseudonyms of an answer; under a name with more, nothing is answered."""

_BYTES = 16  # of a pseudonym
_NAME = r"[0-9a-f]{2}/[0-9a-f]{2}/[0-9a-f]{60}"
_TOKEN = re.compile(rf"({_NAME})/{lanes.HERE}/([0-9a-f]{{{2 * _BYTES}}})")
_QUESTION = re.compile(rf"({_NAME})/{lanes.HERE}/\*")


def read(answer: bytes) -> frozenset[str] | None:
    """The pseudonyms of an answer; None: it is none. Any router may send anything."""
    if len(answer) % _BYTES or len(answer) > MOST * _BYTES:
        return None
    digits = answer.hex()
    return frozenset(digits[at : at + 2 * _BYTES] for at in range(0, len(digits), 2 * _BYTES))


@dataclass(eq=False)
class _Question:
    """A question that was answered, and is kept."""

    name: str
    query: zenoh.Query
    said: bytes
    until: float


class Roll:
    """Who is present, by name, from `Roll()` to `close`. `asked` is called on the network's threads."""

    def __init__(
        self, changes: Callable[[], Iterator[tuple[str, bool]]], hold: float = HOLD, held: int = HELD, known: int = KNOWN
    ) -> None:
        """changes: gives the tokens that have come (True) or gone since it was last called, in order. Never waits."""
        self._changes, self._hold, self._most_held, self._most_known = changes, hold, held, known
        self._lock = threading.RLock()
        self._present: dict[str, set[bytes]] = {}
        self._known = 0
        self._full = False
        self._held: deque[_Question] = deque()  # the oldest first
        self._asking: Counter[str] = Counter()
        self._news: set[str] = set()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="sgc-roll", daemon=True)
        self._thread.start()

    def asked(self, query: zenoh.Query) -> None:
        """Answer who is present under a name, and keep the question. Nothing else is answered, and no pattern of names."""
        try:
            question = _QUESTION.fullmatch(str(query.key_expr))
            answer = self._answer(question[1]) if question is not None and query.payload is None else None
            if question is None or answer is None:
                query.drop()
                return
            query.reply(query.key_expr, answer)
        except Exception as error:  # the asker has gone, or the session; Zenoh has one type for all errors
            log.debug("a question about presence was not answered: %s", error)
            query.drop()
            return
        self._keep(_Question(question[1], query, answer, time.monotonic() + self._hold))

    def close(self) -> None:
        """Keep no question any more, and answer none."""
        self._closed.set()
        self._thread.join()
        with self._lock:
            held, self._held = list(self._held), deque()
        for each in held:
            each.query.drop()

    def __len__(self) -> int:
        """Tokens."""
        with self._lock:
            self._catch_up()
            return self._known

    def _catch_up(self) -> None:
        try:
            for key, present in self._changes():
                self._changed(key, present)
        except Exception as error:  # the session has closed
            log.debug("no presence any more: %s", error)

    def _changed(self, key: str, present: bool) -> None:
        token = _TOKEN.fullmatch(key)
        if token is None:
            return
        name, who = token[1], bytes.fromhex(token[2])
        there = self._present.get(name)
        if self._full or present == (there is not None and who in there):
            return
        if present and self._known >= self._most_known:
            log.warning("more than %d tokens of presence; who asks for them is served more slowly", self._most_known)
            self._full, self._known = True, 0
            self._present.clear()
            return
        self._known += 1 if present else -1
        if there is None:
            self._present[name] = {who}
        elif present:
            there.add(who)
        else:
            there.discard(who)
            if not there:
                del self._present[name]
        if name in self._asking:
            self._news.add(name)

    def _answer(self, name: str) -> bytes | None:
        with self._lock:
            self._catch_up()
            there = self._present.get(name, ())
            if self._closed.is_set() or self._full or len(there) > MOST:
                return None
            return b"".join(sorted(there))

    def _keep(self, question: _Question) -> None:
        let_go = question
        with self._lock:
            if not self._closed.is_set():
                self._held.append(question)
                self._asking[question.name] += 1
                if self._answer(question.name) != question.said:
                    self._news.add(question.name)  # it changed while it was answered
                if len(self._held) <= self._most_held:
                    return
                let_go = self._oldest()
        let_go.query.drop()

    def _oldest(self) -> _Question:
        question = self._held.popleft()
        self._asking[question.name] -= 1
        if not self._asking[question.name]:
            del self._asking[question.name]
        return question

    def _work(self) -> None:
        while not self._closed.wait(PERIOD):
            self._look()

    def _look(self) -> None:
        """Answer again what has changed, and let go of what has been kept long enough."""
        done = []
        with self._lock:
            self._catch_up()
            news, self._news = self._news, set()
            again = [each for each in self._held if each.name in news] if news else []
            now = time.monotonic()
            while self._held and self._held[0].until <= now:
                done.append(self._oldest())
        for each in again:
            answer = self._answer(each.name)
            if answer is not None and answer != each.said:
                each.said = answer
                try:
                    each.query.reply(each.query.key_expr, answer)
                except Exception as error:
                    log.debug("a question about presence was not answered again: %s", error)
        for each in done:
            each.query.drop()
