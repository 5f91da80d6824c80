"""The sender's side of sealing."""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Sequence

from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from tutelage.errors import ConfigError
from tutelage.sgc.chain import ANCHOR_SECONDS, Link
from tutelage.sgc.errors import KeysError, NotAllowed
from tutelage.sgc.grants import key_id
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.packet import (
    ANCHOR,
    BARE,
    BARE_BODY,
    BARE_PROOF,
    BATCH,
    BODY,
    CHAIN,
    HEADER,
    INTRODUCTION,
    MAX_PAYLOAD,
    MAX_SESSIONS,
    MODES,
    NO_LABEL,
    PROOF,
    SALT_BYTES,
    SESSION,
    SESSION_ID,
    SIGNATURE,
    SLOT,
    SOLE,
    TAG,
    VERSION,
    Buffer,
    Packet,
    Statements,
    join_batch,
    make_header,
    message_key,
    nonce,
)
from tutelage.sgc.reasons import Reason, Refusals, Refused
from tutelage.sgc.rules import Lane
from tutelage.sgc.session import REPLACEMENT, Handshake, Session, tags

log = logging.getLogger(__name__)

_SIGNATURE = 64
_SMALL = 16_384  # bytes up to which copying is cheaper than writing in place
_LOOK_EVERY = 250_000_000  # nanoseconds between looks at keys, certificate and policy


class Sealer:
    """Seals the messages of one node on one topic and lane. One for each start of a program: it draws a salt.

    Safe to use from several threads; messages are numbered in the order in which `seal` was entered.

    Attributes:
        alias, lane: what it seals for.
        salt: 16 random bytes, new with each `Sealer`.
        sequence: of the last message sealed; 0 before the first.
        anchor_every: seconds, chain mode: how often to call `flush`.
        refusals: offers of sessions that were not accepted, by reason.
    """

    def __init__(
        self,
        keyring: Keyring,
        alias: str,
        lane: Lane = Lane.STREAM,
        *,
        introduce_every: float = 1.0,
        anchor_every: float = ANCHOR_SECONDS,
    ) -> None:
        """
        Args:
            keyring: of the node that sends.
            alias: of the topic.
            lane: which way.
            introduce_every: seconds after which a message carries the sender's credential again (about 1000 bytes).
            anchor_every: chain mode: seconds after which messages are confirmed at the latest, if `flush` is called.

        Raises:
            NotAllowed: the policy does not let this node send there.
        """
        self.alias, self.lane, self.anchor_every = alias, lane, anchor_every
        self.salt = secrets.token_bytes(SALT_BYTES)
        self.sequence = 0
        self.refusals = Refusals()
        self._keyring, self._home = keyring, keyring.home
        self._lock = threading.Lock()
        self._introduce_every = round(introduce_every * 1e9)
        self._introduce_at = 0
        self._link = Link(anchor_every)
        self._sessions: list[Session] = []
        self._epoch = 0
        self._looked = self._look_at = 0
        self._versions = (-1, -1)
        self._entry = self._home.access.check(alias, lane, sends=True)
        self._authenticity = self._entry.rule.authenticity_on(lane)
        self._mode = MODES[self._authenticity]
        self._name = bytes(self._entry.name)
        self._statements = Statements(self._name, lane)
        self._sender = key_id(self._entry.secret, b"sender", self._home.signing_key.public_key())
        self._handshake = Handshake(self._home, self._entry, lane)
        self._cipher: AESGCM | None = None
        self._key = b""
        self._sole: AESGCM | None = None  # while there is one session only

    def seal(self, payload: Buffer, *, label: bytes = NO_LABEL, bind: bytes = b"", now: int | None = None) -> Packet:
        """One message as one packet.

        payload: up to `MAX_PAYLOAD` bytes.
        label: 16 bytes that travel with it in clear, and that nobody can change.
        bind: further bytes that the receiver must name too; not sent. A reply binds to its request's `Opened.ident`.
        now: nanoseconds since 1970; default: the clock.

        Raises:
            NoKey: no valid key; the message names the owner to ask.
            NotIssued: this node's own certificate has expired, or was revoked.
            NotAllowed: the policy has changed.
            ConfigError: the payload is too long.
        """
        with self._lock:
            now = time.time_ns() if now is None else now
            sole = self._sole
            if (
                sole is not None
                and type(payload) is bytes
                and len(payload) <= _SMALL
                and not bind
                and self._looked <= now < self._look_at
                and self._versions == (self._keyring.version, self._home.version)
            ):  # in one step, as it is opened in one (`tutelage.sgc.due`)
                self.sequence = first = self.sequence + 1
                header = make_header(
                    VERSION, SESSION, SOLE, 0, SESSION_ID, self._epoch, self._sender, self.salt, first, now, label
                )
                return b"".join((header, sole.encrypt(nonce(BODY, header), payload, header), self._sessions[0].ident))
            return self._seal(_flat(payload) if isinstance(payload, memoryview) else payload, 0, 1, label, bind, now)

    def seal_many(self, payloads: Sequence[Buffer], *, label: bytes = NO_LABEL, now: int | None = None) -> Packet:
        """Many small messages as one packet with one proof. `Opener.open_many` gives them back one by one.

        label: of all of them.

        Raises:
            As `seal`.
        """
        parts = [_flat(each) if isinstance(each, memoryview) else each for each in payloads]  # the caller's list may change
        body = join_batch(parts)
        with self._lock:
            return self._seal(body, BATCH, len(parts), label, b"", time.time_ns() if now is None else now)

    def introduce(self) -> None:
        """Let the next packet carry this node's credential, as a receiver said that it does not know us."""
        self._introduce_at = 0

    def flush(self, *, now: int | None = None) -> Packet | None:
        """Chain mode: a packet that confirms messages not yet confirmed; None if there are none. To be called every
        `anchor_every` seconds; other modes never need it."""
        with self._lock:
            if not self._link.pending:
                return None
            now = time.time_ns() if now is None else now
            cipher = self._look(now)
            length = self._link.proof_bytes(with_message=False) + TAG
            header = make_header(
                VERSION, CHAIN, ANCHOR | BARE, 0, length, self._epoch, self._sender, self.salt, self.sequence, now, NO_LABEL
            )
            anchor = self._link.anchor(self._sender, self.salt, self._statements, self._home.signing_key)
            body = cipher.encrypt(nonce(BARE_BODY, header), b"", header)
            return header + body + cipher.encrypt(nonce(BARE_PROOF, header), anchor, header)

    def accept_session(self, offer: bytes) -> bytes:
        """Session mode: answer a receiver's `Opener.offer_session`. From now on packets carry a tag for it.

        At most 16 sessions are open; a new one of a node replaces its oldest beyond two, then the oldest of all.

        Raises:
            Refused: not from a node that may receive; see the reason. Counted.
            NotAllowed: the topic's authenticity is not "session".
        """
        if self._mode != SESSION:
            raise NotAllowed(f'{self.alias} has authenticity "{self._authenticity}" in the policy, so it has no sessions')
        with self._lock:
            with self.refusals.counting():
                answer, session = self._handshake.answer(offer, self._sender, self.salt)
            same = [one for one in self._sessions if one.member.pseudonym == session.member.pseudonym]
            kept = [one for one in self._sessions if one not in same[:-1]]
            self._open([*kept, session][-MAX_SESSIONS:])
            return answer

    def end_session(self, replacement: bytes) -> None:
        """Session mode: a receiver has renewed its session, and needs the earlier one no more.

        replacement: from its `Opener.replacements`; one that names no session of ours is for another sender.

        Raises:
            Refused: not from the other end of the session that it names. Counted.
        """
        with self._lock, self.refusals.counting():
            if len(replacement) != REPLACEMENT:
                raise Refused(Reason.MALFORMED, f"a replacement of {len(replacement)} bytes")
            for session in self._sessions:
                if session.ident == replacement[:SESSION_ID]:
                    old, who = session.replaces(replacement), session.member.pseudonym
                    others = [one for one in self._sessions if one.ident != old or one.member.pseudonym != who]
                    self._open(others if session in others else self._sessions)

    def receivers(self) -> list[str]:
        """Session mode: names of the nodes with a session."""
        return sorted({session.member.node for session in self._sessions})

    def _seal(self, body: Buffer, flags: int, count: int, label: bytes, bind: bytes, now: int) -> Packet:
        """Whoever calls holds the lock."""
        if len(body) > MAX_PAYLOAD + 4 * (count + 1):
            raise ConfigError(f"a message of {len(body)} bytes for {self.alias}; {MAX_PAYLOAD} fit: split or compress it")
        cipher, sole = self._look(now), self._sole
        first = self.sequence + 1
        self.sequence += count
        introduction, introduced = b"", 0
        if sole is not None:
            cipher, flags, proof = sole, flags | SOLE, SESSION_ID
        elif self._mode == SESSION:
            proof = SLOT * len(self._sessions)
        else:
            if not 0 < self._introduce_at - now <= self._introduce_every:
                introduction = self._home.credential
                introduced = len(introduction) + TAG
                self._introduce_at = now + self._introduce_every
            if self._mode == CHAIN and self._link.due(now):
                flags |= ANCHOR
            proof = self._proof_bytes(flags)
        header = make_header(
            VERSION, self._mode, flags, introduced, proof, self._epoch, self._sender, self.salt, first, now, label
        )
        if not introduced and len(body) <= _SMALL:
            sealed = header + cipher.encrypt(nonce(BODY, header), body, header + bind if bind else header)
            return sealed + self._proof(cipher, header, bind, body, flags, first, sealed, now)
        # Written in place, at its full length from the beginning: every copy of a large message counts.
        start = HEADER + introduced
        end = start + len(body) + TAG
        packet = bytearray(end + proof)
        with memoryview(packet) as view:
            view[:HEADER] = header
            if introduction:
                cipher.encrypt_into(nonce(INTRODUCTION, header), introduction, header, view[HEADER:start])
            cipher.encrypt_into(nonce(BODY, header), body, header + bind, view[start:end])
            view[end:] = self._proof(cipher, header, bind, body, flags, first, view[:end], now)
        return packet

    def _proof_bytes(self, flags: int) -> int:
        if self._mode == SIGNATURE:
            return _SIGNATURE + TAG
        return self._link.proof_bytes(with_message=True) + TAG if flags & ANCHOR else 0

    def _proof(
        self, cipher: AESGCM, header: bytes, bind: bytes, body: Buffer, flags: int, first: int, sealed: Buffer, now: int
    ) -> bytes:
        if self._mode == SESSION:
            return self._sessions[0].ident if flags & SOLE else tags(self._sessions, header, sealed, bind)
        statement = self._statements.message(header, bind, body)
        key = self._home.signing_key
        # A signature is sealed too: in clear, anyone who knows a node's certificate could tell which packets are its own.
        if self._mode == SIGNATURE:
            return cipher.encrypt(nonce(PROOF, header), key.sign(statement), header)
        self._link.add(first, statement, now)
        if not flags & ANCHOR:
            return b""
        anchor = self._link.anchor(self._sender, self.salt, self._statements, key)
        return cipher.encrypt(nonce(PROOF, header), anchor, header)

    def _look(self, now: int) -> AESGCM:
        """The cipher to use now. Looks from time to time, and at every change, whether this node may still send."""
        versions = (self._keyring.version, self._home.version)
        if self._cipher is not None and self._looked <= now < self._look_at and versions == self._versions:
            return self._cipher
        seconds = now / 1e9
        try:
            self._home.refresh()
        except KeysError as error:  # what was believed before stays in force, and nothing is lost
            log.warning("%s", error)
        self._home.check(seconds)
        self._entry = self._home.access.check(self.alias, self.lane, sends=True)
        if self._entry.name != self._name or self._entry.rule.authenticity_on(self.lane) != self._authenticity:
            raise NotAllowed(f"the policy changed the metadata or authenticity of {self.alias}; open it again")
        epoch = self._keyring.sealing(self.alias, seconds)
        if epoch.number != self._epoch or self._cipher is None:
            self._key = message_key(epoch.key, self._name, self.lane, epoch.number, self._sender, self.salt)
            self._cipher, self._epoch, self._sole = AESGCM(self._key), epoch.number, None
        alive = [session for session in self._sessions if self._alive(session, now)]
        if alive != self._sessions or self._sole is None:
            self._open(alive)
        self._versions, self._looked, self._look_at = versions, now, now + _LOOK_EVERY
        return self._cipher

    def _open(self, sessions: list[Session]) -> None:
        """These are open from now on."""
        self._sessions = sessions
        self._sole = sessions[0].sole(self._key) if len(sessions) == 1 and self._key else None

    def _alive(self, session: Session, now: int) -> bool:
        try:
            self._home.trust.check(session.member, now / 1e9)
        except Refused:
            return False
        return now < session.until and self._entry.rule.may_receive(session.member.node, self.lane)


def _flat(payload: memoryview) -> memoryview:
    """As bytes one after the other."""
    try:
        return payload.cast("B")
    except TypeError:
        raise ConfigError("a message must lie in one piece of memory; use bytes(...)") from None
