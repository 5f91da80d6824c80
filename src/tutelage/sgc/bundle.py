"""What the authority gives to one node: certificate, membership, the node's part of the policy, and the deny list."""

from __future__ import annotations

from dataclasses import dataclass

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey

from tutelage.sgc.access import Access
from tutelage.sgc.certificates import load, raw
from tutelage.sgc.envelope import open_sealed, seal_to
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.signed import sign, verified
from tutelage.sgc.trust import Member, Trust
from tutelage.sgc.wire import pack, unpack

CONTEXT = b"tutelage bundle 1"
_MAGIC = b"tutelage bundle 1\n"
MAX_BUNDLE = 64 << 20


@dataclass(frozen=True)
class Bundle:
    """The contents.

    Attributes:
        leaf, authority, root: certificates, DER.
        membership: signed statement that the pseudonym is this node.
        access: the node's part of the policy.
        deny: signed deny list, b"" if there never was one.
    """

    leaf: bytes
    authority: bytes
    root: bytes
    membership: bytes
    access: Access
    deny: bytes

    @property
    def credential(self) -> bytes:
        """What the node shows to others: see `Trust.verify`."""
        return pack(self.leaf, self.authority, self.membership)

    def seal(self, to: X25519PublicKey, key: Ed25519PrivateKey) -> bytes:
        """Signed by the authority, then sealed to the node, so that whoever carries it learns nothing.

        key: the authority's.
        """
        parts = (self.leaf, self.authority, self.root, self.membership, self.access.to_json().encode(), self.deny, raw(to))
        return _MAGIC + seal_to(to, CONTEXT, pack(self.authority, sign(CONTEXT, pack(*parts), key)))

    @classmethod
    def open(
        cls, sealed: bytes, key: X25519PrivateKey, trust: Trust | None, *, dated: bool = True
    ) -> tuple[Bundle, Trust, Member]:
        """Read a bundle, with what follows from it: whom to believe and who we are.

        key: the node's sealing key.
        trust: None for the first bundle, which brings the root.
        dated: False to read one whose time may be over, or whose node is revoked: what was accepted in its time.

        Raises:
            Refused: NOT_FOR_US, WRONG_AUTHORITY, MALFORMED, EXPIRED or REVOKED.
        """
        if not is_bundle(sealed) or len(sealed) > MAX_BUNDLE:
            raise Refused(Reason.MALFORMED, "not a bundle")
        authority, statement = unpack(open_sealed(key, CONTEXT, sealed[len(_MAGIC) :]), 2)
        root = unpack(unpack(statement, 2)[0], 7)[2]
        trust = trust or Trust(load(root))
        signed = verified(CONTEXT, statement, trust.authority(authority, dated=dated), Reason.WRONG_AUTHORITY)
        leaf, issuer, root, membership, access, deny, to = unpack(signed, 7)
        if to != raw(key.public_key()):
            raise Refused(Reason.NOT_FOR_US, "a bundle that was sealed to another node first")
        try:
            bundle = cls(leaf, issuer, root, membership, Access.from_json(access.decode()), deny)
        except UnicodeDecodeError:
            raise Refused(Reason.MALFORMED, "a part of a policy that is not text") from None
        member = trust.verify(bundle.credential) if dated else trust.read(bundle.credential)
        if member.node != bundle.access.node or raw(member.sealing) != to:
            raise Refused(Reason.NOT_FOR_US, f"a bundle of {bundle.access.node} with the certificate of {member.node}")
        return bundle, trust, member


def is_bundle(notice: bytes) -> bool:
    """Does it begin like a bundle?"""
    return notice.startswith(_MAGIC)
