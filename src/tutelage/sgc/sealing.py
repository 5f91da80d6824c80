"""Messages end to end: sealed by the sender, opened by the receiver, and nobody between can read, forge or repeat them.

Knows no network. A packet is

    header (56 bytes, authenticated) | ciphertext | tag (16) | proof of the sender

and names neither topic nor node: the sender is a pseudonymous key id that differs from topic to topic.
"""

from __future__ import annotations

from dataclasses import dataclass

from tutelage.sgc.access import Lane
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.reasons import Refusals

Packet = bytes | bytearray
"""What `Sealer` gives and a transport carries. A bytearray saves a copy of large messages; it is the caller's own."""


@dataclass(frozen=True, slots=True)
class Opened:
    """A message that was opened.

    Attributes:
        payload: the message; a read-only view may share memory with other messages of its batch.
        sender: name of the node.
        sequence: 1, 2, ... within (sender, salt), without gaps where nothing was lost. Batches count every message.
        salt: 16 bytes, new each time that the sender starts.
        sent: nanoseconds since 1970 on the sender's clock.
        epoch: of the key.
        authentic: False only for provisional messages of chain mode that are not confirmed yet.
        ident: 40 bytes that identify the packet: sender, salt and sequence; a reply binds to its request's.
    """

    payload: bytes | memoryview
    sender: str
    sequence: int
    salt: bytes
    sent: int
    epoch: int
    authentic: bool
    ident: bytes


class Sealer:
    """Seals the messages of one node on one topic and lane. One for each start of a program: it draws a salt."""

    def __init__(self, keyring: Keyring, alias: str, lane: Lane = Lane.STREAM, *, introduce_every: float = 1.0) -> None:
        """
        Args:
            keyring: of the node that sends.
            alias: of the topic.
            lane: which way.
            introduce_every: seconds after which a message carries the sender's credential again (some 900 bytes).

        Raises:
            NotAllowed: the policy does not let this node send there.
        """
        raise NotImplementedError

    @property
    def salt(self) -> bytes:
        """16 random bytes."""
        raise NotImplementedError

    @property
    def sequence(self) -> int:
        """Of the last message sealed; 0 before the first."""
        raise NotImplementedError

    def seal(self, payload: bytes | bytearray | memoryview, *, bind: bytes = b"", now: int | None = None) -> Packet:
        """One message as one packet.

        payload: up to `MAX_PAYLOAD` bytes.
        bind: further bytes that the receiver must name too; not sent. A reply binds to its request's `Opened.ident`.
        now: nanoseconds since 1970; default: the clock.

        Raises:
            NoKey: no valid key; the message names the owner to ask.
            NotIssued: this node's own certificate has expired.
            ConfigError: the payload is too long.
        """
        raise NotImplementedError

    def seal_many(self, payloads: list[bytes], *, now: int | None = None) -> Packet:
        """Many small messages as one packet with one proof. `Opener.open_many` gives them back one by one."""
        raise NotImplementedError

    def introduce(self) -> None:
        """Let the next packet carry this node's credential, as a receiver said that it does not know us."""
        raise NotImplementedError

    def flush(self, *, now: int | None = None) -> Packet | None:
        """Chain mode: a packet that confirms messages not yet confirmed; None if there are none. To be called every
        `anchor_every` seconds; other modes never need it."""
        raise NotImplementedError

    def accept_session(self, offer: bytes) -> bytes:
        """Session mode: answer a receiver's `Opener.offer_session`. From now on packets carry a tag for it.

        Raises:
            Refused: not from a node that may receive; see the reason.
        """
        raise NotImplementedError


class Opener:
    """Opens what others sent on one topic and lane. Raises only `Refused`, whatever the bytes; counts every refusal."""

    refusals: Refusals

    def __init__(self, keyring: Keyring, alias: str, lane: Lane = Lane.STREAM, *, provisional: bool = False) -> None:
        """
        Args:
            keyring: of the node that receives.
            alias: of the topic.
            lane: which way.
            provisional: chain mode: give messages before they are confirmed, as `authentic=False`. Default: hold them
                (64 at most) until the sender's next anchor confirms them.

        Raises:
            NotAllowed: the policy does not let this node receive there.
        """
        raise NotImplementedError

    def open(self, packet: bytes | bytearray | memoryview, *, bind: bytes = b"", now: int | None = None) -> Opened:
        """The one message of a packet.

        Raises:
            Refused: see `Reason`. Also if the packet holds another number of messages than one: use `open_many`.
        """
        raise NotImplementedError

    def open_many(
        self, packet: bytes | bytearray | memoryview, *, bind: bytes = b"", now: int | None = None
    ) -> list[Opened]:
        """All messages that a packet holds or confirms, in order: one for a plain packet, n for a batch, 0 or more in
        chain mode.

        Raises:
            Refused: see `Reason`.
        """
        raise NotImplementedError

    def offer_session(self) -> bytes:
        """Session mode: a handshake packet for the sender's `Sealer.accept_session`; any number may be open at a time."""
        raise NotImplementedError

    def complete_session(self, answer: bytes) -> str:
        """Session mode: take the sender's answer. Returns the name of the sender.

        Raises:
            Refused: no answer to an offer of ours, or not from a node that may send.
        """
        raise NotImplementedError
