"""Messages are taken once, in time: a sliding window for each start of each sender, and a maximum age.

Memory is bounded, and only messages that were authenticated get to it. What is forgotten leaves a mark, the floor: the
newest time of sending among the forgotten; a stream that is not remembered must be newer than that.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator

from tutelage.sgc.reasons import Reason, Refused

WINDOW = 1 << 17
"""Messages: what is fetched again after a gap lies far behind the newest, 2.5 seconds of a fast topic or more."""
MAX_SALTS = 8
MAX_SENDERS = 1024
TOLERANCE_NS = 5_000_000_000
"""By how much clocks of sender and receiver may differ: 5 seconds."""
_BLOCK = 1024
_ENDLESS = 1 << 64
"""Nanoseconds; no time in a header is so long ago."""


class Window:
    """Which sequence numbers were seen: those of the `WINDOW` up to the highest, in blocks of bits (RFC 6479).

    A stream takes as much memory as it has messages, and no bit is ever moved. The numbers that came last one after the
    other, without a gap, are only a run: they become bits when the run ends.
    """

    __slots__ = ("_blocks", "_run", "highest", "sent")

    def __init__(self) -> None:
        self._blocks: dict[int, int] = {}
        self._run = 1  # first number of the run that ends with the highest
        self.highest = 0
        self.sent = 0
        """Newest time of sending, nanoseconds."""

    def fresh(self, first: int, count: int) -> bool:
        """Are all of `first`, ..., `first + count - 1` new, and not behind the window?"""
        if first > self.highest:
            return True
        if self.highest - first >= WINDOW or first + count > self._run:
            return False
        return not any(self._blocks.get(block, 0) & bits for block, bits in _spans(first, count))

    def add(self, first: int, count: int, sent: int) -> None:
        """Mark them as seen; they are fresh."""
        if first == self.highest + 1:
            self.highest += count
        elif first < self._run:
            self._mark(first, count)
        else:
            self._mark(self._run, self.highest + 1 - self._run)
            self._run, self.highest = first, first + count - 1
            oldest = (self.highest - WINDOW) // _BLOCK
            for block in [block for block in self._blocks if block < oldest]:
                del self._blocks[block]
        if sent > self.sent:
            self.sent = sent

    def _mark(self, first: int, count: int) -> None:
        begin = max(first, self.highest + 1 - WINDOW)  # what is behind the window needs no bits
        for block, bits in _spans(begin, first + count - begin):
            self._blocks[block] = self._blocks.get(block, 0) | bits


def _spans(first: int, count: int) -> Iterator[tuple[int, int]]:
    """The blocks that these numbers lie in, and their bits there."""
    last = first + count - 1
    for block in range(first // _BLOCK, last // _BLOCK + 1):
        low, high = max(first - block * _BLOCK, 0), min(last - block * _BLOCK, _BLOCK - 1)
        yield block, ((1 << high - low + 1) - 1) << low


class Replay:
    """Windows of all senders of one topic and lane, as one receiver sees them. Safe to use from several threads.

    Attributes:
        max_age: nanoseconds.
    """

    def __init__(self, max_age: float | None, started: int) -> None:
        """
        Args:
            max_age: seconds, None for no limit.
            started: when the receiver began, nanoseconds since 1970: what was sent long before may be a repetition of what
                an earlier start of the receiver had.
        """
        self.set_max_age(max_age)
        self._floor = started - TOLERANCE_NS
        self._senders: OrderedDict[bytes, _Sender] = OrderedDict()
        self._lock = threading.Lock()

    def set_max_age(self, max_age: float | None) -> None:
        """The policy may change it. Seconds."""
        self.max_age = _ENDLESS if max_age is None else round(max_age * 1e9)

    def check(self, sender: bytes, salt: bytes, first: int, sent: int, now: int) -> None:
        """Could a message be taken, as far as its header says? Remembers nothing, so it may be asked before the message is
        authenticated.

        Raises:
            Refused: TOO_OLD, FUTURE, REPLAYED or STALE.
        """
        if not now - self.max_age <= sent <= now + TOLERANCE_NS:
            self._check_time(sent, now)
        known = self._senders.get(sender)
        window = known.windows.get(salt) if known is not None else None
        if window is None or first <= window.highest:  # else it is new, as nearly all are
            self._check(known, window, first, 1, sent)

    def admit(self, sender: bytes, salt: bytes, first: int, count: int, sent: int, now: int) -> Window:
        """Take a message (a batch of `count`) that is authentic, once. Returns the window of its stream.

        Raises:
            Refused: TOO_OLD, FUTURE, REPLAYED or STALE.
        """
        if not now - self.max_age <= sent <= now + TOLERANCE_NS:
            self._check_time(sent, now)
        with self._lock:
            known = self._senders.get(sender)
            window = known.windows.get(salt) if known is not None else None
            if window is None or first <= window.highest:
                self._check(known, window, first, count, sent)
            if known is None:
                known = self._senders[sender] = _Sender(self._floor)
                if len(self._senders) > MAX_SENDERS:
                    _, forgotten = self._senders.popitem(last=False)
                    self._floor = max(self._floor, forgotten.newest())
            if window is None:
                window = known.add(salt)
            elif len(self._senders) > 1 or len(known.windows) > 1:
                self._senders.move_to_end(sender)
                known.windows.move_to_end(salt)
            window.add(first, count, sent)
            return window

    def _check_time(self, sent: int, now: int) -> None:
        """Is a time of sending neither too long ago nor in the future?

        Raises:
            Refused: TOO_OLD or FUTURE.
        """
        if sent > now + TOLERANCE_NS:
            ahead = (sent - now) / 1e9
            raise Refused(Reason.FUTURE, f"sent {ahead:.1f} s in the future: the sender's clock is ahead, or ours is late")
        if now - sent > self.max_age:
            age, limit = (now - sent) / 1e9, self.max_age / 1e9
            raise Refused(Reason.TOO_OLD, f"sent {age:.2f} s ago, and the topic's maximum age is {limit:g} s")

    def _check(self, known: _Sender | None, window: Window | None, first: int, count: int, sent: int) -> None:
        if window is not None:
            if not window.fresh(first, count):
                raise Refused(Reason.REPLAYED, f"message {first} was seen before, or is behind the window")
        elif sent <= (known.floor if known is not None else self._floor):
            raise Refused(Reason.STALE, "a stream that is older than what was dealt with before")


class _Sender:
    __slots__ = ("floor", "windows")

    def __init__(self, floor: int) -> None:
        self.floor = floor
        self.windows: OrderedDict[bytes, Window] = OrderedDict()

    def add(self, salt: bytes) -> Window:
        window = self.windows[salt] = Window()
        if len(self.windows) > MAX_SALTS:
            _, forgotten = self.windows.popitem(last=False)
            self.floor = max(self.floor, forgotten.sent)
        return window

    def newest(self) -> int:
        return max([self.floor, *(window.sent for window in self.windows.values())])
