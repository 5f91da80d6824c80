"""The fleet's authority: an offline root, a certificate authority that the root signed, and what it signs.

root/           root key (encrypted if a passphrase is given) and certificate: to be kept offline
ca.key, ca.pem  the fleet's authority                                         0600
names.secret    from which each topic's secret is derived                     0600
policy.toml     who may say and hear what; edited by people
state.json      serials
members/        one file a node: name, pseudonym, certificate
outbox/         bundles and the deny list, ready to be carried to the nodes
"""

from __future__ import annotations

from pathlib import Path


class Authority:
    """Signs certificates, the nodes' parts of the policy, and the deny list. It can name topics, but read no message."""

    path: Path
    fleet: str

    @classmethod
    def create(cls, path: Path, fleet: str, *, passphrase: bytes | None = None, years: float = 10.0) -> Authority:
        """Make root, authority, and a policy file to fill in.

        Raises:
            KeysError: the folder is not empty.
        """
        raise NotImplementedError

    @classmethod
    def open(cls, path: Path) -> Authority:
        """Read the folder; the root key is not needed.

        Raises:
            KeysError: no authority there, or damaged.
        """
        raise NotImplementedError

    def issue(self, request: bytes, *, hours: float = 24.0) -> bytes:
        """A certificate for a new node, or a node known before: the bundle for its `Home.accept`.

        Raises:
            Refused: a request that is damaged, not signed by its keys, or for the name of another node's keys.
            KeysError: the node is revoked.
        """
        raise NotImplementedError

    def renew(self, request: bytes, *, hours: float = 24.0) -> bytes:
        """Like `issue`, but only for a member whose keys are those of the request; safe to offer over the network."""
        raise NotImplementedError

    def publish(self) -> dict[str, bytes]:
        """Sign the policy file as it now is: a new bundle for each member, by name; also written to outbox/."""
        raise NotImplementedError

    def revoke(self, name: str) -> bytes:
        """Put a node on the deny list; the signed list, also in outbox/, is for everybody's `Home.accept`.

        Raises:
            KeysError: no such node.
        """
        raise NotImplementedError
