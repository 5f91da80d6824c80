"""A node's folder: its keys, certificate, part of the policy, and the keys of its topics. Private keys never leave it.

node.json       name, role and addresses
signing.key     Ed25519, for TLS and for signatures          0600
sealing.key     X25519, for what is sealed to this node      0600
request.pem     the signing request, for the authority
bundle          what the authority gave, sealed to this node; all that follows is read from it
leaf.pem        certificate and its issuer's, for TLS
root.pem        the root that this node believes
deny            the newest deny list
keys/           of topics, a file an alias, sealed to this node
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from tutelage.files import Lock, write_atomic
from tutelage.sgc import certificates
from tutelage.sgc.access import Access
from tutelage.sgc.bundle import Bundle, is_bundle
from tutelage.sgc.errors import KeysError, NotIssued
from tutelage.sgc.privatekeys import holds, load_sealing_key, load_signing_key, make_folder, save_key
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import NODE_NAME, Role
from tutelage.sgc.trust import Member, Trust

_FORMAT = 1


class Home:
    """A node's identity on disk. Safe to use from several threads; follows changes that `tutelage keys` makes.

    Attributes:
        path: the folder.
        name: of the node.
        role: node or router.
        version: counts up when certificate, policy or deny list changed; whoever derived something from them looks at it.
    """

    def __init__(self, path: Path) -> None:
        """Use `Home.open`."""
        self.path = path
        try:
            content = json.loads((path / "node.json").read_bytes())
            if content["format"] != _FORMAT:
                raise KeysError(f"{path} has format {content['format']}, this version of Tutelage reads {_FORMAT}")
            self.name, self.role = str(content["name"]), Role(content["role"])
            self.addresses = tuple(str(address) for address in content["addresses"])
            self.signing_key, self.sealing_key = load_signing_key(self.key_file), load_sealing_key(path / "sealing.key")
        except FileNotFoundError as error:
            raise KeysError(
                f"{path} is no node's home (no {Path(error.filename).name}); make one: "
                f"tutelage keys init {path} --node NAME (a router's: --router NAME)"
            ) from None
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise KeysError(f"{path} is damaged: {error}; restore it, or revoke the node and make a new home") from None
        self.version = 0
        self._lock = threading.RLock()
        self._files = Lock(path / ".lock")
        self._seen: tuple[object, ...] = ()
        self._trust: Trust | None = None
        self._bundle: Bundle | None = None
        self._member: Member | None = None
        self._order: tuple[float, int, float] = (0.0, 0, 0.0)
        self._deny: bytes | None = None
        self.refresh()

    @classmethod
    def create(
        cls, path: Path, name: str, *, role: Role = Role.NODE, addresses: Sequence[str] = (), root: Path | None = None
    ) -> Home:
        """Make the folder, the node's keys and the signing request.

        addresses: IP addresses and host names at which others reach it; a router needs at least one.
        root: the fleet's root certificate, if already at hand; otherwise the first bundle brings it.

        Raises:
            KeysError: the folder holds a home already, or the name is impossible.
            ConfigError: an address is impossible, or a router has none.
        """
        if not NODE_NAME.fullmatch(name):
            raise KeysError(f"a node's name is 1 to 63 letters, digits, '.', '_' and '-', not {name!r}")
        if holds(path, "node.json"):
            raise KeysError(f"{path} is the home of a node already; choose another folder")
        if holds(path, "state.json"):
            raise KeysError(f"{path} holds the authority of a fleet already; choose another folder")
        if role == Role.ROUTER:
            certificates.check_addresses(addresses)
        elif addresses:
            raise KeysError(f"{name} is a node, and nodes only dial out: addresses are for routers")
        believed = None if root is None else _read_root(root)
        make_folder(path)
        if believed is not None:
            write_atomic(path / "root.pem", certificates.pem(believed))
        signing, sealing = Ed25519PrivateKey.generate(), X25519PrivateKey.generate()
        save_key(path / "signing.key", signing)
        save_key(path / "sealing.key", sealing)
        keys = certificates.Keys(name, role, signing.public_key(), sealing.public_key(), tuple(addresses))
        write_atomic(path / "request.pem", certificates.request(keys, signing))
        content = {"format": _FORMAT, "name": name, "role": str(role), "addresses": list(addresses)}
        # The last, as a folder with it is a home: what was interrupted is begun anew.
        write_atomic(path / "node.json", (json.dumps(content, indent=1) + "\n").encode())
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> Home:
        """Read the folder.

        Raises:
            KeysError: no home, or a damaged one; the message names the remedy.
        """
        return cls(Path(path))

    @property
    def bundle(self) -> Bundle:
        """What the authority gave.

        Raises:
            NotIssued: nothing yet.
        """
        if self._bundle is None:
            raise NotIssued(
                f"{self.name} has no certificate yet; carry {self.path / 'request.pem'} to the authority "
                f"(tutelage keys issue), and its answer here (tutelage keys renew {self.path} --bundle FILE)"
            )
        return self._bundle

    @property
    def member(self) -> Member:
        """This node, as others see it when they verify its credential.

        Raises:
            NotIssued: no certificate yet.
        """
        self.bundle  # noqa: B018 - raises
        assert self._member is not None
        return self._member

    @property
    def pseudonym(self) -> str:
        """32 hexadecimal digits: the common name of the certificate."""
        return self.member.pseudonym

    @property
    def expires(self) -> float:
        """When the certificate expires, seconds since 1970."""
        return self.member.not_after

    @property
    def access(self) -> Access:
        """What this node may do.

        Raises:
            NotIssued: no bundle yet.
        """
        return self.bundle.access

    @property
    def trust(self) -> Trust:
        """Whom this node believes.

        Raises:
            NotIssued: no root yet.
        """
        if self._trust is None:
            self.bundle  # noqa: B018 - raises
        assert self._trust is not None
        return self._trust

    @property
    def credential(self) -> bytes:
        """What this node shows to others, only ever sealed: certificate, issuer, membership (name and pseudonym)."""
        return self.bundle.credential

    @property
    def leaf_file(self) -> Path:
        """PEM: certificate and its issuer's, for TLS."""
        return self.path / "leaf.pem"

    @property
    def key_file(self) -> Path:
        """PEM: the private key of the certificate, for TLS."""
        return self.path / "signing.key"

    @property
    def root_file(self) -> Path:
        """PEM: the root certificate, for TLS."""
        return self.path / "root.pem"

    @property
    def deny_notice(self) -> bytes | None:
        """The newest deny list as signed bytes, to pass on to others; None if there never was one."""
        return self._deny

    def check(self, now: float | None = None) -> None:
        """Is the certificate there and valid?

        Raises:
            NotIssued: the message names the node and the remedy.
        """
        member, now = self.member, time.time() if now is None else now
        renew = f"renew it: tutelage keys renew {self.path}"
        if member.pseudonym in self.trust.deny_list.pseudonyms:
            raise NotIssued(
                f"{self.name} is revoked; make a new home and have it issued by the authority of {self.access.fleet}"
            )
        if member.authority in self.trust.deny_list.authorities:
            raise NotIssued(f"the certificate of {self.name} is by an authority that was revoked; {renew}")
        if now > member.not_after:
            raise NotIssued(f"the certificate of {self.name} expired {_span(now - member.not_after)} ago; {renew}")
        if now < member.not_before:
            raise NotIssued(
                f"the certificate of {self.name} begins in {_span(member.not_before - now)}; set this machine's clock"
            )

    def request(self) -> bytes:
        """A request for a (new) certificate, signed with this node's key; `Authority.issue` or `.renew` answers it."""
        public = certificates.Keys(
            self.name, self.role, self.signing_key.public_key(), self.sealing_key.public_key(), self.addresses
        )
        return certificates.request(public, self.signing_key)

    def accept(self, notice: bytes) -> Literal["bundle", "deny"]:
        """Take what the authority sent, by file or over any channel: a bundle (renewal, policy) or a deny list.

        A bundle or list that this node has already is fine.

        Raises:
            Refused: WRONG_AUTHORITY, ROLLBACK, NOT_FOR_US, MALFORMED, EXPIRED, REVOKED; nothing is changed.
        """
        with self._lock, self._files:
            self.refresh()
            if not is_bundle(notice):
                self._accept_deny_list(notice)
                self.refresh()
                return "deny"
            bundle, trust, member = Bundle.open(notice, self.sealing_key, self._trust)
            if member.node != self.name or member.role != self.role:
                raise Refused(Reason.NOT_FOR_US, f"a bundle of the {member.role} {member.node}, and this is {self.name}")
            order = trust.since(bundle.authority), bundle.access.serial, member.not_before
            if self._bundle is not None and order < self._order:
                held = self._bundle.access.serial
                raise Refused(
                    Reason.ROLLBACK,
                    f"a bundle with policy {bundle.access.serial}, and {self.name} has {held} or a newer leaf",
                )
            self._trust = trust
            if bundle.deny and trust.read_deny_list(bundle.deny).order > trust.deny_list.order:
                self._accept_deny_list(bundle.deny)
            write_atomic(self.path / "bundle", notice, private=True)
            self.refresh()
            return "bundle"

    def refresh(self) -> bool:
        """Read again what changed on disk. True if something did. Cheap otherwise: looks at the times of two files.

        Raises:
            KeysError: what is there cannot be believed; the previous state stays in force.
        """
        with self._lock:
            seen = tuple(_stamp(self.path / name) for name in ("deny", "bundle"))
            if seen == self._seen:
                return False
            self._seen = seen
            try:
                self._read()
            except (Refused, OSError) as error:
                what = f"cannot read {error.filename}: {error.strerror}" if isinstance(error, OSError) else error
                raise KeysError(
                    f"{self.path} holds a file of {self.name} that cannot be believed: {what}; remove its files bundle and "
                    f"deny, and have it issued again (tutelage keys issue)"
                ) from None
            self.version += 1
            return True

    def _read(self) -> None:
        trust = self._trust
        if trust is None and self.root_file.exists():
            trust = Trust(_read_root(self.root_file))
        bundle = self.path / "bundle"
        if bundle.exists():
            # Not dated: a certificate that expired while the node was off must still be read, to be renewed.
            opened, trust, member = Bundle.open(bundle.read_bytes(), self.sealing_key, trust, dated=False)
            self._bundle, self._member = opened, member
            self._order = trust.since(opened.authority), opened.access.serial, member.not_before
            leaf = certificates.pem(certificates.load(opened.leaf), certificates.load(opened.authority))
            self._write_if_other(self.leaf_file, leaf)
            self._write_if_other(self.root_file, certificates.pem(trust.root))
        deny = self.path / "deny"
        if trust is not None and deny.exists():
            notice = deny.read_bytes()
            trust.deny_list, self._deny = trust.read_deny_list(notice, dated=False), notice
        self._trust = trust

    def _write_if_other(self, path: Path, content: bytes) -> None:
        with self._files:
            if not path.exists() or path.read_bytes() != content:
                write_atomic(path, content)

    def _accept_deny_list(self, notice: bytes) -> None:
        new, old = self.trust.read_deny_list(notice), self.trust.deny_list
        if new.order < old.order:
            raise Refused(Reason.ROLLBACK, f"deny list {new.serial}, older than the {old.serial} of {self.name}")
        if new.order > old.order:
            write_atomic(self.path / "deny", notice)


def _read_root(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except FileNotFoundError:
        raise KeysError(f"no root certificate {path}") from None
    except (OSError, ValueError) as error:
        raise KeysError(f"{path} is not a certificate: {error}") from None


def _stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ino, status.st_size


def _span(seconds: float) -> str:
    for unit, name in ((86400.0, "days"), (3600.0, "hours"), (60.0, "minutes")):
        if seconds >= 2 * unit:
            return f"{seconds / unit:.0f} {name}"
    return f"{seconds:.0f} seconds"
