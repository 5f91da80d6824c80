"""The receiver's side of sealing."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict

from cryptography.exceptions import InvalidSignature, InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from tutelage.sgc.chain import Confirmation
from tutelage.sgc.errors import NotAllowed
from tutelage.sgc.grants import key_id
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.packet import (
    ANCHOR,
    BARE,
    BARE_BODY,
    BARE_PROOF,
    BATCH,
    BODY,
    HEADER,
    INTRODUCTION,
    MODES,
    PROOF,
    Buffer,
    Header,
    Opened,
    Statements,
    message_key,
    nonce,
    read_header,
    split_batch,
)
from tutelage.sgc.reasons import Reason, Refusals, Refused
from tutelage.sgc.replay import MAX_SENDERS, Replay
from tutelage.sgc.rules import Authenticity, Lane, Role
from tutelage.sgc.session import Handshake, Session, slots
from tutelage.sgc.trust import Member

_LOOK_EVERY = 250_000_000  # nanoseconds between looks at keys and policy
_MAX_CIPHERS = 1024
_MAX_SESSIONS = 1024


class Opener:
    """Opens what others sent on one topic and lane. Raises only `Refused`, whatever the bytes. Safe to use from several
    threads.

    Attributes:
        alias, lane: what it opens.
        refusals: counts of refusals by reason; chain mode also counts there what is refused after `open_many` returned.
    """

    def __init__(self, keyring: Keyring, alias: str, lane: Lane = Lane.STREAM, *, provisional: bool = False) -> None:
        """
        Args:
            keyring: of the node that receives.
            alias: of the topic.
            lane: which way.
            provisional: chain mode: give messages before they are confirmed, as `authentic=False`. Default: hold them
                until the sender's next anchor confirms them.

        Raises:
            NotAllowed: the policy does not let this node receive there.
        """
        self.alias, self.lane = alias, lane
        self.refusals = Refusals()
        self._keyring, self._home = keyring, keyring.home
        self._entry = self._home.access.check(alias, lane, sends=False)
        self._authenticity = self._entry.rule.authenticity_on(lane)
        self._mode = MODES[self._authenticity]
        self._name = bytes(self._entry.name)
        self._provisional = provisional
        self._statements = Statements(self._name, lane)
        self._replay = Replay(self._entry.rule.max_age, time.time_ns())
        self._confirmation = Confirmation(self._statements, self.refusals, provisional=provisional)
        self._handshake = Handshake(self._home, self._entry, lane)
        self._lock = threading.RLock()
        self._looked = 0
        self._versions = (-1, -1)
        self._epochs: dict[int, bytes] = {}
        self._ciphers: OrderedDict[tuple[int, bytes, bytes], AESGCM] = OrderedDict()
        self._members: OrderedDict[bytes, Member] = OrderedDict()
        self._sessions: OrderedDict[tuple[bytes, bytes, bytes], Session] = OrderedDict()

    def open(self, packet: Buffer, *, bind: bytes = b"", now: int | None = None) -> Opened:
        """The one message of a packet.

        bind: what the sender bound the message to.
        now: nanoseconds since 1970; default: the clock.

        Raises:
            Refused: see `Reason`. Also if there is not exactly one message: use `open_many`.
        """
        messages = self.open_many(packet, bind=bind, now=now)
        if len(messages) != 1:
            self.refusals.add(Reason.MALFORMED)
            raise Refused(Reason.MALFORMED, f"a packet of {self.alias} with {len(messages)} messages instead of one")
        return messages[0]

    def open_many(self, packet: Buffer, *, bind: bytes = b"", now: int | None = None) -> list[Opened]:
        """All messages that a packet holds or confirms, in order: one for a plain packet, n for a batch, 0 or more in
        chain mode.

        Raises:
            Refused: see `Reason`. Counted.
        """
        try:
            return self._open(memoryview(packet), bind, time.time_ns() if now is None else now)
        except Refused as refused:
            self.refusals.add(refused.reason)
            raise
        except NotAllowed as error:  # the policy has changed
            self.refusals.add(Reason.NOT_ALLOWED)
            raise Refused(Reason.NOT_ALLOWED, str(error)) from None

    def offer_session(self) -> bytes:
        """Session mode: a handshake packet for the sender's `Sealer.accept_session`; good for a minute."""
        with self._lock:
            return self._handshake.offer()

    def complete_session(self, answer: bytes) -> str:
        """Session mode: take the sender's answer. Returns the name of the sender.

        Raises:
            Refused: no answer to an offer of ours, or not from a node that may send. Counted.
        """
        with self._lock:
            try:
                sender, salt, session = self._handshake.complete(answer)
            except Refused as refused:
                self.refusals.add(refused.reason)
                raise
            self._sessions[sender, salt, session.ident] = session
            while len(self._sessions) > _MAX_SESSIONS:
                self._sessions.popitem(last=False)
            return session.member.node

    def _open(self, packet: memoryview, bind: bytes, now: int) -> list[Opened]:
        header = read_header(packet, self._mode)
        bare = bool(header.flags & BARE)
        if not bare:
            self._replay.check(header.sender, header.salt, header.first, 1, header.sent, now)  # cheap, so first
        cipher = self._cipher(header, now)
        raw = bytes(packet[:HEADER])
        start, end = HEADER + header.introduction, len(packet) - header.proof
        if bare:
            _decrypt(cipher, BARE_BODY, header, packet[start:end], raw)
            member = self._member(cipher, header, raw, packet[HEADER:start], now)
            return self._anchor(cipher, BARE_PROOF, header, raw, packet[end:], member, now)
        body = _decrypt(cipher, BODY, header, packet[start:end], raw + bind)
        if self._authenticity == Authenticity.SESSION:
            member = self._session_member(header, packet, end, now)
        else:
            member = self._member(cipher, header, raw, packet[HEADER:start], now)
        payloads = [bytes(part) for part in split_batch(body)] if header.flags & BATCH else [body]
        messages = self._messages(header, raw, member, payloads)
        if self._authenticity == Authenticity.CHAIN:
            return self._chained(cipher, header, raw, bind, body, packet[end:], member, messages, now)
        if self._authenticity == Authenticity.SIGNATURE:
            signature = _decrypt(cipher, PROOF, header, packet[end:], raw)
            try:
                member.signing.verify(signature, self._statements.message(raw, bind, body))
            except InvalidSignature:
                raise Refused(Reason.FORGED, f"a message of {self.alias} that {member.node} did not sign") from None
        self._replay.admit(header.sender, header.salt, header.first, len(messages), header.sent, now)
        self._remember(header, cipher, member)
        return messages

    def _chained(
        self,
        cipher: AESGCM,
        header: Header,
        raw: bytes,
        bind: bytes,
        body: bytes,
        proof: memoryview,
        member: Member,
        messages: list[Opened],
        now: int,
    ) -> list[Opened]:
        stream, statement = (header.sender, header.salt), self._statements.message(raw, bind, body)
        with self._lock:
            ready = self._confirmation.message(stream, header.first, statement, messages, len(body), now)
        if ready is not None:
            self._replay.admit(header.sender, header.salt, header.first, len(ready), header.sent, now)
        self._remember(header, cipher, member)
        if header.flags & ANCHOR:
            return (ready or []) + self._anchor(cipher, PROOF, header, raw, proof, member, now)
        return ready or []

    def _anchor(
        self, cipher: AESGCM, purpose: int, header: Header, raw: bytes, proof: memoryview, member: Member, now: int
    ) -> list[Opened]:
        anchor = _decrypt(cipher, purpose, header, proof, raw)

        def admit(first: int, messages: list[Opened]) -> None:
            self._replay.admit(header.sender, header.salt, first, len(messages), messages[0].sent, now)

        with self._lock:
            return self._confirmation.anchor((header.sender, header.salt), anchor, member.signing, admit)

    def _messages(self, header: Header, raw: bytes, member: Member, payloads: list[bytes]) -> list[Opened]:
        authentic = not (self._authenticity == Authenticity.CHAIN and self._provisional)
        found = []
        for sequence, payload in enumerate(payloads, header.first):
            ident = raw[12:44] + sequence.to_bytes(8, "big")
            found.append(Opened(payload, member.node, sequence, header.salt, header.sent, header.epoch, authentic, ident))
        return found

    def _cipher(self, header: Header, now: int) -> AESGCM:
        """The key of the packet's stream. Not remembered yet: anybody can make up a salt."""
        with self._lock:
            self._look(now)
            key = self._epochs.get(header.epoch)
            if key is None:
                key = self._epochs[header.epoch] = self._keyring.opening(self.alias, header.epoch, now / 1e9).key
            found = self._ciphers.get((header.epoch, header.sender, header.salt))
        if found is None:
            found = AESGCM(message_key(key, self._name, self.lane, header.epoch, header.sender, header.salt))
        return found

    def _remember(self, header: Header, cipher: AESGCM, member: Member) -> None:
        """Keep what an authentic packet taught."""
        key = header.epoch, header.sender, header.salt
        with self._lock:
            if self._ciphers.get(key) is not cipher:
                self._ciphers[key] = cipher
                while len(self._ciphers) > _MAX_CIPHERS:
                    self._ciphers.popitem(last=False)
            if self._authenticity != Authenticity.SESSION and self._members.get(header.sender) is not member:
                self._members[header.sender] = member
                while len(self._members) > MAX_SENDERS:
                    self._members.popitem(last=False)

    def _member(self, cipher: AESGCM, header: Header, raw: bytes, introduction: memoryview, now: int) -> Member:
        """Who the sender is, from its introduction or an earlier one; it may send, now."""
        if header.introduction:
            credential = _decrypt(cipher, INTRODUCTION, header, introduction, raw)
            member = self._home.trust.read(credential)
            if self._id_of(member) != header.sender:
                raise Refused(Reason.FORGED, f"a packet of {self.alias} with the credential of another, {member.node}")
        else:
            found = self._members.get(header.sender) or self._from_keyring(header.sender)
            if found is None:
                raise Refused(Reason.UNKNOWN_SENDER, f"a packet of {self.alias} by a sender that is not introduced yet")
            member = found
        self._check(member, now)
        return member

    def _session_member(self, header: Header, packet: memoryview, end: int, now: int) -> Member:
        for ident, tag in slots(packet[end:]).items():
            session = self._sessions.get((header.sender, header.salt, ident))
            if session is not None and now / 1e9 < session.until:
                session.check(header.first, packet[:end], tag)
                self._check(session.member, now)
                return session.member
        raise Refused(Reason.NO_SESSION, f"a packet of {self.alias} by a sender with whom no session is open")

    def _check(self, member: Member, now: int) -> None:
        self._home.trust.check(member, now / 1e9)
        if member.role != Role.NODE or not self._entry.rule.may_send(member.node, self.lane):
            raise Refused(Reason.NOT_ALLOWED, f"{member.node} may not send {self.alias}; if it should, add it to the policy")

    def _from_keyring(self, sender: bytes) -> Member | None:
        return next((member for member in self._keyring.known(self.alias) if self._id_of(member) == sender), None)

    def _id_of(self, member: Member) -> bytes:
        return key_id(self._entry.secret, b"sender", member.signing)

    def _look(self, now: int) -> None:
        """From time to time, and at every change: which epochs are accepted, and may this node still receive?"""
        versions = (self._keyring.version, self._home.version)
        if versions == self._versions and 0 <= now - self._looked < _LOOK_EVERY:
            return
        self._epochs.clear()
        if versions[1] != self._versions[1]:
            self._entry = self._home.access.check(self.alias, self.lane, sends=False)
            if self._entry.name != self._name or self._entry.rule.authenticity_on(self.lane) != self._authenticity:
                raise NotAllowed(f"the policy changed the metadata or authenticity of {self.alias}; open it again")
        self._versions, self._looked = versions, now


def _decrypt(cipher: AESGCM, purpose: int, header: Header, sealed: memoryview, associated: bytes) -> bytes:
    try:
        return cipher.decrypt(nonce(purpose, header.first), sealed, associated)
    except InvalidTag:
        raise Refused(Reason.TAMPERED, "a packet that was changed on its way, or not made with the topic's key") from None
