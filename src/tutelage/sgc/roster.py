"""Who belongs to a fleet: the authority's list of members, of revoked pseudonyms, and the serials of what it signed."""

from __future__ import annotations

import json
import secrets
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PublicKey

from tutelage.files import write_atomic
from tutelage.sgc.certificates import Keys, raw
from tutelage.sgc.rules import Role

_FORMAT = 1


@dataclass(frozen=True)
class Record:
    """A member.

    Attributes:
        name: of the node.
        pseudonym: in its certificates.
        keys: public keys, role, addresses.
        expires: of the newest certificate, seconds since 1970; 0 before the first.
    """

    name: str
    pseudonym: str
    keys: Keys
    expires: float = 0.0

    def has_keys_of(self, keys: Keys) -> bool:
        """Are these the member's keys, for the role that it has?"""
        mine = (raw(self.keys.signing), raw(self.keys.sealing), self.keys.role)
        return mine == (raw(keys.signing), raw(keys.sealing), keys.role)


class Roster:
    """The list on disk."""

    def __init__(self, path: Path, fleet: str) -> None:
        self.path = path
        self.fleet = fleet
        self.serial = 1
        self.members_serial = 0
        self.deny_serial = 0
        self.members: dict[str, Record] = {}
        self.revoked: dict[str, tuple[str, str]] = {}
        """By pseudonym: name and signing key (hexadecimal), so that these keys are not let in again."""
        self.revoked_authorities: list[str] = []
        """Fingerprints of the authority's own certificates whose keys were stolen."""

    def admit(self, keys: Keys) -> None:
        """The node `keys.common_name`: a new member gets a random pseudonym, a known one may get other addresses."""
        name = keys.common_name
        known = self.members.get(name)
        self.members[name] = replace(known, keys=keys) if known else Record(name, secrets.token_hex(16), keys)
        self.members_serial += known is None

    def revoked_as(self, keys: Keys) -> str | None:
        """The name under which keys were revoked, if they were."""
        return next((name for name, signing in self.revoked.values() if signing == raw(keys.signing).hex()), None)

    def issued(self, name: str, expires: float) -> None:
        """Note until when a member's newest certificate is valid."""
        self.members[name] = replace(self.members[name], expires=expires)

    def revoke(self, name: str) -> None:
        """Put a member on the deny list; the name is free again."""
        record = self.members.pop(name)
        self.revoked[record.pseudonym] = (name, raw(record.keys.signing).hex())
        self.deny_serial += 1
        self.members_serial += 1

    def serial_of(self, role: Role) -> int:
        """Serial of the part of the policy of nodes, or of routers, which must also know who is a member."""
        return self.serial + (self.members_serial if role == Role.ROUTER else 0)

    def save(self) -> None:
        """Write the file, for the owner's eyes only."""
        content = {
            "format": _FORMAT,
            "fleet": self.fleet,
            "serial": self.serial,
            "deny_serial": self.deny_serial,
            "members_serial": self.members_serial,
            "members": {name: _to_json(record) for name, record in self.members.items()},
            "revoked": self.revoked,
            "revoked_authorities": self.revoked_authorities,
        }
        write_atomic(self.path, (json.dumps(content, indent=1) + "\n").encode(), private=True)

    @classmethod
    def load(cls, path: Path) -> Roster:
        """Read the file.

        Raises:
            ValueError: damaged, or of another version. OSError: cannot be read.
        """
        try:
            content = json.loads(path.read_bytes())
            if content["format"] != _FORMAT:
                raise ValueError(f"format {content['format']}, and this version reads {_FORMAT}")
            roster = cls(path, str(content["fleet"]))
            roster.serial, roster.deny_serial = int(content["serial"]), int(content["deny_serial"])
            roster.members_serial = int(content["members_serial"])
            roster.members = {name: _from_json(name, one) for name, one in content["members"].items()}
            roster.revoked = {str(pseudonym): (str(name), str(key)) for pseudonym, (name, key) in content["revoked"].items()}
            roster.revoked_authorities = [str(one) for one in content["revoked_authorities"]]
        except (KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"{path.name}: {error!r}") from None
        return roster


def _to_json(record: Record) -> dict[str, Any]:
    keys = record.keys
    return {
        "pseudonym": record.pseudonym,
        "role": str(keys.role),
        "signing": raw(keys.signing).hex(),
        "sealing": raw(keys.sealing).hex(),
        "addresses": list(keys.addresses),
        "expires": record.expires,
    }


def _from_json(name: str, content: dict[str, Any]) -> Record:
    signing = Ed25519PublicKey.from_public_bytes(bytes.fromhex(content["signing"]))
    sealing = X25519PublicKey.from_public_bytes(bytes.fromhex(content["sealing"]))
    keys = Keys(name, Role(content["role"]), signing, sealing, tuple(content["addresses"]))
    return Record(name, str(content["pseudonym"]), keys, float(content["expires"]))
