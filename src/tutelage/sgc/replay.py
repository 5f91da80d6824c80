"""Messages are taken once, in time: a sliding window for each start of each sender, and a maximum age.

Memory is bounded, and only messages that were authenticated get to it. What is forgotten leaves a mark, the floor: the
newest time of sending among the forgotten; a stream that is not remembered must be newer than that.
"""

from __future__ import annotations

import threading
from collections import OrderedDict

from tutelage.sgc.reasons import Reason, Refused

WINDOW = 1 << 17
"""Messages: what is fetched again after a gap lies far behind the newest, 2.5 seconds of a fast topic or more."""
MAX_SALTS = 8
MAX_SENDERS = 1024
TOLERANCE_NS = 5_000_000_000
"""By how much clocks of sender and receiver may differ: 5 seconds."""
_ONES = (1 << WINDOW) - 1


class Window:
    """Which sequence numbers were seen: the highest, and a bit for each of the `WINDOW` up to it."""

    __slots__ = ("highest", "seen", "sent")

    def __init__(self) -> None:
        self.highest = 0
        self.seen = 0
        self.sent = 0
        """Newest time of sending, nanoseconds."""

    def fresh(self, first: int, count: int) -> bool:
        """Are all of `first`, ..., `first + count - 1` new, and not behind the window?"""
        behind = self.highest - first
        if behind < 0:
            return True
        # The oldest must be in the window; those beyond the highest are new anyway.
        if behind >= WINDOW:
            return False
        low = max(behind - count + 1, 0)
        return not (self.seen >> low) & ((1 << (behind - low + 1)) - 1)

    def add(self, first: int, count: int, sent: int) -> None:
        """Mark them as seen."""
        last = first + count - 1
        if last > self.highest:
            self.seen = (self.seen << min(last - self.highest, WINDOW)) & _ONES
            self.highest = last
        low = self.highest - last
        self.seen |= (((1 << count) - 1) << low) & _ONES
        self.sent = max(self.sent, sent)


class Replay:
    """Windows of all senders of one topic and lane, as one receiver sees them. Safe to use from several threads."""

    def __init__(self, max_age: float | None, started: int) -> None:
        """
        Args:
            max_age: seconds, None for no limit.
            started: when the receiver began, nanoseconds since 1970: what was sent long before may be a repetition of what
                an earlier start of the receiver had.
        """
        self._max_age = None if max_age is None else round(max_age * 1e9)
        self._floor = started - TOLERANCE_NS
        self._senders: OrderedDict[bytes, _Sender] = OrderedDict()
        self._lock = threading.Lock()

    def check(self, sender: bytes, salt: bytes, first: int, count: int, sent: int, now: int) -> None:
        """Would `admit` take it? Remembers nothing, so it may be asked before a message is authenticated.

        Raises:
            Refused: TOO_OLD, FUTURE, REPLAYED or STALE.
        """
        self.check_time(sent, now)
        with self._lock:
            self._check(sender, salt, first, count, sent)

    def admit(self, sender: bytes, salt: bytes, first: int, count: int, sent: int, now: int) -> None:
        """Take a message (a batch of `count`) that is authentic, once.

        Raises:
            Refused: TOO_OLD, FUTURE, REPLAYED or STALE.
        """
        self.check_time(sent, now)
        with self._lock:
            self._check(sender, salt, first, count, sent)
            known = self._senders.get(sender)
            if known is None:
                known = self._senders[sender] = _Sender(self._floor)
                if len(self._senders) > MAX_SENDERS:
                    _, forgotten = self._senders.popitem(last=False)
                    self._floor = max(self._floor, forgotten.newest())
            self._senders.move_to_end(sender)
            known.window(salt).add(first, count, sent)

    def check_time(self, sent: int, now: int) -> None:
        """Is a time of sending neither too long ago nor in the future?

        Raises:
            Refused: TOO_OLD or FUTURE.
        """
        if sent > now + TOLERANCE_NS:
            ahead = (sent - now) / 1e9
            raise Refused(Reason.FUTURE, f"sent {ahead:.1f} s in the future: the sender's clock is ahead, or ours is late")
        if self._max_age is not None and now - sent > self._max_age:
            age, limit = (now - sent) / 1e9, self._max_age / 1e9
            raise Refused(Reason.TOO_OLD, f"sent {age:.2f} s ago, and the topic's maximum age is {limit:g} s")

    def _check(self, sender: bytes, salt: bytes, first: int, count: int, sent: int) -> None:
        known = self._senders.get(sender)
        window = known.windows.get(salt) if known else None
        if window is not None:
            if not window.fresh(first, count):
                raise Refused(Reason.REPLAYED, f"message {first} was seen before, or is behind the window")
        elif sent <= (known.floor if known else self._floor):
            raise Refused(Reason.STALE, "a stream that is older than what was dealt with before")


class _Sender:
    __slots__ = ("floor", "windows")

    def __init__(self, floor: int) -> None:
        self.floor = floor
        self.windows: OrderedDict[bytes, Window] = OrderedDict()

    def window(self, salt: bytes) -> Window:
        found = self.windows.get(salt)
        if found is None:
            found = self.windows[salt] = Window()
            if len(self.windows) > MAX_SALTS:
                _, forgotten = self.windows.popitem(last=False)
                self.floor = max(self.floor, forgotten.sent)
        self.windows.move_to_end(salt)
        return found

    def newest(self) -> int:
        return max([self.floor, *(window.sent for window in self.windows.values())])
