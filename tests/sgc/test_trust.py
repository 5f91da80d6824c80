"""Credentials: whom a node believes, and why it does not believe the others."""

from __future__ import annotations

import time

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from cryptography.x509.oid import ExtendedKeyUsageOID
from hypothesis import given
from hypothesis import strategies as st
from members import Fleet

from tutelage.errors import ConfigError
from tutelage.sgc import certificates
from tutelage.sgc.certificates import Keys, der, raw
from tutelage.sgc.privatekeys import load_signing_key
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Role
from tutelage.sgc.signed import sign
from tutelage.sgc.trust import MEMBERSHIP, DenyList, Trust, membership
from tutelage.sgc.wire import pack, unpack


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> Fleet:
    fleet = Fleet(tmp_path_factory.mktemp("fleet"), ["drone-1", "server"], share=False)
    fleet.join("router-1", Role.ROUTER)
    return fleet


@pytest.fixture(scope="module")
def stranger(tmp_path_factory) -> Fleet:
    """Another fleet with the same names."""
    return Fleet(tmp_path_factory.mktemp("stranger"), ["drone-1", "server"], share=False)


def reason(call, *arguments) -> Reason:
    with pytest.raises(Refused) as raised:
        call(*arguments)
    assert "\n" not in str(raised.value)
    return raised.value.reason


def test_a_credential_says_who_somebody_is(fleet: Fleet) -> None:
    home = fleet.homes["drone-1"]
    member = fleet.homes["server"].trust.verify(home.credential)
    assert (member.node, member.pseudonym, member.role) == ("drone-1", home.pseudonym, Role.NODE)
    assert member.signing == home.signing_key.public_key()
    assert member.not_after - time.time() == pytest.approx(24 * 3600, abs=60)


def test_a_certificate_tells_nothing_about_its_node(fleet: Fleet) -> None:
    leaf = x509.load_pem_x509_certificate(fleet.homes["drone-1"].leaf_file.read_bytes())
    assert leaf.subject.rfc4514_string() == f"CN={fleet.homes['drone-1'].pseudonym}"
    assert b"drone" not in der(leaf)


def test_a_node_may_not_stand_in_for_a_router(fleet: Fleet) -> None:
    usages = {
        name: list(x509.load_pem_x509_certificate(fleet.homes[name].leaf_file.read_bytes()).extensions
                   .get_extension_for_class(x509.ExtendedKeyUsage).value)
        for name in ("drone-1", "router-1")
    }  # fmt: skip
    assert usages["drone-1"] == [ExtendedKeyUsageOID.CLIENT_AUTH]
    assert ExtendedKeyUsageOID.SERVER_AUTH in usages["router-1"]


def test_another_fleets_credential_is_refused(fleet: Fleet, stranger: Fleet) -> None:
    assert reason(fleet.homes["server"].trust.verify, stranger.homes["drone-1"].credential) == Reason.WRONG_AUTHORITY


def test_times_are_checked_on_every_use(fleet: Fleet) -> None:
    home, trust = fleet.homes["drone-1"], fleet.homes["server"].trust
    assert reason(trust.verify, home.credential, time.time() + 25 * 3600) == Reason.EXPIRED
    assert reason(trust.verify, home.credential, time.time() - 3600) == Reason.EXPIRED
    assert trust.verify(home.credential).node == "drone-1"


def test_a_clock_that_is_somewhat_late_does_no_harm(fleet: Fleet) -> None:
    trust = fleet.homes["server"].trust
    assert trust.verify(fleet.homes["drone-1"].credential, time.time() - 200).node == "drone-1"


def test_the_revoked_are_refused_though_they_were_known(fleet: Fleet) -> None:
    home = fleet.homes["drone-1"]
    trust = Trust(fleet.authority.root)
    member = trust.verify(home.credential)
    trust.deny_list = DenyList(1, frozenset([home.pseudonym]))
    assert reason(trust.verify, home.credential) == Reason.REVOKED
    assert reason(trust.check, member) == Reason.REVOKED


def forged(
    authority: x509.Certificate, key: Ed25519PrivateKey, keys: Keys, statement: bytes, by: Ed25519PrivateKey
) -> bytes:
    leaf = certificates.leaf_certificate(keys, authority, key, time.time(), 24)
    return pack(der(leaf), der(authority), sign(MEMBERSHIP, statement, by))


def test_no_node_can_make_credentials_of_its_own(fleet: Fleet, stranger: Fleet) -> None:
    """A member signs with its leaf; a stranger builds a chain that looks the same; a name is put on another's certificate."""
    trust, drone = fleet.homes["server"].trust, fleet.homes["drone-1"]
    keys = Keys("ab" * 16, Role.NODE, Ed25519PrivateKey.generate().public_key(), X25519PrivateKey.generate().public_key())
    statement = membership("server", keys.common_name, raw(keys.signing), raw(keys.sealing))
    leaf = x509.load_pem_x509_certificate(drone.leaf_file.read_bytes())
    assert (
        reason(trust.verify, forged(leaf, drone.signing_key, keys, statement, drone.signing_key)) == Reason.WRONG_AUTHORITY
    )
    root = Ed25519PrivateKey.generate()
    fake_root = certificates.authority_certificate("acme root", root.public_key(), None, root, time.time(), 30)
    own = Ed25519PrivateKey.generate()
    fake = certificates.authority_certificate("acme authority", own.public_key(), fake_root, root, time.time(), 30)
    assert reason(trust.verify, forged(fake, own, keys, statement, own)) == Reason.WRONG_AUTHORITY
    drone_leaf, authority, _ = unpack(drone.credential, 3)
    _, _, server_membership = unpack(fleet.homes["server"].credential, 3)
    assert reason(trust.verify, pack(drone_leaf, authority, server_membership)) == Reason.WRONG_AUTHORITY
    _, _, other_fleets = unpack(stranger.homes["drone-1"].credential, 3)
    assert reason(trust.verify, pack(drone_leaf, authority, other_fleets)) == Reason.WRONG_AUTHORITY


def test_what_the_root_signed_for_another_purpose_is_no_authority(fleet: Fleet) -> None:
    root_key = load_signing_key(fleet.authority.path / "root" / "root.key")
    own = Ed25519PrivateKey.generate()
    keys = Keys("ab" * 16, Role.NODE, own.public_key(), X25519PrivateKey.generate().public_key())
    leaf = certificates.leaf_certificate(keys, fleet.authority.root, root_key, time.time(), 24)
    statement = membership("server", keys.common_name, raw(keys.signing), raw(keys.sealing))
    assert reason(fleet.homes["server"].trust.verify, forged(leaf, own, keys, statement, own)) == Reason.WRONG_AUTHORITY


def test_the_authority_itself_is_no_member(fleet: Fleet) -> None:
    leaf, authority, statement = unpack(fleet.homes["drone-1"].credential, 3)
    assert reason(fleet.homes["server"].trust.verify, pack(authority, authority, statement)) == Reason.WRONG_AUTHORITY
    assert reason(fleet.homes["server"].trust.verify, pack(leaf, leaf, statement)) == Reason.WRONG_AUTHORITY


@given(st.data())
def test_a_credential_with_a_changed_bit_is_refused(fleet: Fleet, data: st.DataObject) -> None:
    credential = bytearray(fleet.homes["drone-1"].credential)
    bit = data.draw(st.integers(0, 8 * len(credential) - 1))
    credential[bit // 8] ^= 1 << bit % 8
    trust = fleet.homes["server"].trust
    try:
        member = trust.verify(bytes(credential))
    except Refused as refused:
        assert refused.reason in (Reason.MALFORMED, Reason.WRONG_AUTHORITY)
    else:  # the number of unused bits of a signature, which means nothing
        assert member == trust.verify(fleet.homes["drone-1"].credential)


@given(st.binary(max_size=300))
def test_bytes_that_are_no_credential_are_refused(fleet: Fleet, data: bytes) -> None:
    assert reason(fleet.homes["server"].trust.verify, data) == Reason.MALFORMED
    assert reason(fleet.homes["server"].trust.read_deny_list, data) == Reason.MALFORMED


def test_an_oversized_credential_is_refused_before_anything_else(fleet: Fleet) -> None:
    assert reason(fleet.homes["server"].trust.verify, bytes(100_000)) == Reason.MALFORMED


def test_a_deny_list_comes_from_the_authority_only(fleet: Fleet, stranger: Fleet) -> None:
    trust = fleet.homes["server"].trust
    stranger.authority.revoke("server")
    assert reason(trust.read_deny_list, stranger.authority.deny_notice()) == Reason.WRONG_AUTHORITY


@pytest.mark.parametrize("address", ["", "a b", "-a", "a..b", "256.1.1.1.", "x" * 64 + "/y", "http://a"])
def test_an_impossible_address_of_a_router_is_said(address: str) -> None:
    with pytest.raises(ConfigError, match="neither an IP address nor a host name"):
        certificates.check_addresses([address])


def test_a_routers_certificate_holds_its_addresses() -> None:
    certificates.check_addresses(["192.0.2.7", "2001:db8::7", "router.example.org", "localhost"])
