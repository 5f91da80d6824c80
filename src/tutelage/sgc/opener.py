"""The receiver's side of sealing."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict

from cryptography.exceptions import InvalidSignature, InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from tutelage.sgc.chain import Confirmation
from tutelage.sgc.due import Due
from tutelage.sgc.errors import NotAllowed
from tutelage.sgc.grants import key_id
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.packet import (
    ANCHOR,
    BARE,
    BARE_BODY,
    BARE_PROOF,
    BATCH,
    BEGINNING,
    BODY,
    CHAIN,
    HEADER,
    INTRODUCTION,
    MAX_PACKET,
    MAX_SESSIONS,
    MODES,
    PROOF,
    SESSION,
    SESSION_ID,
    SIGNATURE,
    SLOT,
    SOLE,
    TAG,
    Buffer,
    Layout,
    Opened,
    Statements,
    make_opened,
    message_key,
    nonce,
    read_header,
    read_layout,
    read_stream,
    split_batch,
)
from tutelage.sgc.reasons import Reason, Refusals, Refused
from tutelage.sgc.replay import MAX_SENDERS, Replay, Window
from tutelage.sgc.rules import Lane, Role
from tutelage.sgc.session import Handshake, Session
from tutelage.sgc.trust import Member

_LOOK_EVERY = 250_000_000  # nanoseconds between looks at keys and policy
_NEVER = -1
_SMALL = 4096  # bytes of a packet up to which copies of its parts cost less than views of them
_MAX_STREAMS = 1024
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
        self._authentic = self._mode != CHAIN or not provisional  # are messages when `_open` gives them
        self._statements = Statements(self._name, lane)
        self._replay = Replay(self._entry.rule.max_age, time.time_ns())
        self._confirmation = Confirmation(self._statements, self.refusals, provisional=provisional)
        self._handshake = Handshake(self._home, self._entry, lane)
        self._lock = threading.RLock()
        self._looked = self._look_at = 0
        self._versions = (-1, -1)
        self._look_count = 0
        self._layout: tuple[bytes, Layout] = b"", Layout(0, 0, 0)
        self._streams: OrderedDict[bytes, _Stream] = OrderedDict()
        self._members: OrderedDict[bytes, Member] = OrderedDict()
        self._sessions: OrderedDict[bytes, Session] = OrderedDict()  # by sender, salt and id
        self._replacements: list[bytes] = []
        self._last: tuple[bytes, int, _Stream, Window] | None = None

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
            return self._open(packet, bind, time.time_ns() if now is None else now)
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
            with self.refusals.counting():
                sender, salt, session = self._handshake.complete(answer)
            start = sender + salt
            if start + session.ident in self._sessions:  # the network may repeat an answer
                return session.member.node
            earlier = [one.ident for key, one in self._sessions.items() if key.startswith(start)]
            self._replacements = [*self._replacements, *map(session.replacing, earlier[-1:])][-MAX_SESSIONS:]
            self._sessions[start + session.ident] = session
            while len(self._sessions) > _MAX_SESSIONS:
                self._sessions.popitem(last=False)
            return session.member.node

    def replacements(self) -> list[bytes]:
        """Session mode: what is to be told to senders whose earlier sessions are replaced, each once, for their
        `Sealer.end_session`. Nothing is lost if it does not reach them; they go on sealing for both."""
        with self._lock:
            told, self._replacements = self._replacements, []
            return told

    def due(self) -> Due | None:
        """The packet that follows the one that was opened last. None: that one was refused, bound to something, or not one
        message for one session. Only for whoever is alone in using this opener."""
        if self._last is None or (sole := self._last[2].sole) is None:
            return None
        beginning, kind, stream, window = self._last
        (session, cipher), (keys, beliefs) = sole, self._versions
        return Due(
            beginning=beginning,
            kind=kind,
            ident=session.ident,
            cipher=cipher,
            window=window,
            sender=session.member.node,
            salt=stream.salt,
            keyring=self._keyring,
            keys=keys,
            home=self._home,
            beliefs=beliefs,
            since=self._looked,
            until=min(self._look_at, session.until - 1),
            max_age=self._replay.max_age,
        )

    def _open(self, packet: Buffer, bind: bytes, now: int) -> list[Opened]:
        self._last = None
        size = len(packet)
        if size > _SMALL or not isinstance(packet, bytes):
            packet = memoryview(packet)
        if size > MAX_PACKET:
            raise Refused(Reason.OVERSIZE, f"a packet of {size} bytes; {MAX_PACKET} are allowed")
        if size < HEADER + TAG:
            raise Refused(Reason.MALFORMED, f"a packet of {size} bytes")
        raw = bytes(packet[:HEADER])
        layout, name, first, sent, label = read_header(raw)
        known = self._layout
        if layout != known[0]:  # most packets begin alike
            known = self._layout = layout, read_layout(layout, self._mode)
        flags, introduction, proof = known[1]
        start, end = HEADER + introduction, size - proof
        if first == 0 or start + TAG > end:
            raise Refused(Reason.MALFORMED, "a packet with an impossible header")
        stream = self._streams.get(name) or _Stream(name)  # of a new one nothing is kept yet: anybody can make up a salt
        if not flags & BARE:
            self._replay.check(stream.sender, stream.salt, first, sent, now)  # cheap, so first; a wrong clock is told apart
        if not self._looked <= now <= self._look_at or self._versions != (self._keyring.version, self._home.version):
            self._look(now)
        if stream.look != self._look_count:
            self._look_at_stream(stream, introduction > 0, now)
        if flags & BARE:
            _decrypt(stream.cipher, BARE_BODY, packet[start:end], raw)
            member = self._member(stream, raw, packet[HEADER:start], now)
            return self._anchor(stream, BARE_PROOF, raw, packet[end:], member, now)
        about = raw + bind if bind else raw
        if flags & SOLE:
            sole = stream.sole
            if sole is None or sole[0].ident != packet[end:] or sole[0].member is not stream.member or now >= sole[0].until:
                sole = self._sole(stream, packet[end:], now)
            body, member = _decrypt(sole[1], BODY, packet[start:end], about), sole[0].member
        else:
            body = _decrypt(stream.cipher, BODY, packet[start:end], about)
            if self._mode == SESSION:
                member = self._session_member(stream, raw, packet, end, bind, now)
            else:
                member = self._member(stream, raw, packet[HEADER:start], now)
        node, epoch, salt, authentic, began = member.node, stream.epoch, stream.salt, self._authentic, stream.start
        if flags & BATCH:
            messages = [
                make_opened((part, node, sequence, salt, sent, epoch, authentic, began, label))
                for sequence, part in enumerate(split_batch(body), first)
            ]
        else:
            messages = [make_opened((body, node, first, salt, sent, epoch, authentic, began, label))]
        if self._mode == CHAIN:
            return self._chained(stream, flags, raw, bind, body, packet[end:], member, messages, now)
        if self._mode == SIGNATURE:
            signature = _decrypt(stream.cipher, PROOF, packet[end:], raw)
            try:
                member.signing.verify(signature, self._statements.message(raw, bind, body))
            except InvalidSignature:
                raise Refused(Reason.FORGED, f"a message of {self.alias} that {member.node} did not sign") from None
        window = self._replay.admit(stream.sender, salt, first, len(messages), sent, now)
        if stream.member is not member:
            self._remember(stream, member)
        if flags == SOLE and not bind:
            self._last = raw[:BEGINNING], label[0], stream, window
        return messages

    def _chained(
        self,
        stream: _Stream,
        flags: int,
        raw: bytes,
        bind: bytes,
        body: bytes,
        proof: Buffer,
        member: Member,
        messages: list[Opened],
        now: int,
    ) -> list[Opened]:
        statement, first = self._statements.message(raw, bind, body), messages[0].sequence
        with self._lock:
            ready = self._confirmation.message((stream.sender, stream.salt), first, statement, messages, len(body), now)
        if ready is not None:
            self._replay.admit(stream.sender, stream.salt, first, len(ready), messages[0].sent, now)
        if stream.member is not member:
            self._remember(stream, member)
        if flags & ANCHOR:
            return (ready or []) + self._anchor(stream, PROOF, raw, proof, member, now)
        return ready or []

    def _anchor(self, stream: _Stream, purpose: bytes, raw: bytes, proof: Buffer, member: Member, now: int) -> list[Opened]:
        anchor = _decrypt(stream.cipher, purpose, proof, raw)

        def admit(first: int, messages: list[Opened]) -> None:
            self._replay.admit(stream.sender, stream.salt, first, len(messages), messages[0].sent, now)

        with self._lock:
            return self._confirmation.anchor((stream.sender, stream.salt), anchor, member.signing, admit)

    def _look_at_stream(self, stream: _Stream, introduced: bool, now: int) -> None:
        """Is its epoch accepted, may its sender still send? To be asked after each look.

        A packet with a credential answers for itself alone, in `_member`: the credential may be newer than the one known, or
        that of somebody who was revoked. The next packet without one is looked at anew. In session mode the next packet's
        session says who the sender is: one that is renewed may have another certificate than the one known.
        """
        key = self._keyring.opening(self.alias, stream.epoch, now / 1e9).key
        if stream.look == _NEVER:
            stream.key = message_key(key, self._name, self.lane, stream.epoch, stream.sender, stream.salt)
            stream.cipher = AESGCM(stream.key)
        if introduced:
            return
        if self._mode == SESSION:
            stream.member = None
        elif stream.member is not None:
            self._check(stream.member, now)
        stream.look = self._look_count

    def _remember(self, stream: _Stream, member: Member) -> None:
        """Keep what an authentic packet taught."""
        with self._lock:
            stream.member = member
            self._streams[stream.name] = stream
            while len(self._streams) > _MAX_STREAMS:
                self._streams.popitem(last=False)
            if self._mode != SESSION:
                self._members[stream.sender] = member
                while len(self._members) > MAX_SENDERS:
                    self._members.popitem(last=False)

    def _member(self, stream: _Stream, raw: bytes, introduction: Buffer, now: int) -> Member:
        """Who the sender is, from its introduction or an earlier one; it may send, now."""
        if introduction:
            member = self._home.trust.read(_decrypt(stream.cipher, INTRODUCTION, introduction, raw))
            if self._id_of(member) != stream.sender:
                raise Refused(Reason.FORGED, f"a packet of {self.alias} with the credential of another, {member.node}")
        elif stream.member is not None:
            return stream.member  # `_look_at_stream` has checked it
        else:
            found = self._members.get(stream.sender) or self._from_keyring(stream.sender)
            if found is None:
                raise Refused(Reason.UNKNOWN_SENDER, f"a packet of {self.alias} by a sender that is not introduced yet")
            member = found
        self._check(member, now)
        return member

    def _session_member(self, stream: _Stream, raw: bytes, packet: Buffer, end: int, bind: bytes, now: int) -> Member:
        """Who the sender is, from the tag that it made for us."""
        for at in range(end, len(packet), SLOT):
            session = self._session(stream, packet[at : at + SESSION_ID], now)
            if session is not None:
                session.check(raw, packet[:end], packet[at + SESSION_ID : at + SLOT], bind)
                return session.member
        raise self._no_session()

    def _sole(self, stream: _Stream, ident: Buffer, now: int) -> tuple[Session, AESGCM]:
        """The session that a packet is sealed for alone, and the cipher; the stream keeps them."""
        session = self._session(stream, ident, now)
        if session is None:
            raise self._no_session()
        sole = stream.sole
        if sole is None or sole[0] is not session:
            sole = stream.sole = session, session.sole(stream.key)
        return sole

    def _session(self, stream: _Stream, ident: Buffer, now: int) -> Session | None:
        """The open session with this id, with a sender who may send, now."""
        session = self._sessions.get(stream.start + ident)
        if session is None or now >= session.until:
            return None
        if session.member is not stream.member:  # else `_look_at_stream` has checked it
            self._check(session.member, now)
        return session

    def _no_session(self) -> Refused:
        return Refused(Reason.NO_SESSION, f"a packet of {self.alias} by a sender with whom no session is open")

    def _check(self, member: Member, now: int) -> None:
        self._home.trust.check(member, now / 1e9)
        if member.role != Role.NODE or not self._entry.rule.may_send(member.node, self.lane):
            raise Refused(Reason.NOT_ALLOWED, f"{member.node} may not send {self.alias}; if it should, add it to the policy")

    def _from_keyring(self, sender: bytes) -> Member | None:
        return next((member for member in self._keyring.known(self.alias) if self._id_of(member) == sender), None)

    def _id_of(self, member: Member) -> bytes:
        return key_id(self._entry.secret, b"sender", member.signing)

    def _look(self, now: int) -> None:
        with self._lock:
            versions = (self._keyring.version, self._home.version)
            if versions[1] != self._versions[1]:
                self._entry = self._home.access.check(self.alias, self.lane, sends=False)
                if self._entry.name != self._name or self._entry.rule.authenticity_on(self.lane) != self._authenticity:
                    raise NotAllowed(f"the policy changed the metadata or authenticity of {self.alias}; open it again")
                self._replay.set_max_age(self._entry.rule.max_age)
            self._versions, self._looked, self._look_at = versions, now, now + _LOOK_EVERY
            self._look_count += 1


class _Stream:
    """One start of one sender under one epoch.

    Attributes:
        name: epoch, sender and salt, as in a header.
        start: sender and salt.
        key, cipher: of its packets; not there before the first look.
        look: when it was last checked, in looks.
        member: who it is; None before the first authentic packet.
        sole: the session that packets of the stream were last sealed for alone, and its cipher.
    """

    __slots__ = ("cipher", "epoch", "key", "look", "member", "name", "salt", "sender", "sole", "start")

    key: bytes
    cipher: AESGCM

    def __init__(self, name: bytes) -> None:
        self.name = name
        self.epoch, self.sender, self.salt = read_stream(name)
        self.start: bytes = self.sender + self.salt
        self.look = _NEVER
        self.member: Member | None = None
        self.sole: tuple[Session, AESGCM] | None = None


def _decrypt(cipher: AESGCM, purpose: bytes, sealed: Buffer, associated: bytes) -> bytes:
    try:
        return cipher.decrypt(nonce(purpose, associated), sealed, associated)
    except InvalidTag:
        raise Refused(Reason.TAMPERED, "a packet that was changed on its way, or not made with the topic's key") from None
