"""A node's folder: what it holds, what it accepts, and that it follows renewals while the node runs."""

from __future__ import annotations

import json
import os
import stat
import time

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from members import POLICY, Fleet

from tutelage.files import write_atomic
from tutelage.sgc import home as home_module
from tutelage.sgc import trust as trust_module
from tutelage.sgc.bundle import CONTEXT
from tutelage.sgc.certificates import pem, read_request
from tutelage.sgc.envelope import open_sealed, seal_to
from tutelage.sgc.errors import KeysError, NotIssued
from tutelage.sgc.home import Home
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Role


@pytest.fixture
def fleet(tmp_path) -> Fleet:
    return Fleet(tmp_path, ["drone-1", "server"], share=False)


def reason(call, *arguments) -> Reason:
    with pytest.raises(Refused) as raised:
        call(*arguments)
    return raised.value.reason


def test_secrets_are_for_the_owner_only(fleet: Fleet) -> None:
    home = fleet.homes["drone-1"]
    fleet.keyrings["drone-1"].epoch("camera")
    assert stat.S_IMODE(home.path.stat().st_mode) == 0o700
    for name in ("signing.key", "sealing.key", "bundle", "keys/camera.keys"):
        assert stat.S_IMODE((home.path / name).stat().st_mode) == 0o600, name


def test_the_private_key_is_in_nothing_that_leaves_the_node(fleet: Fleet) -> None:
    home = fleet.homes["drone-1"]
    private = [
        key.private_bytes(serialization.Encoding.Raw, serialization.PrivateFormat.Raw, serialization.NoEncryption())
        for key in (home.signing_key, home.sealing_key)
    ]
    outside = [file.read_bytes() for file in (fleet.path / "authority").rglob("*") if file.is_file()]
    for content in [*outside, home.request(), home.credential]:
        assert not any(key in content or key.hex().encode() in content for key in private)


def test_what_is_read_back_is_the_same_node(fleet: Fleet) -> None:
    home, again = fleet.homes["drone-1"], Home.open(fleet.homes["drone-1"].path)
    assert (again.name, again.pseudonym, again.expires) == (home.name, home.pseudonym, home.expires)
    assert again.access == home.access
    again.check()


def test_a_node_without_certificate_says_what_to_do(tmp_path) -> None:
    home = Home.create(tmp_path / "arm", "arm-3")
    for ask in (lambda: home.access, lambda: home.trust, lambda: home.pseudonym, home.check):
        with pytest.raises(NotIssued, match=r"arm-3 has no certificate yet; carry .*request.pem to the authority"):
            ask()


def test_an_expired_certificate_is_named_with_its_remedy(fleet: Fleet) -> None:
    with pytest.raises(NotIssued, match=r"the certificate of drone-1 expired 24 hours ago; renew it: tutelage keys renew"):
        fleet.homes["drone-1"].check(time.time() + 48 * 3600)
    with pytest.raises(NotIssued, match=r"the certificate of drone-1 begins in 23 hours; set this machine's clock"):
        fleet.homes["drone-1"].check(time.time() - 23 * 3600)


def test_a_revoked_node_is_told_so(fleet: Fleet) -> None:
    home = fleet.homes["drone-1"]
    home.accept(fleet.authority.revoke("drone-1"))
    with pytest.raises(NotIssued, match="drone-1 is revoked; make a new home"):
        home.check()


def test_a_node_that_was_off_for_long_can_still_be_renewed(fleet: Fleet, monkeypatch) -> None:
    path, request = fleet.homes["drone-1"].path, fleet.homes["drone-1"].request()
    now = time.time() + 400 * 3600
    monkeypatch.setattr(trust_module.time, "time", lambda: now)
    home = Home.open(path)
    with pytest.raises(NotIssued, match="expired"):
        home.check()
    home.accept(fleet.authority.renew(request))
    home.check()


def test_renewal_while_running_is_picked_up_from_the_files(fleet: Fleet) -> None:
    running = fleet.homes["drone-1"]
    version, leaf = running.version, running.leaf_file.read_bytes()
    assert not running.refresh()
    Home.open(running.path).accept(fleet.authority.renew(running.request(), hours=48))  # another process: keys renew
    assert running.refresh()
    assert running.version == version + 1
    assert running.expires - time.time() > 47 * 3600
    assert running.leaf_file.read_bytes() != leaf
    assert running.pseudonym in x509.load_pem_x509_certificate(running.leaf_file.read_bytes()).subject.rfc4514_string()


def test_the_pseudonym_stays_when_the_certificate_is_renewed(fleet: Fleet) -> None:
    home = fleet.homes["drone-1"]
    before = home.pseudonym
    home.accept(fleet.authority.renew(home.request()))
    assert home.pseudonym == before


def test_an_older_bundle_is_refused(fleet: Fleet) -> None:
    home = fleet.homes["drone-1"]
    old = fleet.authority.renew(home.request())
    fleet.publish(POLICY)
    assert reason(home.accept, old) == Reason.ROLLBACK


def test_an_older_deny_list_is_refused_and_the_same_one_is_fine(fleet: Fleet) -> None:
    fleet.join("drone-2")
    home = fleet.homes["drone-1"]
    old = fleet.authority.revoke("server")
    new = fleet.authority.revoke("drone-2")
    assert home.accept(new) == "deny"
    assert home.accept(new) == "deny"
    assert reason(home.accept, old) == Reason.ROLLBACK
    assert len(home.trust.deny_list.pseudonyms) == 2
    assert Home.open(home.path).trust.deny_list == home.trust.deny_list
    assert home.deny_notice == new


def test_a_bundle_brings_the_deny_list_along(fleet: Fleet) -> None:
    fleet.authority.revoke("server")
    home = fleet.homes["drone-1"]
    home.accept(fleet.authority.renew(home.request()))
    assert home.trust.deny_list.serial == 1


def test_another_nodes_bundle_is_refused(fleet: Fleet) -> None:
    bundle = fleet.authority.renew(fleet.homes["server"].request())
    assert reason(fleet.homes["drone-1"].accept, bundle) == Reason.NOT_FOR_US


def test_a_bundle_that_its_node_seals_anew_for_another_is_refused(fleet: Fleet) -> None:
    giver, taker = fleet.homes["server"], fleet.homes["drone-1"]
    bundle = fleet.authority.renew(giver.request())
    magic = bundle[: bundle.index(b"\n") + 1]
    inside = open_sealed(giver.sealing_key, CONTEXT, bundle[len(magic) :])
    again = magic + seal_to(taker.sealing_key.public_key(), CONTEXT, inside)
    with pytest.raises(Refused, match="a bundle that was sealed to another node first") as raised:
        taker.accept(again)
    assert raised.value.reason == Reason.NOT_FOR_US


def test_another_fleet_cannot_take_a_node_over(fleet: Fleet, tmp_path) -> None:
    home, other = fleet.homes["drone-1"], Fleet(tmp_path / "other", [])
    assert reason(home.accept, other.authority.issue(home.request())) == Reason.WRONG_AUTHORITY
    home.check()


def test_a_root_that_is_given_is_the_only_one_believed(fleet: Fleet, tmp_path) -> None:
    other = Fleet(tmp_path / "other", [])
    root = tmp_path / "root.pem"
    root.write_bytes(pem(fleet.authority.root))
    home = Home.create(tmp_path / "arm", "arm-3", root=root)
    assert reason(home.accept, other.authority.issue(home.request())) == Reason.WRONG_AUTHORITY
    assert home.accept(fleet.authority.issue(home.request())) == "bundle"


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200), st.booleans())
def test_bytes_that_are_no_notice_are_refused(fleet: Fleet, data: bytes, like_a_bundle: bool) -> None:
    home = fleet.homes["drone-1"]
    assert reason(home.accept, b"tutelage bundle 1\n" * like_a_bundle + data) in (Reason.MALFORMED, Reason.NOT_FOR_US)


def test_a_file_that_was_damaged_is_named_and_the_running_node_goes_on(fleet: Fleet) -> None:
    home = fleet.homes["drone-1"]
    bundle = home.path / "bundle"
    content = bundle.read_bytes()
    bundle.write_bytes(content[:-1])
    with pytest.raises(KeysError, match="holds a file of drone-1 that cannot be believed: .*; remove its files bundle and"):
        home.refresh()
    home.check()
    with pytest.raises(KeysError, match="cannot be believed"):
        Home.open(home.path)
    bundle.unlink()
    bundle.mkdir()
    with pytest.raises(KeysError, match="cannot read .*/bundle: Is a directory; remove"):
        Home.open(home.path)
    bundle.rmdir()
    bundle.write_bytes(content)
    assert home.refresh()


def test_a_home_that_was_interrupted_is_made_anew(tmp_path, monkeypatch) -> None:
    """Ctrl-C before the last file: it is no home yet, and nothing is in the way of the next attempt."""

    def interrupted(path, content, *, private=False):
        if path.name == "node.json":
            raise KeyboardInterrupt
        write_atomic(path, content, private=private)

    monkeypatch.setattr(home_module, "write_atomic", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Home.create(tmp_path / "a", "drone-1")
    monkeypatch.undo()
    home = Home.create(tmp_path / "a", "drone-1")
    keys = read_request((tmp_path / "a" / "request.pem").read_bytes())
    assert (keys.common_name, keys.signing) == ("drone-1", home.signing_key.public_key())


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda path: os.remove(path / "node.json"), "is no node's home \\(no node.json\\); make one: tutelage keys init"),
        (lambda path: os.remove(path / "signing.key"), "is no node's home \\(no signing.key\\)"),
        (lambda path: (path / "signing.key").write_bytes((path / "sealing.key").read_bytes()), "a key of another kind"),
        (lambda path: (path / "signing.key").write_text("?"), "is damaged"),
        (lambda path: (path / "node.json").write_text("[]"), "is damaged"),
        (lambda path: (path / "node.json").write_text(json.dumps({"format": 9})), "has format 9"),
    ],
)
def test_a_home_that_cannot_be_read_is_one_line(fleet: Fleet, spoil, says: str) -> None:
    path = fleet.homes["drone-1"].path
    spoil(path)
    with pytest.raises(KeysError, match=says) as raised:
        Home.open(path)
    assert "\n" not in str(raised.value)


def test_a_home_is_not_overwritten(fleet: Fleet) -> None:
    with pytest.raises(KeysError, match="is the home of a node already"):
        Home.create(fleet.homes["drone-1"].path, "drone-9")


@pytest.mark.parametrize("name", ["", "a b", "../x", "x" * 64, "ä", "-a"])
def test_an_impossible_name_is_said(name: str, tmp_path) -> None:
    with pytest.raises(KeysError, match="a node's name is 1 to 63 letters"):
        Home.create(tmp_path / "x", name)
    assert not (tmp_path / "x").exists()


def test_only_routers_have_addresses(tmp_path) -> None:
    with pytest.raises(KeysError, match="nodes only dial out"):
        Home.create(tmp_path / "x", "a", addresses=["127.0.0.1"])
    with pytest.raises(Exception, match="a router needs at least one address"):
        Home.create(tmp_path / "x", "r", role=Role.ROUTER)
