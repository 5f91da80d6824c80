"""Fetching what a subscription missed: questions to publishers, and the packets that they send again."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from tutelage.sgc import lanes
from tutelage.sgc.access import Entry
from tutelage.sgc.history import make_request, parse_answer
from tutelage.sgc.reasons import Refusals, Refused
from tutelage.sgc.transport.base import NoReply, Transport
from tutelage.sgc.workers import Workers

ANSWER_TIMEOUT = 0.5, 4.0
"""Seconds to wait for a publisher to send what is missing: at first, and at most. It doubles when nothing comes: the way may
be slow, or the question went down with a connection."""


@dataclass(frozen=True, slots=True)
class Repair:
    """What a publisher sent when it was asked for missing messages.

    Attributes:
        salt: of the stream.
        floor: lowest sequence number that the publisher still has; 0: it did not answer.
        packets: as they were first sent.
    """

    salt: bytes
    floor: int
    packets: list[memoryview]


class Repairs:
    """Asks the publishers of one topic, and keeps their answers until they are dealt with."""

    def __init__(
        self, entry: Entry, transport: Transport, pool: Workers, refusals: Refusals, on_answer: Callable[[], None]
    ) -> None:
        """
        Args:
            pool: where questions wait for their answers.
            refusals: counts answers that cannot be read.
            on_answer: called when there is something to `take`; on one of the pool's threads.
        """
        self._entry, self._transport, self._pool = entry, transport, pool
        self._refusals, self._on_answer = refusals, on_answer
        self._answers: deque[Repair] = deque()
        self._timeouts: dict[bytes, float] = {}

    def ask(self, salt: bytes, ranges: list[tuple[int, int]]) -> bool:
        """Ask for ranges of a stream's messages; False: too much is being asked already."""
        return self._pool.submit(self._ask, salt, ranges)

    def take(self) -> Repair | None:
        """The next answer."""
        return self._answers.popleft() if self._answers else None

    def _ask(self, salt: bytes, ranges: list[tuple[int, int]]) -> None:
        repair, first = Repair(salt, 0, []), ANSWER_TIMEOUT[0]
        timeout = self._timeouts.get(salt, first)
        try:
            key = lanes.key(self._entry.name, lanes.REPLAY, salt.hex())
            repair = Repair(salt, *parse_answer(self._transport.request(key, make_request(ranges), timeout)))
            self._timeouts.pop(salt, None)
        except NoReply:
            self._timeouts = {salt: min(2 * timeout, ANSWER_TIMEOUT[1])}  # of the stream in trouble; others begin anew
        except Refused as refused:
            self._refusals.add(refused.reason)
        self._answers.append(repair)
        self._on_answer()
