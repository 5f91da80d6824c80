"""Sessions: a key that only one sender and one receiver have, so that the other members of a topic cannot forge.

The receiver offers, the sender answers: ephemeral X25519 both ways, signed by both nodes' own keys (SIGMA), hidden from
carriers. From then on, packets carry for each session 16 bytes that only its two ends can make: AES-256-GCM's tag over
header and ciphertext. Unlike a signature it convinces nobody else, and it costs a microsecond. While there is only one
session, as in teleoperation, packets are sealed for it alone: then the ciphertext's own tag is the proof, and the message
passes through AES once instead of twice.
"""

from __future__ import annotations

import hashlib
import secrets
import time
from collections import OrderedDict
from dataclasses import dataclass, field

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from tutelage.sgc.access import Entry
from tutelage.sgc.envelope import Curtain, derive
from tutelage.sgc.grants import MAX_CONTROL, NONCE_BYTES, key_id
from tutelage.sgc.home import Home
from tutelage.sgc.packet import BOUND_TAG, MAX_SESSIONS, REPLACED, SESSION_ID, SESSION_TAG, TAG, Buffer, nonce
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Lane, Role
from tutelage.sgc.signed import sign, verified
from tutelage.sgc.trust import Member
from tutelage.sgc.wire import pack, unpack

OFFER = b"tutelage session offer 1"
ANSWER = b"tutelage session answer 1"
REPLACEMENT = 2 * SESSION_ID + TAG
"""Bytes of a replacement: the id of the new session, of the one that it replaces, and a tag. No offer is so short."""
_OFFER_SECONDS = 60.0
_REMEMBERED = 256


@dataclass(frozen=True)
class Session:
    """One established session.

    Attributes:
        ident: 8 bytes, in clear beside its tags.
        member: the other end.
        until: nanoseconds since 1970, when the first of the two certificates expires.
        cipher: for tags.
        secret: 32 bytes, for packets that are sealed for this session alone.
    """

    ident: bytes
    member: Member
    until: int
    cipher: AESGCM
    secret: bytes = field(repr=False)

    def sole(self, key: bytes) -> AESGCM:
        """The cipher of packets for this session alone. It takes both secrets: the session's, which proves the sender, and
        the key of the sender's start under the topic's epoch, so that rotation counts here too.

        key: see `packet.message_key`.
        """
        return AESGCM(derive(self.secret + key, b"", pack(b"tutelage sole 1", self.ident)))

    def replacing(self, ident: bytes) -> bytes:
        """The receiver's last word on an earlier session of the same two ends: this one is open, that one not needed."""
        return self.ident + ident + self.cipher.encrypt(REPLACED + ident, b"", None)

    def replaces(self, replacement: bytes) -> bytes:
        """The id of the session that the other end says this one replaces.

        Raises:
            Refused: FORGED.
        """
        ident = replacement[SESSION_ID : 2 * SESSION_ID]
        try:
            self.cipher.decrypt(REPLACED + ident, replacement[2 * SESSION_ID :], None)
        except InvalidTag:
            raise Refused(Reason.FORGED, f"a replacement of a session that is not by {self.member.node}") from None
        return ident

    def check(self, header: bytes, sealed: Buffer, tag: Buffer, bind: bytes = b"") -> None:
        """Was the tag made by the other end? It is over header and ciphertext, which are both in `sealed`, and `bind`.

        Raises:
            Refused: FORGED.
        """
        try:
            once, about = _about(header, sealed, bind)
            self.cipher.decrypt(once, tag, about)
        except InvalidTag:
            raise Refused(Reason.FORGED, f"a tag that is not by {self.member.node}") from None


class Handshake:
    """Offers and answers of one node on one topic and lane. Not for several threads at once."""

    def __init__(self, home: Home, entry: Entry, lane: Lane) -> None:
        self._home, self._entry, self._lane = home, entry, lane
        self._offers = Curtain(entry.secret, OFFER + lane.encode())
        self._answers = Curtain(entry.secret, ANSWER + lane.encode())
        self._open: OrderedDict[bytes, tuple[X25519PrivateKey, float]] = OrderedDict()
        self._seen: OrderedDict[bytes, None] = OrderedDict()

    def offer(self) -> bytes:
        """The receiver's first word. Good for a minute, and for any number of senders."""
        ephemeral, now = X25519PrivateKey.generate(), time.time_ns()
        body = pack(
            self._entry.name,
            secrets.token_bytes(NONCE_BYTES),
            now.to_bytes(8, "big"),
            ephemeral.public_key().public_bytes_raw(),
        )
        offer = self._offers.hide(pack(self._home.credential, sign(OFFER, body, self._home.signing_key)))
        self._open[hashlib.sha256(offer).digest()] = ephemeral, now / 1e9
        while len(self._open) > MAX_SESSIONS:
            self._open.popitem(last=False)
        return offer

    def answer(self, offer: bytes, sender: bytes, salt: bytes) -> tuple[bytes, Session]:
        """The sender's answer, and the session.

        sender, salt: as in the header of the packets to come.

        Raises:
            Refused: not from a node that may receive; see the reason.
        """
        member, body = self._read(OFFER, self._offers, offer)
        name, once, sent, public = unpack(body, 4)
        now = time.time()
        if name != self._entry.name or len(sent) != 8 or len(public) != 32:
            raise Refused(Reason.MALFORMED, f"an offer of {member.node} for another topic")
        if not self._entry.rule.may_receive(member.node, self._lane):
            raise Refused(Reason.NOT_ALLOWED, f"{member.node} may not receive {self._entry.rule.alias}")
        if abs(now - int.from_bytes(sent, "big") / 1e9) > _OFFER_SECONDS:
            raise Refused(Reason.TOO_OLD, f"an offer of {member.node} from another time; check both clocks")
        if once in self._seen:
            raise Refused(Reason.REPLAYED, f"an offer of {member.node} that was answered before")
        self._seen[once] = None
        while len(self._seen) > _REMEMBERED:
            self._seen.popitem(last=False)
        ephemeral = X25519PrivateKey.generate()
        ours = ephemeral.public_key().public_bytes_raw()
        body = pack(name, hashlib.sha256(offer).digest(), ours, sender, salt)
        session = self._session(ephemeral, public, body, member)
        answer = self._answers.hide(pack(self._home.credential, sign(ANSWER, body, self._home.signing_key)))
        return answer, session

    def complete(self, answer: bytes) -> tuple[bytes, bytes, Session]:
        """What the receiver makes of an answer: sender, salt, and the session.

        Raises:
            Refused: no answer to an open offer of ours, or not from a node that may send.
        """
        member, body = self._read(ANSWER, self._answers, answer)
        name, offered, public, sender, salt = unpack(body, 5)
        if name != self._entry.name or len(public) != 32 or len(salt) != 16:
            raise Refused(Reason.MALFORMED, f"an answer of {member.node} for another topic")
        if not self._entry.rule.may_send(member.node, self._lane):
            raise Refused(Reason.NOT_ALLOWED, f"{member.node} may not send {self._entry.rule.alias}")
        if sender != key_id(self._entry.secret, b"sender", member.signing):
            raise Refused(Reason.FORGED, f"an answer of {member.node} in the name of another")
        ephemeral, made = self._open.get(offered, (None, 0.0))
        if ephemeral is None or time.time() - made > _OFFER_SECONDS:
            raise Refused(Reason.REPLAYED, f"an answer of {member.node} to no open offer of ours")
        return sender, salt, self._session(ephemeral, public, body, member)

    def _read(self, context: bytes, curtain: Curtain, message: bytes) -> tuple[Member, bytes]:
        if len(message) > MAX_CONTROL:
            raise Refused(Reason.OVERSIZE, f"a handshake of {len(message)} bytes")
        credential, statement = unpack(curtain.lift(bytes(message)), 2)
        member = self._home.trust.verify(credential)
        if member.role != Role.NODE:
            raise Refused(Reason.NOT_ALLOWED, f"{member.node} is a router, and has no part in any topic")
        return member, verified(context, statement, member.signing)

    def _session(self, ours: X25519PrivateKey, theirs: bytes, body: bytes, member: Member) -> Session:
        """Both ends sign the transcript: the answer names the offer by its digest, and the key is bound to the answer."""
        try:
            shared = ours.exchange(X25519PublicKey.from_public_bytes(theirs))
        except ValueError:
            raise Refused(Reason.MALFORMED, f"an impossible key of {member.node}") from None
        material = derive(shared, hashlib.sha256(body).digest(), pack(b"tutelage session 2", self._lane.encode()), 72)
        until = round(1e9 * min(member.not_after, self._home.member.not_after))
        return Session(material[64:], member, until, AESGCM(material[:32]), material[32:64])


def tags(sessions: list[Session], header: bytes, sealed: Buffer, bind: bytes = b"") -> bytes:
    """The proof of a packet: id and tag of every session, made over header and ciphertext, which are both in `sealed`, and
    what the packet is bound to."""
    once, about = _about(header, sealed, bind)
    return b"".join([session.ident + session.cipher.encrypt(once, b"", about) for session in sessions])


def _about(header: bytes, sealed: Buffer, bind: bytes) -> tuple[bytes, Buffer]:
    """Nonce, and what is tagged. `bind` is part of it, although it is under the tag of the ciphertext already: who knows the
    topic's key, as all members do, finds another one with the same tag there."""
    if not bind:
        return nonce(SESSION_TAG, header), sealed
    return nonce(BOUND_TAG, header), b"".join((sealed, bind, len(bind).to_bytes(4, "big")))
