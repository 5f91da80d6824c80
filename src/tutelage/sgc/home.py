"""A node's folder: its keys, certificate, part of the policy, and the keys of its topics. Private keys never leave it.

node.json       name and role
signing.key     Ed25519, for TLS and for signatures          0600
sealing.key     X25519, for what is sealed to this node      0600
request         the signing request, for the authority
leaf.pem        certificate and its issuer's
root.pem        the root that this node believes
bundle          what the authority gave: certificate, membership, part of the policy
deny            the newest deny list
keys/           of topics, by alias, sealed to this node
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from tutelage.sgc.access import Access, Role
from tutelage.sgc.trust import Trust


class Home:
    """A node's identity on disk. Safe to use from several threads; follows changes that `tutelage keys` makes."""

    path: Path
    name: str
    role: Role
    version: int
    """Counts up when certificate, policy or deny list changed; whoever derived something from them looks at it."""

    @classmethod
    def create(
        cls, path: Path, name: str, *, role: Role = Role.NODE, addresses: Sequence[str] = (), root: Path | None = None
    ) -> Home:
        """Make the folder, the node's keys and the signing request.

        addresses: IP addresses and host names at which others reach it; a router needs at least one.
        root: the fleet's root certificate, if already at hand; otherwise the first bundle brings it.

        Raises:
            KeysError: the folder holds a home already, or the name or an address is impossible.
        """
        raise NotImplementedError

    @classmethod
    def open(cls, path: Path) -> Home:
        """Read the folder.

        Raises:
            KeysError: no home, or a damaged one; the message names the node and the remedy.
        """
        raise NotImplementedError

    @property
    def pseudonym(self) -> str:
        """32 hexadecimal digits: the common name of the certificate."""
        raise NotImplementedError

    @property
    def expires(self) -> float:
        """When the certificate expires, seconds since 1970."""
        raise NotImplementedError

    @property
    def access(self) -> Access:
        """What this node may do.

        Raises:
            NotIssued: no bundle yet.
        """
        raise NotImplementedError

    @property
    def trust(self) -> Trust:
        """Whom this node believes."""
        raise NotImplementedError

    @property
    def credential(self) -> bytes:
        """What this node shows to others, only ever sealed: certificate, issuer, membership (name and pseudonym)."""
        raise NotImplementedError

    @property
    def leaf_file(self) -> Path:
        """PEM: certificate and its issuer's, for TLS."""
        raise NotImplementedError

    @property
    def key_file(self) -> Path:
        """PEM: the private key of the certificate, for TLS."""
        raise NotImplementedError

    @property
    def root_file(self) -> Path:
        """PEM: the root certificate, for TLS."""
        raise NotImplementedError

    def check(self, now: float | None = None) -> None:
        """Is the certificate there and valid?

        Raises:
            NotIssued: the message names the node and the remedy.
        """
        raise NotImplementedError

    def refresh(self) -> bool:
        """Read again what changed on disk. True if something did. Cheap: looks at the times of three files."""
        raise NotImplementedError

    def request(self) -> bytes:
        """A request for a (new) certificate, signed with this node's keys; `Authority.issue` or `.renew` answers it."""
        raise NotImplementedError

    def accept(self, notice: bytes) -> Literal["bundle", "deny"]:
        """Take what the authority sent, by file or over any channel: a bundle (renewal, policy) or a deny list.

        Raises:
            Refused: WRONG_AUTHORITY, ROLLBACK, NOT_FOR_US, MALFORMED; nothing is changed.
        """
        raise NotImplementedError

    @property
    def deny_notice(self) -> bytes | None:
        """The newest deny list as signed bytes, to pass on to others; None if there never was one."""
        raise NotImplementedError
