"""In which order messages reach the application, each once: in order with gaps fetched again, or the newest wins.

Pure bookkeeping without threads, clocks or network: time is passed in, in seconds of a clock that does not jump. Messages
come in opened and verified; a hostile network can at most delay or drop them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field

from tutelage.sgc.frames import age_of
from tutelage.sgc.sealing import Opened

PATIENCE = 5.0
"""Seconds without progress after which what is missing is given up, reported as lost, and delivery goes on."""

IMPATIENCE = 0.5
"""The same for a publisher that did not answer in time before: delay by those who drop what we ask for stays bounded."""

FIRST_ASK = 0.005
"""Seconds from noticing a gap to asking for it: packets that merely overtook each other need no help."""

ASK_AGAIN = 0.25
"""Seconds from an answer that did not close the gap to the next question; doubles up to a second."""

HELD_MESSAGES = 65_536
HELD_BYTES = 128 << 20
"""What may wait behind a gap; beyond, the gap is given up."""

SLACK = 0.1
"""Seconds by which a stream may be older than our subscription and still count as begun after it."""


TWICE_NS = 5_000_000_000
"""An earlier start of a sender that still sends so long after the next one began runs beside it."""


@dataclass(slots=True)
class Stream:
    """The messages of one start of a sender.

    Attributes:
        began: when its first message that we heard was sent, nanoseconds since 1970.
        next: sequence number that is to be delivered next.
        held: messages that wait behind a gap, by sequence number.
        since: when there last was progress, while there is a gap; None without one.
        ask_at: when to ask for what is missing.
        asked: `next` when we last asked.
        pause: seconds until we ask again if that does not help.
        patience: seconds without progress after which the gap is given up.
    """

    sender: str
    salt: bytes
    began: int
    next: int
    held: dict[int, Opened] = field(default_factory=dict)
    size: int = 0
    since: float | None = None
    ask_at: float = 0.0
    asked: int = 0
    pause: float = ASK_AGAIN
    patience: float = PATIENCE


@dataclass(slots=True)
class Tally:
    """What happened to the messages of a topic.

    Attributes:
        lost: missing for good.
        late: came after a newer one had been delivered (lossy topics), or from an earlier start of the sender.
        repaired: fetched again from the publisher.
        gaps: times that messages were missing.
    """

    lost: int = 0
    late: int = 0
    repaired: int = 0
    gaps: int = 0


class Delivery(ABC):
    """Takes messages as they come, gives them as the application should see them."""

    def __init__(self, started: float, patience: float = PATIENCE, *, from_first_heard: bool = False) -> None:
        """
        Args:
            started: when the subscription began.
            patience: seconds without progress after which what is missing is given up.
            from_first_heard: nothing before the first message of a stream that we hear was meant for us, even if the
                stream began after the subscription: what was sent before a session was open is for others.
        """
        self.started = started
        self.patience = patience
        self.from_first_heard = from_first_heard
        self.tally = Tally()
        self.twice: set[str] = set()
        """Senders of which two programs send at once: only the one that began later is heard."""
        self.gapped: dict[str, Stream] = {}
        """Streams with a gap, by sender."""
        self._current: dict[str, Stream] = {}
        self._past: deque[bytes] = deque(maxlen=256)  # salts of earlier starts

    @abstractmethod
    def accept(self, message: Opened, now: float) -> list[Opened]:
        """Take a message; returns those that are to be delivered now."""

    def accept_all(self, messages: list[Opened], now: float) -> list[Opened]:
        """The same for all messages of a packet, of which there is at least one."""
        return [ready for message in messages for ready in self.accept(message, now)]

    def due(self, now: float) -> list[Opened]:
        """What is to be delivered because time has passed."""
        return []

    def questions(self, now: float) -> list[tuple[bytes, list[tuple[int, int]]]]:
        """What to ask for now: salts, each with the ranges of sequence numbers that are missing."""
        return []

    def answered(self, salt: bytes, floor: int, now: float, *, in_vain: bool = False) -> list[Opened]:
        """A question was answered, and what could be opened of the answer has been accepted.

        floor: the publisher has nothing below this sequence number any more; 0 if nobody answered.
        in_vain: the answer holds packets that will never be opened, such as those for an earlier session.
        """
        return []

    @property
    def crowded(self) -> bool:
        """Does so much wait behind gaps that further packets had better stay unopened, to be fetched again later?"""
        return False

    def current(self, sender: str) -> Stream | None:
        """The messages of a sender's present start."""
        return self._current.get(sender)

    def salts(self) -> set[bytes]:
        """Of the senders' present starts."""
        return {stream.salt for stream in self._current.values()}

    def wake(self) -> float | None:
        """When `due` or `questions` will have something, at the earliest."""
        return None

    def _stream(self, message: Opened, now: float) -> tuple[Stream | None, list[Opened]]:
        """The stream of a message, None if its sender has started again since; and what its predecessor still held."""
        stream = self._current.get(message.sender)
        if stream is not None and stream.salt == message.salt:
            return stream, []
        if message.salt in self._past:
            if stream is not None and message.sent > stream.began + TWICE_NS:
                self.twice.add(message.sender)
            return None, []
        left = []
        if stream is not None:
            self._past.append(stream.salt)
            left = self._release_all(stream, now)
        # Begun after us: whatever came before this message was meant for us too.
        ours = not self.from_first_heard and age_of(message.label) <= now - self.started + SLACK
        first = 1 if ours else message.sequence
        stream = self._current[message.sender] = Stream(
            message.sender, message.salt, message.sent, first, patience=self.patience
        )
        return stream, left

    def _release_all(self, stream: Stream, now: float) -> list[Opened]:
        return []


class InOrder(Delivery):
    """Every message, in order. What is missing is asked for, and given up only when the publisher cannot give it."""

    def accept_all(self, messages: list[Opened], now: float) -> list[Opened]:
        first, count = messages[0], len(messages)
        known = self._current.get(first.sender)
        if known is not None and first.sequence == known.next and first.salt == known.salt and not known.held:
            after = known.next + count
            if count == 1 or messages[-1].sequence == after - 1:
                known.next = after
                return messages  # as nearly always
        return super().accept_all(messages, now)

    def accept(self, message: Opened, now: float) -> list[Opened]:
        stream, ready = self._stream(message, now)
        if stream is None or message.sequence < stream.next or message.sequence in stream.held:
            self.tally.late += 1
            return ready
        if message.sequence == stream.next and not stream.held:
            stream.next += 1
            ready.append(message)
            return ready
        stream.held[message.sequence] = message
        stream.size += len(message.payload)
        if stream.since is None:
            stream.ask_at, stream.pause = now + FIRST_ASK, ASK_AGAIN
            self.tally.gaps += 1
            self._wait(stream, now)
        ready += self._advance(stream, now)
        while len(stream.held) > HELD_MESSAGES or stream.size > HELD_BYTES:
            ready += self._skip(stream, min(stream.held), now)
        return ready

    @property
    def crowded(self) -> bool:
        return bool(self.gapped) and any(
            len(stream.held) > HELD_MESSAGES // 2 or stream.size > HELD_BYTES // 2 for stream in tuple(self.gapped.values())
        )

    def due(self, now: float) -> list[Opened]:
        ready: list[Opened] = []
        for stream in tuple(self.gapped.values()):
            if stream.since is not None and now - stream.since >= stream.patience:
                stream.patience = min(stream.patience, IMPATIENCE)
                ready += self._release_all(stream, now)
        return ready

    def questions(self, now: float) -> list[tuple[bytes, list[tuple[int, int]]]]:
        asked = []
        for stream in self.gapped.values():
            if now >= stream.ask_at:
                stream.asked, stream.ask_at = stream.next, now + PATIENCE  # until `answered`
                asked.append((stream.salt, _gaps(stream)))
        return asked

    def answered(self, salt: bytes, floor: int, now: float, *, in_vain: bool = False) -> list[Opened]:
        ready: list[Opened] = []
        for stream in tuple(self.gapped.values()):
            if stream.salt == salt:
                if in_vain and stream.next == stream.asked:
                    floor = min(stream.held)
                if floor > stream.next:
                    ready += self._skip(stream, floor, now)
                if stream.next > stream.asked:
                    stream.ask_at, stream.pause, stream.patience = now, ASK_AGAIN, self.patience
                else:
                    stream.ask_at, stream.pause = now + stream.pause, min(1.0, 2 * stream.pause)
        return ready

    def wake(self) -> float | None:
        if not self.gapped:
            return None
        waiting = [(stream, stream.since) for stream in tuple(self.gapped.values())]
        return min((min(s.ask_at, since + s.patience) for s, since in waiting if since is not None), default=None)

    def _wait(self, stream: Stream, since: float | None) -> None:
        """A stream has a gap and no progress since then; None: it has none any more."""
        stream.since = since
        if since is not None:
            self.gapped[stream.sender] = stream
        else:
            self.gapped.pop(stream.sender, None)

    def _advance(self, stream: Stream, now: float) -> list[Opened]:
        """What is next in turn among those held."""
        ready = []
        while stream.held and (message := stream.held.pop(stream.next, None)) is not None:
            stream.size -= len(message.payload)
            stream.next += 1
            ready.append(message)
        if not stream.held:
            self._wait(stream, None)
        elif ready:
            self._wait(stream, now)
        return ready

    def _skip(self, stream: Stream, to: int, now: float) -> list[Opened]:
        """Give up what is missing below `to`; what is held below it is delivered."""
        ready: list[Opened] = []
        while stream.held and stream.next < to:
            first = min(min(stream.held), to)
            self.tally.lost += first - stream.next
            stream.next = first
            ready += self._advance(stream, now)
        self._wait(stream, now if stream.held else None)
        return ready

    def _release_all(self, stream: Stream, now: float) -> list[Opened]:
        return self._skip(stream, max(stream.held) + 1, now) if stream.held else []


class Newest(Delivery):
    """Messages as they come, never one older than the last. What is missing is counted and not asked for."""

    def accept(self, message: Opened, now: float) -> list[Opened]:
        stream, _ = self._stream(message, now)
        if stream is None or message.sequence < stream.next:
            self.tally.late += 1
            return []
        if message.sequence > stream.next:
            self.tally.gaps += 1
            self.tally.lost += message.sequence - stream.next
        stream.next = message.sequence + 1
        return [message]


def _gaps(stream: Stream) -> list[tuple[int, int]]:
    """Ranges that are missing, in order."""
    ranges, expected = [], stream.next
    for sequence in sorted(stream.held):
        if sequence > expected:
            ranges.append((expected, sequence - 1))
        expected = sequence + 1
    return ranges
