"""The epochs of one topic's key: under which to seal, which to accept, and when each is over."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field

from tutelage.sgc.reasons import Reason, Refused

_PACKED = struct.Struct(">I32sddd")
CLOCK_TOLERANCE = 60.0
"""Seconds by which the clocks of owner and member may differ where epochs begin and end."""


@dataclass(frozen=True)
class Epoch:
    """One key. Times are seconds since 1970 on the owner's clock.

    Attributes:
        number: counts up; an owner that lost its memory continues above, as it starts from the time of day.
        key: 32 bytes.
        begins: senders use it from then on.
        ends: it is over, whether or not there is a next one: so revocation holds even if no message gets through.
        grace: seconds for which its predecessor is accepted after it began; 0 after a revocation.
        learned: when this node got it, on its own clock.
    """

    number: int
    key: bytes = field(repr=False)
    begins: float
    ends: float
    grace: float
    learned: float = 0.0

    def pack(self) -> bytes:
        """As sent in a grant."""
        return _PACKED.pack(self.number, self.key, self.begins, self.ends, self.grace)


def read_epochs(data: bytes, learned: float) -> list[Epoch]:
    """Read one to four packed epochs.

    Raises:
        Refused: MALFORMED.
    """
    if len(data) % _PACKED.size or not 1 <= len(data) // _PACKED.size <= 4:
        raise Refused(Reason.MALFORMED, "a grant with an impossible number of keys")
    found = [
        Epoch(number, key, begins, ends, grace, learned) for number, key, begins, ends, grace in _PACKED.iter_unpack(data)
    ]
    for epoch in found:
        if not (0 < epoch.begins < epoch.ends < 2**40 and 0 <= epoch.grace < 2**32):  # also false for NaN
            raise Refused(Reason.MALFORMED, "a grant whose key has an impossible time")
    return found


class Epochs:
    """What a node holds of one topic. Not for several threads at once; `Keyring` holds the lock."""

    def __init__(self, held: Iterable[Epoch] = ()) -> None:
        self._held: dict[int, Epoch] = {epoch.number: epoch for epoch in held}

    def all(self) -> list[Epoch]:
        """By number, oldest first."""
        return [self._held[number] for number in sorted(self._held)]

    @property
    def newest(self) -> Epoch | None:
        """The one with the highest number, begun or not."""
        return self._held[max(self._held)] if self._held else None

    def sealing(self, now: float) -> Epoch | None:
        """The newest that has begun and is not over; None if there is none."""
        valid = [epoch for epoch in self.all() if now < epoch.ends]
        begun = [epoch for epoch in valid if epoch.begins <= now]
        if begun:
            return begun[-1]
        # The owner's clock may be ahead of ours.
        soon = [epoch for epoch in valid if epoch.begins <= now + CLOCK_TOLERANCE]
        return soon[0] if soon else None

    def opening(self, number: int, now: float) -> Epoch:
        """The epoch of a packet, if it is still accepted.

        Raises:
            Refused: UNKNOWN_EPOCH (newer than what we have) or OLD_EPOCH.
        """
        epoch = self._held.get(number)
        if epoch is None:
            if self.newest is None or number > self.newest.number:
                raise Refused(Reason.UNKNOWN_EPOCH, f"sealed under epoch {number}, whose key has not arrived yet")
            raise Refused(Reason.OLD_EPOCH, f"sealed under epoch {number}; the present one is {self.newest.number}")
        if self._over(epoch, now):
            raise Refused(Reason.OLD_EPOCH, f"sealed under epoch {number}, which is over")
        return epoch

    def add(self, epochs: Iterable[Epoch]) -> bool:
        """Take new ones; True if there were any. One that is held already stays as it was learned."""
        new = [epoch for epoch in epochs if epoch.number not in self._held]
        self._held.update((epoch.number, epoch) for epoch in new)
        return bool(new)

    def drop(self, now: float) -> bool:
        """Forget those that are over; True if there were any."""
        over = [epoch.number for epoch in self._held.values() if self._over(epoch, now)]
        for number in over:
            del self._held[number]
        return bool(over)

    def _over(self, epoch: Epoch, now: float) -> bool:
        if now > epoch.ends + CLOCK_TOLERANCE:
            return True
        later = [other for other in self._held.values() if other.number > epoch.number]
        return any(now > max(other.begins, other.learned) + other.grace for other in later)
