"""Whom to believe: credentials are verified against the fleet's root, the deny list and the clock."""

from __future__ import annotations

from dataclasses import dataclass

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PublicKey

from tutelage.sgc.access import Role


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
    """

    node: str
    pseudonym: str
    role: Role
    signing: Ed25519PublicKey
    sealing: X25519PublicKey
    not_before: float
    not_after: float


@dataclass(frozen=True)
class DenyList:
    """Pseudonyms that are revoked, signed by the fleet's authority.

    Attributes:
        serial: counts up with every change.
        pseudonyms: who.
    """

    serial: int
    pseudonyms: frozenset[str]


class Trust:
    """The root that a node believes, the deny list it has, and what follows from them."""

    @property
    def deny_list(self) -> DenyList:
        """The newest that was accepted."""
        raise NotImplementedError

    def verify(self, credential: bytes, now: float | None = None) -> Member:
        """Who is this?

        credential: certificate, its issuer's certificate and the signed membership, as `Home.credential` gives them.
        now: seconds since 1970; default: the clock.

        Raises:
            Refused: MALFORMED, WRONG_AUTHORITY, EXPIRED or REVOKED.
        """
        raise NotImplementedError

    def check(self, member: Member, now: float | None = None) -> None:
        """Is a member that was verified before still to be believed?

        Raises:
            Refused: EXPIRED or REVOKED.
        """
        raise NotImplementedError
