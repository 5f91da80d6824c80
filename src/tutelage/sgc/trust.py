"""Whom to believe: credentials are verified against the fleet's root, the deny list and the clock."""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PublicKey

from tutelage.sgc.certificates import PSEUDONYM, UNREADABLE, der, load, raw, read_leaf
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import NODE_NAME, Role
from tutelage.sgc.signed import verified
from tutelage.sgc.wire import pack, unpack

MEMBERSHIP = b"tutelage membership 1"
DENY_LIST = b"tutelage deny list 1"
MAX_CREDENTIAL = 16_384
_REMEMBERED = 4096


@dataclass(frozen=True)
class Member:
    """A verified credential: a node of the fleet, and the keys that are its own.

    Attributes:
        node: name, such as "arm-3". Known to members only; certificates carry the pseudonym.
        pseudonym: 32 hexadecimal digits, the common name of its certificate; stays when the certificate is renewed.
        role: node or router.
        signing: its signatures verify under this.
        sealing: what only it may read is sealed to this.
        not_before, not_after: validity, seconds since 1970.
        authority: fingerprint of the authority that issued its certificate.
    """

    node: str
    pseudonym: str
    role: Role
    signing: Ed25519PublicKey
    sealing: X25519PublicKey
    not_before: float
    not_after: float
    authority: str


@dataclass(frozen=True)
class DenyList:
    """Who is revoked, signed by the fleet's authority.

    Attributes:
        serial: counts up with every change.
        pseudonyms: of nodes and routers.
        authorities: fingerprints of certificates of the authority whose key was stolen.
        since: when the certificate of the authority that signed it begins, seconds since 1970. What a newer authority says
            counts more than any serial of an older one, so that a thief of the older one's key cannot have the last word.
    """

    serial: int = 0
    pseudonyms: frozenset[str] = frozenset()
    authorities: frozenset[str] = frozenset()
    since: float = 0.0

    @property
    def order(self) -> tuple[float, int]:
        """The greater one counts."""
        return self.since, self.serial


class Trust:
    """The root that a node believes, the deny list it has, and what follows from them. Safe to use from several threads."""

    def __init__(self, root: x509.Certificate, deny_list: DenyList | None = None) -> None:
        key = root.public_key()
        if not isinstance(key, Ed25519PublicKey):
            raise Refused(Reason.MALFORMED, "the key of the root is not Ed25519")
        self.root = root
        self.deny_list = deny_list or DenyList()
        self._known: OrderedDict[bytes, Member] = OrderedDict()
        self._authorities: OrderedDict[bytes, x509.Certificate] = OrderedDict()
        self._lock = threading.Lock()

    def verify(self, credential: bytes, now: float | None = None) -> Member:
        """Who is this?

        credential: certificate, its issuer's certificate and the signed membership, as `Home.credential` gives them.
        now: seconds since 1970; default: the clock.

        Raises:
            Refused: MALFORMED, WRONG_AUTHORITY, EXPIRED or REVOKED.
        """
        member = self.read(credential)
        self.check(member, now)
        return member

    def read(self, credential: bytes) -> Member:
        """Like `verify`, but whatever the time, and even if revoked.

        Raises:
            Refused: MALFORMED or WRONG_AUTHORITY.
        """
        if len(credential) > MAX_CREDENTIAL:
            raise Refused(Reason.MALFORMED, f"a credential of {len(credential)} bytes")
        digest = hashlib.sha256(credential).digest()
        with self._lock:
            member = self._known.get(digest)
        if member is None:
            member = self._read(credential)
            with self._lock:
                self._known[digest] = member
                while len(self._known) > _REMEMBERED:
                    self._known.popitem(last=False)
        return member

    def check(self, member: Member, now: float | None = None) -> None:
        """Is a member that was verified before still to be believed?

        Raises:
            Refused: EXPIRED or REVOKED.
        """
        now = time.time() if now is None else now
        deny = self.deny_list
        if member.pseudonym in deny.pseudonyms:
            raise Refused(Reason.REVOKED, f"{member.node} is revoked")
        if member.authority in deny.authorities:
            raise Refused(
                Reason.REVOKED, f"the certificate of {member.node} is by an authority that was revoked; renew it there"
            )
        if now > member.not_after:
            raise Refused(
                Reason.EXPIRED,
                f"the certificate of {member.node} expired {now - member.not_after:.0f} s ago; renew it there",
            )
        if now < member.not_before:
            raise Refused(
                Reason.EXPIRED,
                f"the certificate of {member.node} begins in {member.not_before - now:.0f} s; check both clocks",
            )

    def authority(self, certificate: bytes, now: float | None = None, *, dated: bool = True) -> Ed25519PublicKey:
        """The key of the fleet's authority, if the root signed its certificate (DER) and it is valid.

        dated: False to believe it whatever the time, for what was accepted in its time.

        Raises:
            Refused: MALFORMED, WRONG_AUTHORITY, EXPIRED or REVOKED.
        """
        found = self._authority(certificate)
        if dated and fingerprint(found) in self.deny_list.authorities:
            raise Refused(Reason.REVOKED, "signed by an authority that was revoked")
        now = time.time() if now is None else now
        if dated and not found.not_valid_before_utc.timestamp() <= now <= found.not_valid_after_utc.timestamp():
            raise Refused(
                Reason.EXPIRED,
                "the authority's certificate is not valid now; renew it there: tutelage keys renew --authority",
            )
        key = found.public_key()
        assert isinstance(key, Ed25519PublicKey)  # _authority saw to it
        return key

    def since(self, certificate: bytes) -> float:
        """When the certificate of an authority (DER) begins, seconds since 1970.

        Raises:
            Refused: MALFORMED or WRONG_AUTHORITY.
        """
        return self._authority(certificate).not_valid_before_utc.timestamp()

    def read_deny_list(self, notice: bytes, now: float | None = None, *, dated: bool = True) -> DenyList:
        """Read a signed deny list; whether it is newer is for the caller to compare. For `dated` see `authority`.

        Raises:
            Refused: MALFORMED, WRONG_AUTHORITY or EXPIRED.
        """
        certificate, statement = unpack(notice, 2)
        body = verified(DENY_LIST, statement, self.authority(certificate, now, dated=dated), Reason.WRONG_AUTHORITY)
        try:
            content = json.loads(body)
            pseudonyms, authorities = frozenset(content["pseudonyms"]), frozenset(content["authorities"])
            if not all(isinstance(one, str) and PSEUDONYM.fullmatch(one) for one in pseudonyms):
                raise ValueError("a pseudonym is not one")
            return DenyList(int(content["serial"]), pseudonyms, authorities, self.since(certificate))
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise Refused(Reason.MALFORMED, f"not a deny list: {error}") from None

    def _authority(self, certificate: bytes) -> x509.Certificate:
        with self._lock:
            if (known := self._authorities.get(certificate)) is not None:
                return known
        found = load(certificate)
        _check_issued(found, self.root)
        try:
            constraints = found.extensions.get_extension_for_class(x509.BasicConstraints).value
            usage = found.extensions.get_extension_for_class(x509.KeyUsage).value
            able = constraints.ca and usage.key_cert_sign and isinstance(found.public_key(), Ed25519PublicKey)
        except UNREADABLE as error:
            raise Refused(Reason.MALFORMED, f"not the certificate of an authority: {error}") from None
        if not able:
            raise Refused(Reason.WRONG_AUTHORITY, "a certificate that may not issue others was used as an authority's")
        with self._lock:
            self._authorities[certificate] = found
            while len(self._authorities) > 16:
                self._authorities.popitem(last=False)
        return found

    def _read(self, credential: bytes) -> Member:
        leaf_der, authority_der, membership = unpack(credential, 3)
        authority = self._authority(authority_der)
        leaf = load(leaf_der)
        _check_issued(leaf, authority)
        keys = read_leaf(leaf)
        authority_key = authority.public_key()
        assert isinstance(authority_key, Ed25519PublicKey)  # _authority saw to it
        body = verified(MEMBERSHIP, membership, authority_key, Reason.WRONG_AUTHORITY)
        node, pseudonym, signing, sealing = read_membership(body)
        if (pseudonym, signing, sealing) != (keys.common_name, raw(keys.signing), raw(keys.sealing)):
            raise Refused(Reason.WRONG_AUTHORITY, f"the membership of {node} is for another certificate")
        begin = max(leaf.not_valid_before_utc, authority.not_valid_before_utc).timestamp()
        end = min(leaf.not_valid_after_utc, authority.not_valid_after_utc).timestamp()
        return Member(node, pseudonym, keys.role, keys.signing, keys.sealing, begin, end, fingerprint(authority))


def membership(node: str, pseudonym: str, signing: bytes, sealing: bytes) -> bytes:
    """The statement, to be signed by the authority, that a pseudonym with these keys is a node."""
    return pack(node.encode(), pseudonym.encode(), signing, sealing)


def read_membership(body: bytes) -> tuple[str, str, bytes, bytes]:
    """Read what `membership` gave.

    Raises:
        Refused: MALFORMED.
    """
    node, pseudonym, signing, sealing = unpack(body, 4)
    try:
        names = node.decode(), pseudonym.decode()
    except UnicodeDecodeError:
        raise Refused(Reason.MALFORMED, "a membership whose name is not text") from None
    if not NODE_NAME.fullmatch(names[0]) or not PSEUDONYM.fullmatch(names[1]):
        raise Refused(Reason.MALFORMED, f"a membership with an impossible name: {names[0]!r}")
    return *names, signing, sealing


def fingerprint(certificate: x509.Certificate) -> str:
    """SHA-256 of a certificate in hexadecimal, for people to compare."""
    return hashlib.sha256(der(certificate)).hexdigest()


def _check_issued(certificate: x509.Certificate, issuer: x509.Certificate) -> None:
    try:
        certificate.verify_directly_issued_by(issuer)
    except UNREADABLE:
        raise Refused(Reason.WRONG_AUTHORITY, "a certificate that does not come from the fleet's root") from None
