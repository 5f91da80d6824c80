"""Chains: one signature confirms many messages, some milliseconds after them.

Every `EVERY` messages, or after `anchor_every` seconds, the sender signs the list of digests of the messages since the last
anchor, and of those before it again, so that one lost anchor costs nothing. A lost message breaks no other one. The anchor
rides on the last of the messages, or alone when the sender falls silent.

Until its anchor comes a message is only known to be by some member of the topic. The receiver holds it back by default; a
receiver that asks for provisional messages gets them at once, marked as such, and nothing more from a sender whose messages
stay unconfirmed for `CONFIRM_SECONDS`.
"""

from __future__ import annotations

import hashlib
import struct
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from tutelage.sgc.packet import Opened, Statements
from tutelage.sgc.reasons import Reason, Refusals, Refused

EVERY = 64
ANCHOR_SECONDS = 0.02
CONFIRM_SECONDS = 1.0
MAX_HELD = 1024
MAX_HELD_BYTES = 64 << 20
_ENTRY = struct.Struct(">Q32s")
_SIGNATURE = 64
_MAX_ENTRIES = 2 * EVERY
_MAX_STREAMS = 64
MAX_CONFIRMED = 8192
"""Digests kept a stream, for messages that are fetched again after their anchors came."""

_V = TypeVar("_V")
_NOTHING: dict[int, bytes] = {}
Stream = tuple[bytes, bytes]
"""Sender and salt."""


class Link:
    """The sender's side: what is not confirmed yet. Not for several threads at once."""

    def __init__(self, anchor_every: float) -> None:
        self._patience = round(anchor_every * 1e9)
        self._since: list[bytes] = []
        self._before: list[bytes] = []
        self._oldest = 0

    @property
    def pending(self) -> bool:
        """Is there anything to confirm?"""
        return bool(self._since)

    def due(self, now: int) -> bool:
        """Should the message that is about to be sent carry an anchor? now: nanoseconds."""
        return len(self._since) + 1 >= EVERY or (bool(self._since) and now - self._oldest >= self._patience)

    def proof_bytes(self, *, with_message: bool) -> int:
        """Length of an anchor, without its seal."""
        return _ENTRY.size * (len(self._before) + len(self._since) + with_message) + _SIGNATURE

    def add(self, first: int, statement: bytes, now: int) -> None:
        """A message was made."""
        if not self._since:
            self._oldest = now
        self._since.append(_ENTRY.pack(first, hashlib.sha256(statement).digest()))

    def anchor(self, sender: bytes, salt: bytes, statements: Statements, key: Ed25519PrivateKey) -> bytes:
        """Confirm what is pending."""
        entries = b"".join((*self._before, *self._since))
        self._before, self._since = self._since, []
        return entries + key.sign(statements.anchor(sender, salt, entries))


class Confirmation:
    """The receiver's side. Not for several threads at once."""

    def __init__(self, statements: Statements, refusals: Refusals, *, provisional: bool) -> None:
        self._statements, self._refusals, self._provisional = statements, refusals, provisional
        self._held: OrderedDict[tuple[Stream, int, bytes], tuple[list[Opened], int]] = OrderedDict()
        self._held_bytes = 0
        self._delivered: OrderedDict[Stream, OrderedDict[int, tuple[bytes, int]]] = OrderedDict()
        self._confirmed: OrderedDict[Stream, OrderedDict[int, bytes]] = OrderedDict()

    def message(
        self, stream: Stream, first: int, statement: bytes, messages: list[Opened], size: int, now: int
    ) -> list[Opened] | None:
        """A message came; what can be given to the receiver now. None if it is to be held back.

        Raises:
            Refused: UNCONFIRMED (provisional): earlier messages of the stream were not confirmed in time. FORGED: an anchor
                says that this is another message. REPLAYED: it is held already.
        """
        proof = hashlib.sha256(statement).digest()
        known = (self._confirmed.get(stream) or _NOTHING).get(first)
        if known is not None:
            if known != proof:
                raise Refused(Reason.FORGED, f"message {first} is not the one that its sender confirmed")
            return messages
        if self._provisional:
            waiting = _of(self._delivered, stream)
            if waiting and now - next(iter(waiting.values()))[1] > CONFIRM_SECONDS * 1e9:
                raise Refused(Reason.UNCONFIRMED, f"messages of {messages[0].sender} are not confirmed by anchors")
            waiting[first] = proof, now
            while len(waiting) > MAX_HELD:
                waiting.popitem(last=False)
            return messages
        if (stream, first, proof) in self._held:
            raise Refused(Reason.REPLAYED, f"message {first} is held already, until its sender confirms it")
        self._held[stream, first, proof] = messages, size
        self._held_bytes += size
        while len(self._held) > MAX_HELD or self._held_bytes > MAX_HELD_BYTES:
            _, (lost, size) = self._held.popitem(last=False)
            self._held_bytes -= size
            self._refusals.add(Reason.UNCONFIRMED, len(lost))
        return None

    def anchor(
        self, stream: Stream, proof: bytes, key: Ed25519PublicKey, admit: Callable[[int, list[Opened]], None]
    ) -> list[Opened]:
        """An anchor came: the messages that it confirms and that were held, in order.

        admit: called with sequence and messages before they are given; raises `Refused` for those that must not be.

        Raises:
            Refused: MALFORMED or FORGED.
        """
        entries, signature = proof[:-_SIGNATURE], proof[-_SIGNATURE:]
        if len(entries) % _ENTRY.size or not 0 < len(entries) <= _MAX_ENTRIES * _ENTRY.size:
            raise Refused(Reason.MALFORMED, "an anchor with an impossible length")
        try:
            key.verify(signature, self._statements.anchor(*stream, entries))
        except InvalidSignature:
            raise Refused(Reason.FORGED, "an anchor that the sender did not sign") from None
        confirmed = _of(self._confirmed, stream)
        found: list[Opened] = []
        for first, expected in _ENTRY.iter_unpack(entries):
            if self._provisional:
                given = _of(self._delivered, stream).pop(first, None)
                if given is not None and given[0] != expected:
                    self._refusals.add(Reason.FORGED)  # too late to hold it back: that is what provisional means
            elif (held := self._held.pop((stream, first, expected), None)) is not None:
                self._held_bytes -= held[1]
                try:
                    admit(first, held[0])
                    found += held[0]
                except Refused as refused:
                    self._refusals.add(refused.reason, len(held[0]))
            confirmed[first] = expected
        while len(confirmed) > MAX_CONFIRMED:
            confirmed.popitem(last=False)
        self._drop_forged(stream, confirmed)
        return found

    def forget(self) -> None:
        """Drop everything, as when trust has changed."""
        self._held.clear()
        self._held_bytes = 0
        self._delivered.clear()
        self._confirmed.clear()

    def _drop_forged(self, stream: Stream, confirmed: OrderedDict[int, bytes]) -> None:
        """Held messages for whose sequence the sender confirmed another one."""
        forged = [key for key in self._held if key[0] == stream and key[1] in confirmed]
        for key in forged:
            messages, size = self._held.pop(key)
            self._held_bytes -= size
            self._refusals.add(Reason.FORGED, len(messages))


def _of(streams: OrderedDict[Stream, OrderedDict[int, _V]], stream: Stream) -> OrderedDict[int, _V]:
    found = streams.setdefault(stream, OrderedDict())
    streams.move_to_end(stream)
    while len(streams) > _MAX_STREAMS:
        streams.popitem(last=False)
    return found
