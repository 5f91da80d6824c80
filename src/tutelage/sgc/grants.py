"""How a topic's keys travel: a member's request, and the owner's grant. Carriers learn neither node, topic nor key.

    request = curtain(credential, signed(topic's name, nonce, X25519 key to answer to))
    grant   = recipient's key id (16) | curtain(owner's credential, signed(name, recipient, nonce, HPKE(epochs)))

The curtain is a key of all who know the topic's secret; the signatures say who speaks, HPKE who may read. The key to answer
to is made for one run of the member's program: whoever steals its folder later cannot read grants that were recorded.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Sequence
from dataclasses import dataclass

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey

from tutelage.sgc.access import Entry
from tutelage.sgc.certificates import raw
from tutelage.sgc.envelope import Curtain, open_sealed, seal_to, sealing_key
from tutelage.sgc.epochs import Epoch, read_epochs
from tutelage.sgc.home import Home
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Role
from tutelage.sgc.signed import sign, verified
from tutelage.sgc.trust import Member, Trust
from tutelage.sgc.wire import pack, unpack

ASK = b"tutelage key request 1"
GRANT = b"tutelage grant 1"
ID_BYTES = 16
NONCE_BYTES = 16
MAX_CONTROL = 65_536


def key_id(secret: bytes, purpose: bytes, key: Ed25519PublicKey) -> bytes:
    """A node's pseudonymous id within a topic: 16 bytes. Nobody without the topic's secret can link it to the node's key,
    or to its ids in other topics."""
    return hmac.digest(secret, pack(b"tutelage id 1", purpose, raw(key)), hashlib.sha256)[:ID_BYTES]


@dataclass(frozen=True)
class Asker:
    """A member that asked for a topic's key.

    Attributes:
        member: who.
        reply_to: grants are sealed to this.
    """

    member: Member
    reply_to: X25519PublicKey


class Exchange:
    """Makes and reads requests and grants of one topic. Holds no state."""

    def __init__(self, entry: Entry) -> None:
        self.entry = entry
        self._asks = Curtain(entry.secret, ASK)
        self._grants = Curtain(entry.secret, GRANT)

    def ask(self, home: Home, nonce: bytes, reply_to: X25519PublicKey) -> bytes:
        """A request by this node, to be answered under the key `reply_to`."""
        statement = sign(ASK, pack(self.entry.name, nonce, raw(reply_to)), home.signing_key)
        return self._asks.hide(pack(home.credential, statement))

    def read_ask(self, request: bytes, trust: Trust) -> tuple[Asker, bytes]:
        """Who asks, and the nonce of the request.

        Raises:
            Refused: see the reason; NOT_ALLOWED: no member of the topic.
        """
        _check_size(request)
        credential, statement = unpack(self._asks.lift(request), 2)
        member = trust.verify(credential)
        name, nonce, reply_to = unpack(verified(ASK, statement, member.signing), 3)
        if name != self.entry.name or len(nonce) != NONCE_BYTES or len(reply_to) != 32:
            raise Refused(Reason.MALFORMED, f"a request of {member.node} for the key of another topic")
        self.check_member(member)
        try:
            return Asker(member, sealing_key(reply_to)), nonce
        except ValueError:
            raise Refused(Reason.MALFORMED, f"a request of {member.node} with an impossible key") from None

    def check_member(self, member: Member) -> None:
        """May it hold the topic's key?

        Raises:
            Refused: NOT_ALLOWED.
        """
        rule = self.entry.rule
        if member.role != Role.NODE or not rule.is_member(member.node):
            raise Refused(
                Reason.NOT_ALLOWED, f"{member.node} has no part in {rule.alias}; if it should, add it to the policy"
            )

    def grant(self, home: Home, asker: Asker, epochs: Sequence[Epoch], nonce: bytes = b"") -> bytes:
        """The owner's grant to a member.

        nonce: of the request that this answers; empty if it answers none.
        """
        recipient = self.recipient(asker.member.signing)
        sealed = seal_to(asker.reply_to, GRANT + self.entry.name, b"".join(epoch.pack() for epoch in epochs))
        statement = sign(GRANT, pack(self.entry.name, recipient, nonce, sealed), home.signing_key)
        return self._grants.hide(pack(home.credential, statement), header=recipient)

    def read_grant(
        self, grant: bytes, signing: Ed25519PublicKey, reply_to: X25519PrivateKey, trust: Trust, now: float
    ) -> tuple[Member, list[Epoch], bytes]:
        """The owner that granted, the keys in a grant to us, and the nonce that it answers.

        signing: our key. reply_to: that of the request.

        Raises:
            Refused: NOT_FOR_US, NOT_ALLOWED (not from the owner), FORGED, ...
        """
        _check_size(grant)
        recipient = self.recipient(signing)
        if grant[:ID_BYTES] != recipient:
            raise Refused(Reason.NOT_FOR_US, f"a grant of {self.entry.rule.alias} to another node")
        credential, statement = unpack(self._grants.lift(grant, ID_BYTES), 2)
        owner = trust.verify(credential)
        if owner.node != self.entry.rule.owner or owner.role != Role.NODE:
            raise Refused(
                Reason.NOT_ALLOWED,
                f"{owner.node} grants keys of {self.entry.rule.alias}, whose owner is {self.entry.rule.owner}",
            )
        name, to, nonce, sealed = unpack(verified(GRANT, statement, owner.signing), 4)
        if name != self.entry.name or to != recipient:
            raise Refused(Reason.NOT_FOR_US, f"a grant of {owner.node} for another topic or node")
        return owner, read_epochs(open_sealed(reply_to, GRANT + self.entry.name, sealed), now), nonce

    def recipient(self, key: Ed25519PublicKey) -> bytes:
        """Id of a member as the receiver of grants."""
        return key_id(self.entry.secret, b"recipient", key)


def _check_size(message: bytes) -> None:
    if len(message) > MAX_CONTROL:
        raise Refused(Reason.OVERSIZE, f"a control message of {len(message)} bytes")
