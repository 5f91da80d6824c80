"""Why something from the network was refused. Every refusal has one reason, is counted, and never stops a program."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum

from tutelage.errors import TutelageError


class Reason(StrEnum):
    """Why a packet, grant, credential or notice was not accepted. The value is the name of its counter."""

    MALFORMED = "malformed"  # not a packet of ours: length, version, field out of range
    OVERSIZE = "oversize"  # longer than a packet may be
    WRONG_MODE = "wrong_mode"  # authenticity other than the policy's
    UNKNOWN_EPOCH = "unknown_epoch"  # sealed under a key that we do not have (yet): ask the owner for a grant
    OLD_EPOCH = "old_epoch"  # sealed under a key that has been replaced, and the grace period is over
    TAMPERED = "tampered"  # the AEAD tag does not fit: a bit flip, a truncation, a wrong key
    UNKNOWN_SENDER = "unknown_sender"  # its credential has not been seen yet: ask for an introduction
    FORGED = "forged"  # sealed with the topic's key, but the signature or session tag is not the sender's
    NO_SESSION = "no_session"  # no tag for us: open a session with the sender
    NOT_ALLOWED = "not_allowed"  # an authentic sender that the policy does not allow here
    WRONG_AUTHORITY = "wrong_authority"  # a credential or notice that our root did not issue
    EXPIRED = "expired"  # a credential after its time (or before it)
    REVOKED = "revoked"  # a credential on the deny list
    REPLAYED = "replayed"  # a sequence number seen before, or behind the window
    TOO_OLD = "too_old"  # sent longer ago than the topic's maximum age
    STALE = "stale"  # a new salt of this sender whose messages are older than what we have already dealt with
    FUTURE = "future"  # sent after now: the clocks disagree by more than the tolerance
    UNCONFIRMED = "unconfirmed"  # chain mode: no anchor confirmed the message in time
    ROLLBACK = "rollback"  # a policy, deny list or grant older than the one we hold
    NOT_FOR_US = "not_for_us"  # a grant for another node


class Refused(TutelageError):
    """Something from the network that is not accepted.

    Attributes:
        reason: which counter it belongs to.
    """

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Refusals:
    """Counts of refusals by reason; safe to use from several threads."""

    def __init__(self) -> None:
        self._counts: Counter[Reason] = Counter()
        self._lock = threading.Lock()

    def add(self, reason: Reason, count: int = 1) -> None:
        """Count."""
        with self._lock:
            self._counts[reason] += count

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Count the refusal that leaves the block, if one does."""
        try:
            yield
        except Refused as refused:
            self.add(refused.reason)
            raise

    def __getitem__(self, reason: Reason) -> int:
        return self._counts[reason]

    def total(self) -> int:
        """All of them."""
        return self._counts.total()

    def as_dict(self) -> dict[str, int]:
        """Counts by name of the reason, only those that occurred."""
        with self._lock:
            return {str(reason): count for reason, count in sorted(self._counts.items()) if count}
