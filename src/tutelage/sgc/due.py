"""What comes next, opened in one step.

In teleoperation nearly every packet is the next one of one sender: in order, in time, and sealed for this receiver alone.
`Opener` asks such packets the same questions each time and gets the same answers, and a processor that has just been woken
takes a microsecond for each call. Here the questions are asked together; whatever differs, the packet is for `Opener`.
"""

from __future__ import annotations

from dataclasses import dataclass

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from tutelage.sgc.home import Home
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.packet import BEGINNING, BODY, HEADER, MAX_PACKET, SESSION_ID, TAG, nonce, read_end
from tutelage.sgc.replay import TOLERANCE_NS, Window

_LEAST = HEADER + TAG + SESSION_ID
_SMALL = 16 << 10  # bytes of a packet up to which a copy of a part costs less than a view of it


@dataclass(slots=True)
class Due:
    """The packet that follows one that was opened, if it is the next of its stream and was sealed alike: one message, for
    the same session alone. Good until `Opener` opens something else. Not for several threads at once.

    Attributes:
        beginning: its first `BEGINNING` bytes: layout and stream.
        kind: the first byte of its label.
        ident: its last bytes: the session.
        cipher: of the stream in that session.
        window: of the stream; it says what is next.
        sender, salt: name of the node, and which of its starts this is.
        keyring, keys, home, beliefs: with versions; at any other version `Opener` looks whether the sender may still send,
        since, until: as outside of this time, in nanoseconds since 1970.
        max_age: nanoseconds.
    """

    beginning: bytes
    kind: int
    ident: bytes
    cipher: AESGCM
    window: Window
    sender: str
    salt: bytes
    keyring: Keyring
    keys: int
    home: Home
    beliefs: int
    since: int
    until: int
    max_age: int

    def open(self, packet: bytes, sequence: int, now: int) -> tuple[bytes, int] | None:
        """The message, and when it was sent, in nanoseconds since 1970.

        sequence: what the receiver waits for.

        None: the packet is not that one, or `Opener` has to look at it. Nothing is remembered of it then.
        """
        if not (packet.startswith(self.beginning) and packet.endswith(self.ident) and _LEAST <= len(packet) <= MAX_PACKET):
            return None
        first, sent, label = read_end(packet, BEGINNING)
        window = self.window
        if (
            first != sequence
            or first != window.highest + 1
            or label[0] != self.kind
            or not now - self.max_age <= sent <= now + TOLERANCE_NS
            or not self.since <= now <= self.until
            or self.keyring.version != self.keys
            or self.home.version != self.beliefs
        ):
            return None
        header = packet[:HEADER]
        whole = packet if len(packet) <= _SMALL else memoryview(packet)
        try:
            body = self.cipher.decrypt(nonce(BODY, header), whole[HEADER:-SESSION_ID], header)
        except InvalidTag:
            return None
        window.highest = first
        if sent > window.sent:
            window.sent = sent
        return body, sent
