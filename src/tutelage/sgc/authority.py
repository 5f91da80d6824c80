"""The fleet's authority: an offline root, a certificate authority that the root signed, and what it signs.

    root/           root.key (encrypted if a passphrase is given): to be kept offline
    root.pem        the root certificate, for the nodes
    ca.key, ca.pem  the fleet's authority                                         0600
    names.secret    from which each topic's secret is derived                     0600
    policy.toml     who may say and hear what; edited by people
    published.toml  the policy as it was last signed
    state.json      name of the fleet, serials, members, revoked pseudonyms       0600
    outbox/         bundles and the deny list, ready to be carried to the nodes

It can name topics and say who is who, but it holds no topic's key.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from tutelage.files import Lock, write_atomic
from tutelage.sgc import certificates
from tutelage.sgc.access import Access, Entry, Renewals
from tutelage.sgc.bundle import Bundle
from tutelage.sgc.certificates import raw
from tutelage.sgc.envelope import derive
from tutelage.sgc.errors import KeysError
from tutelage.sgc.names import SECRET_BYTES, Name
from tutelage.sgc.policy import TEMPLATE, Policy, routes
from tutelage.sgc.privatekeys import holds, key_pem, load_signing_key, make_folder, save_key
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.roster import Roster
from tutelage.sgc.rules import NODE_NAME, Role
from tutelage.sgc.signed import sign
from tutelage.sgc.trust import DENY_LIST, MEMBERSHIP, fingerprint, membership
from tutelage.sgc.wire import pack

LEAF_HOURS = 24.0
AUTHORITY_DAYS = 366.0
ROOT_DAYS = 3660.0


class Authority:
    """Signs certificates, the nodes' parts of the policy, and the deny list. It can name topics, but read no message."""

    def __init__(self, path: Path) -> None:
        """Use `Authority.open`."""
        self.path = path
        self._lock = Lock(path / ".lock")
        self._files: dict[Path, bytes | None] = {}  # what a change will write (None: remove) once the list is saved
        self._read()

    def _read(self) -> None:
        path = self.path
        try:
            self._roster = Roster.load(path / "state.json")
            self._secret = (path / "names.secret").read_bytes()
            self._key = load_signing_key(path / "ca.key")
            self._certificate = x509.load_pem_x509_certificate((path / "ca.pem").read_bytes())
            self._root = x509.load_pem_x509_certificate((path / "root.pem").read_bytes())
            if len(self._secret) != SECRET_BYTES:
                raise ValueError("names.secret has another length")
        except FileNotFoundError as error:
            raise KeysError(
                f"{path} is no fleet's authority (no {Path(error.filename).name}); "
                f"make one: tutelage keys init {path} --fleet NAME"
            ) from None
        except (OSError, ValueError, TypeError) as error:
            raise KeysError(f"{path} is damaged: {error}; restore it from a copy") from None
        try:
            self._certificate.verify_directly_issued_by(self._root)
        except certificates.UNREADABLE:
            raise KeysError(f"{path} is damaged: ca.pem does not come from root.pem; restore it from a copy") from None

    @classmethod
    def create(cls, path: Path, fleet: str, *, passphrase: bytes | None = None) -> Authority:
        """Make root, authority, and a policy file to fill in.

        passphrase: encrypts the root's key.

        Raises:
            KeysError: the folder holds an authority already, or the name is impossible.
        """
        if not NODE_NAME.fullmatch(fleet):
            raise KeysError(f"a fleet's name is 1 to 63 letters, digits, '.', '_' and '-', not {fleet!r}")
        if holds(path, "state.json"):
            raise KeysError(f"{path} holds the authority of a fleet already; choose another folder")
        if holds(path, "node.json"):
            raise KeysError(f"{path} is the home of a node already; choose another folder")
        make_folder(path)
        root_key = Ed25519PrivateKey.generate()
        public, now = root_key.public_key(), time.time()
        root = certificates.authority_certificate(f"{fleet} root", public, None, root_key, now, ROOT_DAYS)
        save_key(path / "root" / "root.key", root_key, passphrase)
        os.chmod(path / "root", 0o700)
        write_atomic(path / "root.pem", certificates.pem(root))
        write_atomic(path / "names.secret", secrets.token_bytes(SECRET_BYTES), private=True)
        write_atomic(path / "policy.toml", TEMPLATE.encode())
        write_atomic(path / "published.toml", TEMPLATE.encode())
        key, certificate = _certify(fleet, root, root_key)
        save_key(path / "ca.key", key)
        write_atomic(path / "ca.pem", certificates.pem(certificate))
        Roster(path / "state.json", fleet).save()
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> Authority:
        """Read the folder; the root key is not needed.

        Raises:
            KeysError: no authority there, or damaged.
        """
        return cls(Path(path))

    @property
    def fleet(self) -> str:
        """Name of the fleet."""
        return self._roster.fleet

    @property
    def root(self) -> x509.Certificate:
        """What every node of the fleet believes."""
        return self._root

    @property
    def certificate(self) -> x509.Certificate:
        """The authority's own, signed by the root."""
        return self._certificate

    @property
    def roster(self) -> Roster:
        """Members, revoked pseudonyms, serials. To be read only."""
        return self._roster

    @property
    def routers(self) -> list[str]:
        """Names of the routers that are members."""
        return [name for name, record in self._roster.members.items() if record.keys.role == Role.ROUTER]

    @property
    def unsigned(self) -> bool:
        """Has the policy file changed since `publish`?"""
        file, signed = self.path / "policy.toml", self.path / "published.toml"
        try:
            return file.is_file() and not (signed.is_file() and file.read_bytes() == signed.read_bytes())
        except OSError as error:
            raise KeysError(f"cannot read {error.filename}: {error.strerror}") from None

    def strangers(self) -> list[str]:
        """Names in the policy that was published that are no members: yet to come, or misspelt."""
        policy = self._policy()
        names = {name for rule in policy.topics.values() for name in rule.names()} | {policy.renewals} - {""}
        return sorted(names - self._roster.members.keys())

    def refresh(self) -> None:
        """Read again what another process changed."""
        with self._lock:
            self._read()

    def renew_own(self, root_key: Path | None = None, passphrase: bytes | None = None, *, revoke_old: bool = False) -> None:
        """A new key and certificate for the authority itself; leaves that the old one signed stay valid until they expire.

        root_key: default: root/root.key in the folder.
        revoke_old: the old key was stolen: whatever it signed is refused from now on, leaves of all nodes included; new
            bundles for all are in outbox/.

        Raises:
            KeysError: no such key, not this fleet's, or the passphrase does not fit.
        """
        path = root_key or self.path / "root" / "root.key"
        try:
            key = load_signing_key(path, passphrase)
        except FileNotFoundError:
            raise KeysError(
                f"no root key {path}; bring the medium that holds it, and name the file with --root-key"
            ) from None
        except (OSError, ValueError, TypeError) as error:
            raise KeysError(f"cannot read the root key {path}: {error}") from None
        if key.public_key() != self._root.public_key():
            raise KeysError(f"{path} is not the root key of {self.fleet}")
        with self._changing(renews=True):
            old = fingerprint(self._certificate)
            self._key, self._certificate = _certify(self.fleet, self._root, key)
            self._files[self.path / "ca.key"] = key_pem(self._key)
            self._files[self.path / "ca.pem"] = certificates.pem(self._certificate)
            if revoke_old:
                self._roster.revoked_authorities.append(old)
                self._roster.deny_serial += 1
                self._roster.serial += 1
                for name in list(self._roster.members):
                    self._bundle(name, LEAF_HOURS)
            self._write_deny_list()

    def issue(self, request: bytes, *, hours: float = LEAF_HOURS) -> bytes:
        """A certificate for a new node, or for one known before: the bundle for its `Home.accept`.

        Raises:
            Refused: MALFORMED or FORGED: a request that is damaged, or not signed by its key.
            KeysError: the name belongs to a node with other keys.
        """
        keys = certificates.read_request(request)
        with self._changing():
            known = self._roster.members.get(keys.common_name)
            if known is not None and not known.has_keys_of(keys):
                raise KeysError(
                    f"{keys.common_name} has other keys already; if the node lost them, revoke it first: "
                    f"tutelage keys revoke {keys.common_name}"
                )
            if name := self._roster.revoked_as(keys):
                raise KeysError(f"these keys were revoked with {name}; make a new home on the node: tutelage keys init")
            self._roster.admit(keys)
            if known is None and keys.common_name == self._policy().renewals:
                self._roster.serial += 1  # all must learn where to renew
            if known is None:
                self._write_for_routers()
            return self._bundle(keys.common_name, hours)

    def renew(self, request: bytes, *, hours: float = LEAF_HOURS) -> bytes:
        """Like `issue`, but only for a member whose keys are those of the request; safe to offer over a network.

        Raises:
            Refused: MALFORMED, FORGED, or NOT_ALLOWED: not a member with these keys.
        """
        keys = certificates.read_request(request)
        with self._changing():
            known = self._roster.members.get(keys.common_name)
            if known is None or not known.has_keys_of(keys):
                raise Refused(Reason.NOT_ALLOWED, f"{keys.common_name} with these keys is no member of {self.fleet}")
            return self._bundle(known.name, hours)

    def publish(self, *, hours: float = LEAF_HOURS) -> dict[str, bytes]:
        """Sign the policy file as it now is: a new bundle for each member, by name; also written to outbox/.

        Raises:
            ConfigError: the policy file has a fault; nothing is changed.
        """
        _check_hours(hours)
        policy = Policy.load(self.path / "policy.toml")
        with self._changing():
            named = {f"owner of {alias!r}": rule.owner for alias, rule in policy.topics.items()}
            for what, name in {"renewals": policy.renewals, **named}.items():
                if name in self.routers:
                    raise KeysError(f"{self.path / 'policy.toml'}: {what} is {name}, a router; only nodes have a part in it")
            self._files[self.path / "published.toml"] = (self.path / "policy.toml").read_bytes()
            self._roster.serial += 1
            return {name: self._bundle(name, hours) for name in list(self._roster.members)}

    def revoke(self, *names: str) -> bytes:
        """Put nodes on the deny list; the signed list, also in outbox/, is for everybody's `Home.accept`.

        Raises:
            KeysError: one of them is no member; nobody is revoked.
        """
        with self._changing():
            if unknown := sorted(set(names) - self._roster.members.keys()):
                known = ", ".join(sorted(self._roster.members)) or "none"
                gone = unknown[0] in (name for name, _ in self._roster.revoked.values())
                what = "has revoked" if gone else "has no member"
                raise KeysError(f"{self.fleet} {what} {unknown[0]!r}{' already' * gone}; members: {known}")
            for name in dict.fromkeys(names):
                self._roster.revoke(name)
                self._files[self.path / "outbox" / f"{name}.bundle"] = None
            notice = self._write_deny_list()
            self._write_for_routers()
            return notice

    def deny_notice(self) -> bytes:
        """The signed deny list; b"" if nobody was ever revoked."""
        if not self._roster.deny_serial:
            return b""
        content = {
            "serial": self._roster.deny_serial,
            "pseudonyms": sorted(self._roster.revoked),
            "authorities": self._roster.revoked_authorities,
        }
        body = json.dumps(content, sort_keys=True).encode()
        return pack(certificates.der(self._certificate), sign(DENY_LIST, body, self._key))

    def access(self, name: str, role: Role) -> Access:
        """A node's part of the policy that was last published."""
        policy = self._policy()
        control = derive(self._secret, b"", b"tutelage fleet 1")
        entries = {alias: Entry(rule, self._topic_secret(rule.topic.canonical())) for alias, rule in policy.topics.items()}
        pseudonyms = {name: record.pseudonym for name, record in self._roster.members.items()}
        office = self._roster.members.get(policy.renewals)
        router = role == Role.ROUTER
        nodes = {name: one for name, one in pseudonyms.items() if self._roster.members[name].keys.role == Role.NODE}
        return Access(
            fleet=self.fleet,
            node=name,
            serial=self._roster.serial_of(role),
            topics={} if router else {alias: entries[alias] for alias in policy.of_node(name)},
            control=Name.of_channel("notices", control),
            secret=b"" if router else control,
            renewals=Renewals(office.pseudonym, raw(office.keys.sealing)) if office else None,
            routes=routes(entries.values(), nodes) if router else (),
            members=frozenset(nodes.values()) if router else frozenset(),
            routers=frozenset(pseudonyms.values()) - frozenset(nodes.values()) if router else frozenset(),
        )

    def _policy(self) -> Policy:
        path = self.path / "published.toml"
        content = self._files.get(path)
        if content is None and not path.is_file():
            raise KeysError(f"{self.fleet} has no signed policy (no {path}): tutelage keys issue {self.path} --policy")
        return Policy.load(path) if content is None else Policy.parse(content.decode())

    def _topic_secret(self, canonical: bytes) -> bytes:
        return hmac.digest(self._secret, pack(b"tutelage topic secret 1", canonical), hashlib.sha256)

    def _bundle(self, name: str, hours: float) -> bytes:
        """Certificate, membership and part of the policy for a member; also written to outbox/."""
        _check_hours(hours)
        record = self._roster.members[name]
        keys = replace(record.keys, common_name=record.pseudonym)
        leaf = certificates.leaf_certificate(keys, self._certificate, self._key, time.time(), hours)
        statement = membership(record.name, record.pseudonym, raw(keys.signing), raw(keys.sealing))
        bundle = Bundle(
            leaf=certificates.der(leaf),
            authority=certificates.der(self._certificate),
            root=certificates.der(self._root),
            membership=sign(MEMBERSHIP, statement, self._key),
            access=self.access(record.name, keys.role),
            deny=self.deny_notice(),
        ).seal(keys.sealing, self._key)
        self._roster.issued(record.name, leaf.not_valid_after_utc.timestamp())
        self._files[self.path / "outbox" / f"{record.name}.bundle"] = bundle
        return bundle

    def _write_deny_list(self) -> bytes:
        notice = self.deny_notice()
        if notice:
            self._files[self.path / "outbox" / "deny"] = notice
        return notice

    def _write_for_routers(self) -> None:
        """Routers must hear of every new or revoked member; nodes need not."""
        for record in list(self._roster.members.values()):
            if record.keys.role == Role.ROUTER:
                self._bundle(record.name, LEAF_HOURS)

    @contextmanager
    def _changing(self, *, renews: bool = False) -> Iterator[None]:
        """Another process may serve renewals meanwhile: read, change and write under a lock. Files are written at the end,
        after the list that they follow from: what was interrupted has changed nothing, or is whole when it is done again.

        renews: the change is a new key of the authority itself.
        """
        with self._lock:
            self._read()
            if not renews and self._key.public_key() != self._certificate.public_key():
                again = f"tutelage keys renew {self.path}"
                raise KeysError(f"{self.path}: the renewal of the authority was interrupted; do it again: {again}")
            self._files = {}
            try:
                yield
                self._roster.save()
                for path, content in self._files.items():
                    if content is None:
                        path.unlink(missing_ok=True)
                    else:
                        write_atomic(path, content, private=path.suffix == ".key")
            except BaseException:
                self._read()
                raise
            finally:
                self._files = {}


def _check_hours(hours: float) -> None:
    if not 0 < hours <= 24 * 366:
        raise KeysError(f"a certificate is for more than 0 and at most 8784 hours, not {hours:g}")


def _certify(fleet: str, root: x509.Certificate, root_key: Ed25519PrivateKey) -> tuple[Ed25519PrivateKey, x509.Certificate]:
    key = Ed25519PrivateKey.generate()
    name = f"{fleet} authority"
    return key, certificates.authority_certificate(name, key.public_key(), root, root_key, time.time(), AUTHORITY_DAYS)
