"""The routing information base of section 8.4 as a router keeps it: by name, the pseudonyms that are present under it.

Zenoh compares a new subscriber to presence with all tokens, 0.3 us each; the roll is a look-up. A node first subscribes to
changes and then asks the roll who is there. The router's session hears of a change some time after the router has dealt with
it, so an answer may lack somebody who came, or hold somebody who left, just before the node's subscription counted. So each
question is kept for a while after its answer, and answered again whenever the name changes: the last answer is right for all
of whom the subscription says nothing, and the subscription is right for the others (see `transport.watch`).
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tutelage.sgc import lanes

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

EVERYBODY = f"*/*/*/{lanes.HERE}/*"
"""The keys of all presence."""

HOLD = 0.5
"""Seconds for which a question is kept after its first answer; the router's session lags by milliseconds."""

TOGETHER = 0.05
"""Seconds of patience, so that several questions are let go at a time."""

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
    """Who is present, by name, from `Roll()` to `close`. `changed` and `asked` are called on the network's threads."""

    def __init__(self, hold: float = HOLD, held: int = HELD, known: int = KNOWN) -> None:
        self._hold, self._most_held, self._most_known = hold, held, known
        self._wake = threading.Condition()
        self._present: dict[str, set[bytes]] = {}
        self._known = 0
        self._full = self._closed = False
        self._held: deque[_Question] = deque()  # the oldest first
        self._asking: Counter[str] = Counter()
        self._news: set[str] = set()
        self._thread = threading.Thread(target=self._work, name="sgc-roll", daemon=True)
        self._thread.start()

    def changed(self, key: str, present: bool) -> None:
        """A token came or went."""
        token = _TOKEN.fullmatch(key)
        if token is None:
            return
        name, who = token[1], bytes.fromhex(token[2])
        with self._wake:
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
                self._wake.notify()

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
        with self._wake:
            self._closed = True
            self._wake.notify()
        self._thread.join()

    def __len__(self) -> int:
        """Tokens."""
        return self._known

    def _answer(self, name: str) -> bytes | None:
        with self._wake:
            there = self._present.get(name, ())
            if self._closed or self._full or len(there) > MOST:
                return None
            return b"".join(sorted(there))

    def _keep(self, question: _Question) -> None:
        let_go = question
        with self._wake:
            if not self._closed:
                self._held.append(question)
                self._asking[question.name] += 1
                if self._answer(question.name) != question.said:  # it changed while it was answered
                    self._news.add(question.name)
                if len(self._held) == 1 or self._news:
                    self._wake.notify()
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
        """Answer again what has changed, and let go of what has been kept long enough."""
        while True:
            with self._wake:
                while not (self._closed or self._news):
                    left = self._held[0].until - time.monotonic() if self._held else None
                    if left is not None and left <= 0.0:
                        break
                    self._wake.wait(None if left is None else max(left, TOGETHER))
                news, self._news = self._news, set()
                again = [each for each in self._held if each.name in news]
                now = time.monotonic()
                done = []
                while self._held and (self._closed or self._held[0].until <= now):
                    done.append(self._oldest())
                closed = self._closed
            for each in again:
                self._answer_again(each)
            for each in done:
                each.query.drop()
            again.clear()
            done.clear()
            if closed:
                return

    def _answer_again(self, question: _Question) -> None:
        answer = self._answer(question.name)
        if answer is not None and answer != question.said:
            question.said = answer
            try:
                question.query.reply(question.query.key_expr, answer)
            except Exception as error:
                log.debug("a question about presence was not answered again: %s", error)
