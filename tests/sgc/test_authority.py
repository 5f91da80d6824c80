"""The fleet's authority: whom it certifies, what it signs, and what it refuses to sign."""

from __future__ import annotations

import base64
import errno
import shutil
import stat
import threading
import time
import types
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from members import POLICY, Fleet

from tutelage.errors import ConfigError
from tutelage.files import write_atomic
from tutelage.sgc import authority as authority_module
from tutelage.sgc import certificates
from tutelage.sgc.authority import Authority
from tutelage.sgc.bundle import Bundle
from tutelage.sgc.errors import KeysError, NotIssued
from tutelage.sgc.home import Home
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Role


@pytest.fixture
def fleet(tmp_path) -> Fleet:
    return Fleet(tmp_path, ["drone-1", "server"], share=False)


def test_secrets_are_for_the_owner_only(fleet: Fleet) -> None:
    path = fleet.authority.path
    assert stat.S_IMODE(path.stat().st_mode) == 0o700
    for name in ("root/root.key", "ca.key", "names.secret", "state.json"):
        assert stat.S_IMODE((path / name).stat().st_mode) == 0o600, name


def test_the_root_key_can_be_taken_away_and_nothing_but_the_authoritys_own_renewal_needs_it(fleet: Fleet) -> None:
    (fleet.authority.path / "root" / "root.key").unlink()
    authority = Authority.open(fleet.authority.path)
    home = fleet.homes["drone-1"]
    home.accept(authority.renew(home.request()))
    authority.publish()
    authority.revoke("server")
    with pytest.raises(KeysError, match="no root key .*; bring the medium that holds it"):
        authority.renew_own()


def test_a_root_key_with_a_passphrase_needs_it(tmp_path) -> None:
    authority = Authority.create(tmp_path / "a", "acme", passphrase=b"correct horse")
    assert b"ENCRYPTED" in (tmp_path / "a" / "root" / "root.key").read_bytes()
    for wrong in (None, b"battery staple"):
        with pytest.raises(KeysError, match="cannot read the root key"):
            authority.renew_own(passphrase=wrong)
    authority.renew_own(passphrase=b"correct horse")


def test_a_renewed_authority_is_believed_beside_the_old_one(fleet: Fleet) -> None:
    drone, server = fleet.homes["drone-1"], fleet.homes["server"]
    fleet.authority.renew_own()
    drone.accept(fleet.authority.renew(drone.request()))
    assert server.trust.verify(drone.credential).node == "drone-1"
    assert drone.trust.verify(server.credential).node == "server"  # still under the old certificate


def test_a_stolen_authority_is_replaced_by_the_root_and_the_thief_loses_the_last_word(fleet: Fleet, tmp_path) -> None:
    shutil.copytree(fleet.authority.path, tmp_path / "loot", ignore=shutil.ignore_patterns("root"))
    thief = Authority.open(tmp_path / "loot")
    drone, server = fleet.homes["drone-1"], fleet.homes["server"]
    impostor = Home.create(tmp_path / "impostor", "server-2")
    impostor.accept(thief.issue(impostor.request()))
    assert server.trust.verify(impostor.credential).node == "server-2"
    for _ in range(5):  # the thief's deny lists and policies have the higher serials
        thief.publish()
        member = Home.create(tmp_path / f"m{_}", f"m{_}")
        thief.issue(member.request())
        server.accept(thief.revoke(member.name))
    time.sleep(1.0)  # certificates begin at whole seconds
    fleet.authority.renew_own(revoke_old=True)
    outbox = fleet.authority.path / "outbox"
    for home in (drone, server):
        home.accept((outbox / "deny").read_bytes())
        with pytest.raises(NotIssued, match="is by an authority that was revoked; renew it"):
            home.check()
        home.accept((outbox / f"{home.name}.bundle").read_bytes())
        home.check()
    assert drone.trust.verify(server.credential).node == "server"
    for refused, notice in ((impostor.credential, server.trust.verify), (thief.revoke("drone-1"), server.accept),
                            (thief.publish()["server"], server.accept)):  # fmt: skip
        with pytest.raises(Refused) as raised:
            notice(refused)
        assert raised.value.reason == Reason.REVOKED


def test_another_fleets_root_cannot_renew_an_authority(fleet: Fleet, tmp_path) -> None:
    other = Authority.create(tmp_path / "other", "acme")
    with pytest.raises(KeysError, match="is not the root key of acme"):
        fleet.authority.renew_own(other.path / "root" / "root.key")


def test_a_name_belongs_to_the_keys_that_had_it_first(fleet: Fleet, tmp_path) -> None:
    impostor = Home.create(tmp_path / "impostor", "drone-1")
    with pytest.raises(KeysError, match="drone-1 has other keys already; if the node lost them, revoke it first"):
        fleet.authority.issue(impostor.request())
    with pytest.raises(Refused, match="drone-1 with these keys is no member") as raised:
        fleet.authority.renew(impostor.request())
    assert raised.value.reason == Reason.NOT_ALLOWED


def test_only_members_are_renewed(fleet: Fleet, tmp_path) -> None:
    with pytest.raises(Refused, match="drone-7 with these keys is no member"):
        fleet.authority.renew(Home.create(tmp_path / "d", "drone-7").request())


def test_the_revoked_are_neither_renewed_nor_let_in_again_with_the_same_keys(fleet: Fleet, tmp_path) -> None:
    home = fleet.homes["drone-1"]
    old = home.pseudonym
    fleet.authority.revoke("drone-1")
    with pytest.raises(Refused, match="is no member"):
        fleet.authority.renew(home.request())
    with pytest.raises(KeysError, match="these keys were revoked with drone-1; make a new home"):
        fleet.authority.issue(home.request())
    again = Home.create(tmp_path / "new", "drone-1")
    again.accept(fleet.authority.issue(again.request()))
    assert again.pseudonym != old
    again.check()


def test_who_is_revoked_must_be_a_member(fleet: Fleet) -> None:
    with pytest.raises(KeysError, match="acme has no member 'drone-9'; members: drone-1, server"):
        fleet.authority.revoke("drone-9")


def test_a_router_cannot_claim_other_addresses_by_renewing(fleet: Fleet) -> None:
    router = fleet.join("router-1", Role.ROUTER)
    greedy = Home.open(router.path)
    greedy.addresses = ("198.51.100.1",)
    router.accept(fleet.authority.renew(greedy.request()))
    assert b"198.51.100.1" not in router.leaf_file.read_bytes()
    assert fleet.authority.roster.members["router-1"].keys.addresses == ("127.0.0.1",)


def test_a_policy_with_a_fault_changes_nothing(fleet: Fleet) -> None:
    serial, file = fleet.authority.roster.serial, fleet.authority.path / "policy.toml"
    file.write_text(POLICY + "\n[topics.bad]\n")
    with pytest.raises(ConfigError, match="topic 'bad' of the policy lacks"):
        fleet.authority.publish()
    home = fleet.homes["drone-1"]
    home.accept(fleet.authority.renew(home.request()))
    assert set(home.access.topics) == {"camera", "teleop", "lidar", "grasp"}
    assert fleet.authority.roster.serial == serial


def test_a_policy_counts_only_when_it_was_published(fleet: Fleet) -> None:
    home = fleet.homes["drone-1"]
    (fleet.authority.path / "policy.toml").write_text("version = 1\n")
    home.accept(fleet.authority.renew(home.request()))
    assert home.access.topics
    home.accept(fleet.authority.publish()["drone-1"])
    assert not home.access.topics


def test_routers_hear_of_new_and_revoked_members(fleet: Fleet) -> None:
    router = fleet.join("router-1", Role.ROUTER)
    outbox = fleet.authority.path / "outbox" / "router-1.bundle"
    drone = fleet.join("drone-5")
    router.accept(outbox.read_bytes())
    assert drone.pseudonym in router.access.members
    fleet.authority.revoke("drone-5")
    router.accept(outbox.read_bytes())
    assert drone.pseudonym not in router.access.members
    assert drone.pseudonym in router.trust.deny_list.pseudonyms


def files(fleet: Fleet) -> dict[str, bytes]:
    """All that the authority keeps."""
    return {str(file): file.read_bytes() for file in fleet.authority.path.rglob("*") if file.is_file()}


@pytest.mark.parametrize("what", ["publish", "issue", "revoke", "renew_own"])
def test_what_is_interrupted_has_changed_nothing(fleet: Fleet, what: str, monkeypatch) -> None:
    """Ctrl-C between two bundles: no certificate may exist that the list of members does not know, no policy be half signed."""
    fleet.join("router-1", Role.ROUTER)
    request = Home.create(fleet.path / "drone-7", "drone-7").request()
    (fleet.authority.path / "policy.toml").write_text(POLICY + "\n# changed\n")
    before, seal = files(fleet), Bundle.seal
    left = ["one bundle"] * (what in ("publish", "renew_own"))

    def interrupted(bundle, to, key):
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return seal(bundle, to, key)

    monkeypatch.setattr(Bundle, "seal", interrupted)
    calls = {
        "publish": fleet.authority.publish,
        "issue": lambda: fleet.authority.issue(request),
        "revoke": lambda: fleet.authority.revoke("server"),
        "renew_own": lambda: fleet.authority.renew_own(revoke_old=True),
    }
    with pytest.raises(KeyboardInterrupt):
        calls[what]()
    assert files(fleet) == before
    assert fleet.authority.unsigned
    monkeypatch.undo()
    calls[what]()
    server = fleet.homes["server"]
    if what == "issue":
        drone = Home.open(fleet.path / "drone-7")
        drone.accept((fleet.authority.path / "outbox" / "drone-7.bundle").read_bytes())
        assert server.trust.verify(drone.credential).pseudonym == fleet.authority.roster.members["drone-7"].pseudonym
    elif what != "revoke":
        server.accept((fleet.authority.path / "outbox" / "server.bundle").read_bytes())


def test_an_interrupted_renewal_of_the_authority_is_done_again(fleet: Fleet, monkeypatch) -> None:
    def full(path, content, *, private=False):
        if path.name == "ca.pem":
            raise KeyboardInterrupt
        write_atomic(path, content, private=private)

    monkeypatch.setattr(authority_module, "write_atomic", full)
    with pytest.raises(KeyboardInterrupt):
        fleet.authority.renew_own(revoke_old=True)
    monkeypatch.undo()
    authority, drone = Authority.open(fleet.authority.path), fleet.homes["drone-1"]
    with pytest.raises(KeysError, match=r"was interrupted; do it again: tutelage keys renew \S+$"):
        authority.renew(drone.request())
    authority.renew_own(revoke_old=True)
    drone.accept((fleet.authority.path / "outbox" / "drone-1.bundle").read_bytes())
    assert stat.S_IMODE((fleet.authority.path / "ca.key").stat().st_mode) == 0o600


def test_whoever_serves_renewals_follows_a_new_key_of_the_authority(fleet: Fleet) -> None:
    serving, drone = Authority.open(fleet.authority.path), fleet.homes["drone-1"]
    fleet.authority.renew_own(revoke_old=True)
    serving.refresh()
    drone.accept(serving.renew(drone.request()))
    drone.check()


def test_all_are_revoked_or_nobody(fleet: Fleet) -> None:
    with pytest.raises(KeysError, match="no member 'nobody'; members: drone-1, server"):
        fleet.authority.revoke("server", "nobody")
    assert fleet.authority.roster.deny_serial == 0
    fleet.authority.revoke("server", "server")
    with pytest.raises(KeysError, match="has revoked 'server' already; members: drone-1"):
        fleet.authority.revoke("server")


def test_hours_that_cannot_be_sign_no_policy(tmp_path) -> None:
    authority = Authority.create(tmp_path / "a", "acme")
    (tmp_path / "a" / "policy.toml").write_text(POLICY)
    with pytest.raises(KeysError, match="not nan"):
        authority.publish(hours=float("nan"))
    assert authority.unsigned


def test_a_request_with_an_impossible_key_is_refused(fleet: Fleet, tmp_path) -> None:
    signing = Ed25519PrivateKey.generate()
    sealing = types.SimpleNamespace(public_bytes_raw=lambda: bytes(32))
    request = certificates.request(certificates.Keys("drone-9", Role.NODE, signing.public_key(), sealing), signing)
    with pytest.raises(Refused, match="not a signing request"):
        fleet.authority.issue(request)


def test_folders_of_nodes_and_of_authorities_are_not_mixed(fleet: Fleet, tmp_path) -> None:
    with pytest.raises(KeysError, match="holds the authority of a fleet already; choose another folder"):
        Home.create(fleet.authority.path, "drone-8")
    with pytest.raises(KeysError, match="is the home of a node already; choose another folder"):
        Authority.create(fleet.homes["server"].path, "other")
    (tmp_path / "file").write_text("")
    for create in (Home.create, Authority.create):
        with pytest.raises(KeysError, match=r"cannot make the folder \S+file/a: Not a directory; choose another"):
            create(tmp_path / "file" / "a", "x")


def test_the_outbox_holds_what_must_be_carried(fleet: Fleet) -> None:
    fleet.authority.publish()
    fleet.authority.revoke("server")
    outbox = {file.name: file.read_bytes() for file in (fleet.authority.path / "outbox").iterdir()}
    assert set(outbox) == {"drone-1.bundle", "deny"}
    fleet.homes["drone-1"].accept(outbox["drone-1.bundle"])
    fleet.homes["drone-1"].accept(outbox["deny"])
    assert fleet.homes["drone-1"].trust.deny_list.serial == 1


def test_the_validity_of_a_certificate_is_chosen(fleet: Fleet) -> None:
    home = fleet.join("drone-3", hours=2)
    assert home.expires - time.time() == pytest.approx(7200, abs=60)
    for hours in (0.0, -1.0, 1e9, float("nan")):
        with pytest.raises(KeysError, match="a certificate is for more than 0"):
            fleet.authority.issue(home.request(), hours=hours)


def test_two_processes_do_not_lose_each_others_changes(fleet: Fleet) -> None:
    homes = [Home.create(fleet.path / f"arm-{k}", f"arm-{k}") for k in range(6)]
    authorities = [Authority.open(fleet.authority.path) for _ in homes]
    threads = [
        threading.Thread(target=authority.issue, args=(home.request(),))
        for authority, home in zip(authorities, homes, strict=True)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {home.name for home in homes} <= set(Authority.open(fleet.authority.path).roster.members)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200))
def test_bytes_that_are_no_request_are_refused(fleet: Fleet, data: bytes) -> None:
    with pytest.raises(Refused) as raised:
        fleet.authority.issue(data)
    assert raised.value.reason == Reason.MALFORMED


def test_a_request_that_was_changed_is_refused(fleet: Fleet) -> None:
    lines = fleet.homes["drone-1"].request().decode().splitlines()
    content = bytearray(base64.b64decode("".join(lines[1:-1])))
    for at in range(len(content)):
        changed = bytearray(content)
        changed[at] ^= 1
        pem = b"\n".join([lines[0].encode(), base64.b64encode(bytes(changed)), lines[-1].encode()])
        try:
            bundle = fleet.authority.renew(pem)
        except Refused as refused:
            assert refused.reason in (Reason.MALFORMED, Reason.FORGED, Reason.NOT_ALLOWED)
        else:  # the number of unused bits of the signature, which means nothing
            assert content[at] == 0
            fleet.homes["drone-1"].accept(bundle)


@pytest.mark.parametrize("name", ["ca.key", "names.secret", "state.json", "root.pem"])
def test_a_folder_that_cannot_be_read_is_one_line(fleet: Fleet, name: str) -> None:
    (fleet.authority.path / name).write_bytes(b"?")
    with pytest.raises(KeysError, match="is damaged") as raised:
        Authority.open(fleet.authority.path)
    assert "\n" not in str(raised.value)
    (fleet.authority.path / name).unlink()
    with pytest.raises(KeysError, match=f"is no fleet's authority \\(no {name}\\)"):
        Authority.open(fleet.authority.path)


def test_an_authority_is_not_overwritten(fleet: Fleet) -> None:
    with pytest.raises(KeysError, match="holds the authority of a fleet already"):
        Authority.create(fleet.authority.path, "acme")
    with pytest.raises(KeysError, match="a fleet's name is 1 to 63 letters"):
        Authority.create(fleet.path / "x", "a/b")


def test_a_folder_that_nobody_may_look_into_is_named_and_not_made_anew(fleet: Fleet, monkeypatch) -> None:
    def refused(path, **named):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "exists", refused)
    for create in (Home.create, Authority.create):
        with pytest.raises(KeysError, match="cannot look into .*server: Permission denied; is it yours"):
            create(fleet.homes["server"].path, "x")


def test_a_policy_that_cannot_be_read_is_named(fleet: Fleet, monkeypatch) -> None:
    def refused(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refused)
    with pytest.raises(KeysError, match=r"cannot read .*/policy.toml: Permission denied$"):
        assert fleet.authority.unsigned
