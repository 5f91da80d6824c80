"""Keys of a fleet: init, issue, renew, revoke, show, serve."""

from __future__ import annotations

import datetime
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tutelage.errors import ConfigError, MissingExtraError

if TYPE_CHECKING:
    from tutelage.sgc.authority import Authority
    from tutelage.sgc.home import Home

try:
    import cryptography  # noqa: F401
except ImportError:
    _MISSING: MissingExtraError | None = MissingExtraError("cryptography", "sgc")
else:
    _MISSING = None


def init(
    folder: Positional[Path],
    fleet: str | None = None,
    node: str | None = None,
    router: str | None = None,
    address: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    root: Path | None = None,
    passphrase_file: Path | None = None,
) -> None:
    """Make the folder of a fleet's authority, or of a node or router with keys of its own. One of the three names.

    Args:
        folder: where.
        fleet: name of a new fleet: makes its root, its authority and a policy to fill in. This, node or router is needed.
        node: name of a node: makes its keys and a signing request.
        router: name of a router, likewise.
        address: IP addresses and host names at which others reach the router, which needs one at least; a node has none.
        connect: routers that the node dials, such as tls/192.0.2.7:7447, for its network.toml; without it, write that file.
        root: root.pem of the fleet; the node then believes no other. Without it, it believes the root of its first bundle.
        passphrase_file: its content encrypts the root's key; without it, the key lies there in clear.
    """
    _need()
    from tutelage.sgc.rules import Role

    given = [name for name, value in (("fleet", fleet), ("node", node), ("router", router)) if value is not None]
    if len(given) != 1:
        raise ConfigError("name one of --fleet, --node and --router: what is the folder for?")
    if fleet is not None:
        _init_fleet(folder, fleet, passphrase_file)
        return
    from tutelage.sgc.home import Home
    from tutelage.sgc.transport.config import Endpoint, NetworkConfig

    routers = tuple(map(Endpoint.parse, connect))
    role, name = (Role.NODE, node) if node is not None else (Role.ROUTER, router)
    home = Home.create(folder, str(name), role=role, addresses=address, root=root)
    if routers:
        NetworkConfig(routers).save(folder)
    _say(f"{home.name} has keys of its own in {folder}; carry {folder / 'request.pem'} to the authority, where:")
    _say("    tutelage keys issue FLEET request.pem")
    _say(f"fingerprint of the request: {_fingerprint(home.request())}")


def issue(
    authority: Positional[Path],
    requests: Positional[tuple[Path, ...]] = (),
    policy: bool = False,
    hours: float = 24.0,
) -> None:
    """Sign certificates for signing requests, or the policy for everybody; the answers are in the authority's outbox.

    Args:
        authority: folder of the fleet's authority.
        requests: signing requests of nodes and routers; of a node's folder on this machine, the answer is put there at once.
            Without one, only the policy is signed, with --policy.
        policy: sign policy.toml as it now is: a new bundle for every member.
        hours: validity of the certificates.
    """
    from tutelage.sgc.reasons import Refused

    fleet = _authority(authority)
    if not requests and not policy:
        raise ConfigError("name signing requests (tutelage keys init --node NAME makes them), or --policy")
    pems = [_request(each) for each in requests]  # all of them first: one that is damaged stops the others, too
    names = [_name_of(pem) for pem in pems]
    if policy:
        bundles = fleet.publish(hours=hours)
        _say(f"policy {fleet.roster.serial} of {fleet.fleet} is signed; {len(bundles)} bundles in {authority / 'outbox'}")
        if bundles and not requests:
            _say("nodes fetch them within a minute if tutelage keys serve runs; else carry each to its node or router:")
            _say(f"    tutelage keys renew HOME --bundle {authority / 'outbox'}/NAME.bundle")
    elif fleet.unsigned:
        _say(f"{authority / 'policy.toml'} has changed since it was signed, and holds for nobody yet; add --policy")
    for pem in pems:
        fleet.issue(pem, hours=hours)
    for request, name in zip(requests, names, strict=True):  # only now: bundles of routers name all new nodes
        bundle = authority / "outbox" / f"{name}.bundle"
        if request.is_dir():
            try:
                _home(request).accept(bundle.read_bytes())
            except Refused as refused:
                raise ConfigError(f"{request} does not take {bundle}, the certificate of {name}: {refused}") from None
            _say(f"{name}: certificate for {hours:g} hours, installed in {request}")
        else:
            _say(f"{name}: certificate for {hours:g} hours in {bundle}; on the node:")
            _say(f"    tutelage keys renew HOME --bundle {name}.bundle")
    if policy and (strangers := fleet.strangers()):
        _say(f"the policy names {', '.join(strangers)}, no members of {fleet.fleet} yet")
    for name in sorted(set(fleet.routers) - set(names)) if requests else ():
        _say(f"{name}: the router must hear of them: tutelage keys renew HOME --bundle {authority / 'outbox' / name}.bundle")


def renew(
    home: Positional[Path],
    bundle: Path | None = None,
    authority: Path | None = None,
    hours: float = 24.0,
    root_key: Path | None = None,
    passphrase_file: Path | None = None,
    revoke_old: bool = False,
) -> None:
    """A new certificate for a node, while it runs: by a file, from an authority on this machine, or over the network.

    Args:
        home: the node's folder; of an authority: a new key and certificate for itself, signed by the root.
        bundle: what the authority gave: a bundle or a deny list; without it and --authority, it is asked for on the network.
        authority: folder of the fleet's authority on this machine, which signs at once.
        hours: validity, with --authority.
        root_key: for an authority: where the root's key is; without it, root/root.key in its folder.
        passphrase_file: for an authority: the passphrase of the root's key; without it, the key is in clear.
        revoke_old: for an authority whose key was stolen: refuse all that it signed; all nodes need their new bundles.
    """
    _need()
    from tutelage.sgc.privatekeys import holds

    if holds(home, "state.json"):
        fleet = _authority(home)
        if bundle is not None or authority is not None:
            raise ConfigError(f"{home} is the folder of an authority; --bundle and --authority are for a node's")
        fleet.renew_own(root_key, _passphrase(passphrase_file), revoke_old=revoke_old)
        _say(f"the authority of {fleet.fleet} has a new key, valid until {_when(fleet.certificate.not_valid_after_utc)}")
        if revoke_old:
            _say(f"what the old key signed is refused; carry the bundles in {home / 'outbox'} to all nodes and routers")
        return
    from tutelage.sgc.reasons import Reason, Refused

    node = _home(home)
    if root_key is not None or passphrase_file is not None or revoke_old:
        raise ConfigError(
            f"{home} is the folder of {node.name}; --root-key, --passphrase-file, --revoke-old: an authority's"
        )
    if bundle is not None:
        try:
            what = node.accept(_read(bundle))
        except Refused as refused:
            if refused.reason == Reason.MALFORMED:
                raise ConfigError(f"{bundle} is neither a bundle nor a deny list, or is damaged: {refused}") from None
            needs = f"it needs the newest outbox/{node.name}.bundle (or deny) of its own fleet's authority"
            raise ConfigError(f"{node.name} does not take {bundle}: {refused}; {needs}") from None
        if what == "deny":
            _say(
                f"{node.name} knows deny list {node.trust.deny_list.serial}: {len(node.trust.deny_list.pseudonyms)} revoked"
            )
            return
    elif authority is not None:
        node.accept(_authority(authority).renew(node.request(), hours=hours))
    else:
        _renew_by_network(node)
    _say(f"{node.name} has a certificate until {_when(node.expires)} and policy {node.access.serial} of {node.access.fleet}")


def revoke(authority: Positional[Path], nodes: Positional[tuple[str, ...]]) -> None:
    """Put nodes or routers on the deny list: their certificates are refused, and owners change the keys of their topics.

    Args:
        authority: folder of the fleet's authority.
        nodes: names.
    """
    fleet = _authority(authority)
    if not nodes:
        raise ConfigError("name at least one node")
    fleet.revoke(*nodes)
    _say(f"deny list {fleet.roster.deny_serial} of {fleet.fleet}: {', '.join(nodes)} revoked; routers have new bundles too")
    _say(f"it reaches running nodes by itself if tutelage keys serve runs; else carry {authority / 'outbox' / 'deny'}, and:")
    _say("    tutelage keys renew HOME --bundle deny")


def show(what: Positional[Path]) -> None:
    """What a folder or signing request is: names, fingerprints, validity, topics. Never a secret.

    Args:
        what: a node's folder, an authority's, or a signing request.
    """
    _need()
    from tutelage.sgc.privatekeys import holds

    if what.is_file():
        pem = _request(what)
        _say(f"signing request of {_name_of(pem)}, fingerprint {_fingerprint(pem)}")
    elif holds(what, "state.json"):
        _show_authority(_authority(what))
    else:
        _show_home(_home(what))


def serve(authority: Positional[Path], home: Positional[Path], hours: float = 24.0) -> None:
    """Renew certificates, and hand out changes of the policy and the deny list, over the network, until Ctrl-C.

    Args:
        authority: folder of the fleet's authority.
        home: folder of the node that answers; the policy names it as `renewals`.
        hours: validity of the certificates.
    """
    fleet, node_home = _authority(authority), _home(home)
    from tutelage.sgc import lanes
    from tutelage.sgc.commands.stopping import until_stopped
    from tutelage.sgc.node import Node
    from tutelage.sgc.office import Office

    renewals = node_home.access.renewals
    if renewals is None or renewals.pseudonym != node_home.pseudonym:
        raise ConfigError(
            f'the policy does not let {node_home.name} renew certificates; write renewals = "{node_home.name}" at its top, '
            f"then: tutelage keys issue {authority} --policy"
        )
    office = Office(fleet, node_home, hours=hours)
    with until_stopped() as stop, Node.open(node_home) as node:
        node.transport.serve(lanes.key(node.access.control, lanes.RENEW), office.answer)
        _say(f"{node.name} renews certificates of {fleet.fleet}; Ctrl-C ends it")
        stop.wait()


VERBS = {"init": init, "issue": issue, "renew": renew, "revoke": revoke, "show": show, "serve": serve}


def _init_fleet(folder: Path, fleet: str, passphrase_file: Path | None) -> None:
    from tutelage.sgc.authority import Authority
    from tutelage.sgc.trust import fingerprint

    made = Authority.create(folder, fleet, passphrase=_passphrase(passphrase_file))
    _say(f"{fleet} has a root and an authority in {folder}; fingerprint of the root: {fingerprint(made.root)}")
    _say(
        f"1. move {folder / 'root'} to a place that is offline; it is needed again in a year (tutelage keys renew {folder})"
    )
    _say(f"2. write {folder / 'policy.toml'}, then: tutelage keys issue {folder} --policy")
    _say(f"3. on each node: tutelage keys init HOME --node NAME; carry its request here: tutelage keys issue {folder} FILE")


def _renew_by_network(home: Home) -> None:
    from tutelage.sgc.renewal import ANSWER_SECONDS, Renewer
    from tutelage.sgc.transport.base import NoReply
    from tutelage.sgc.transport.config import Identity, NetworkConfig
    from tutelage.sgc.transport.zenoh import ZenohTransport

    if home.expires < time.time():
        raise ConfigError(
            f"the certificate of {home.name} has expired, so nobody on the network believes it: use --bundle, with what "
            f"tutelage keys issue gives, or --authority"
        )
    home.check()
    if home.access.renewals is None:
        raise ConfigError(
            f"the policy of {home.access.fleet} names no node for renewals; use --bundle or --authority, or see keys serve"
        )
    identity = Identity(home.root_file, home.leaf_file, home.key_file)
    with ZenohTransport(NetworkConfig.load(home.path), identity) as transport:
        until = time.monotonic() + ANSWER_SECONDS
        while not transport.connected and time.monotonic() < until:
            time.sleep(0.02)
        if not transport.connected:
            raise NoReply(f"{home.name} reaches no router of its network.toml")
        if not Renewer(home, transport.request, due=lambda _: True).once():
            raise NoReply(f"nobody renewed the certificate of {home.name}; does tutelage keys serve run?")


def _show_home(home: Home) -> None:
    from tutelage.sgc.errors import NotIssued
    from tutelage.sgc.keyring import Keyring
    from tutelage.sgc.trust import fingerprint

    _say(f"{home.role} {home.name}" + (f", addresses {', '.join(home.addresses)}" if home.addresses else ""))
    _say(f"fingerprint of the request: {_fingerprint(home.request())}")
    try:
        access = home.access
    except NotIssued as error:
        _say(str(error))
        return
    _say(f"fleet {access.fleet}, policy {access.serial}, deny list {home.trust.deny_list.serial}")
    _say(f"root {fingerprint(home.trust.root)}")
    _say(f"certificate {home.pseudonym} until {_when(home.expires)}" + (", EXPIRED" if home.expires < time.time() else ""))
    keyring = Keyring(home)
    for alias, entry in sorted(access.topics.items()):
        rule = entry.rule
        lanes = [lane for lane in rule.lanes() if lane != "presence"]
        part = [word for word, may in (("sends", rule.may_send), ("receives", rule.may_receive))
                if any(may(home.name, lane) for lane in lanes)] + ["owns"] * (rule.owner == home.name)  # fmt: skip
        key = keyring.held(alias)
        have = f"key {key}" if key else "no key yet"
        _say(f"{rule.kind} {alias}: {rule.topic.interface} of {rule.topic.node}, {rule.authenticity}, {rule.delivery}; "
             f"{', '.join(part)}; {have}; name {entry.name.hex()}")  # fmt: skip
    for route in access.routes:
        _say(f"{route.kind} {route.name.hex()}: {len(route.send)} send, {len(route.receive)} receive")


def _show_authority(fleet: Authority) -> None:
    from tutelage.sgc.trust import fingerprint

    roster = fleet.roster
    _say(f"authority of {fleet.fleet}, policy {roster.serial}, deny list {roster.deny_serial}")
    _say(f"root {fingerprint(fleet.root)} until {_when(fleet.root.not_valid_after_utc)}")
    _say(f"authority until {_when(fleet.certificate.not_valid_after_utc)}")
    if (fleet.path / "root" / "root.key").exists():
        _say(f"the root's key is still in {fleet.path / 'root'}; keep it offline")
    for name, record in sorted(roster.members.items()):
        expired = ", EXPIRED" if record.expires < time.time() else ""
        _say(f"{record.keys.role} {name}: {record.pseudonym} until {_when(record.expires)}{expired}")
    for old in roster.revoked_authorities:
        _say(f"revoked authority {old}")
    for pseudonym, (name, _) in sorted(roster.revoked.items(), key=lambda one: one[1]):
        _say(f"revoked {name}: {pseudonym}")


def _authority(folder: Path) -> Authority:
    _need()
    from tutelage.sgc.authority import Authority

    return Authority.open(folder)


def _home(folder: Path) -> Home:
    _need()
    from tutelage.sgc.home import Home

    return Home.open(folder)


def _need() -> None:
    if _MISSING is not None:
        raise _MISSING


def _request(path: Path) -> bytes:
    """A signing request, or that of a node's folder; one that can be read."""
    from tutelage.sgc.reasons import Refused

    file = path / "request.pem" if path.is_dir() else path
    pem = _read(file)
    try:
        _name_of(pem)
    except Refused as refused:
        raise ConfigError(f"{file}: {refused}; a node's is the request.pem of its folder") from None
    return pem


def _name_of(pem: bytes) -> str:
    from tutelage.sgc.certificates import read_request

    return read_request(pem).common_name


def _fingerprint(pem: bytes) -> str:
    """Of the keys in a signing request, which is what people compare: the request itself may be made anew."""
    import hashlib

    from tutelage.sgc.certificates import raw, read_request

    keys = read_request(pem)
    return hashlib.sha256(raw(keys.signing) + raw(keys.sealing)).hexdigest()


def _passphrase(file: Path | None) -> bytes | None:
    if file is None:
        return None
    passphrase = _read(file).rstrip(b"\r\n")
    if not passphrase:
        raise ConfigError(f"{file} is empty, and a passphrase must not be")
    return passphrase


def _read(path: Path) -> bytes:
    try:
        if path.stat().st_size > 64 << 20:
            raise ConfigError(f"{path} is too large to be what was asked for")
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {os.strerror(error.errno or 0)}") from None


def _when(time_: float | datetime.datetime) -> str:
    at = time_ if isinstance(time_, datetime.datetime) else datetime.datetime.fromtimestamp(time_, datetime.UTC)
    return at.strftime("%Y-%m-%d %H:%M UTC")


def _say(line: str) -> None:
    print(line, flush=True)
