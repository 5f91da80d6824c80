"""Keys of topics: who gets them, how they change, and that they end by themselves."""

from __future__ import annotations

import shutil
import stat
import time
import types

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from members import POLICY, Fleet

from tutelage.sgc import keyring as keyring_module
from tutelage.sgc.epochs import CLOCK_TOLERANCE, Epoch, Epochs, read_epochs
from tutelage.sgc.errors import KeysError, NoKey, NotAllowed
from tutelage.sgc.grants import Exchange
from tutelage.sgc.home import Home
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Role


@pytest.fixture
def fleet(tmp_path) -> Fleet:
    return Fleet(tmp_path, share=False)


def reason(call, *arguments, **named) -> Reason:
    with pytest.raises(Refused) as raised:
        call(*arguments, **named)
    assert "\n" not in str(raised.value)
    return raised.value.reason


def give(fleet: Fleet, node: str, alias: str = "camera") -> int:
    owner = fleet.keyrings[fleet.homes[node].access.entry(alias).rule.owner]
    return fleet.keyrings[node].accept(alias, owner.answer(alias, fleet.keyrings[node].ask(alias)))


class Clock:
    """Time for owner and members alike."""

    def __init__(self, monkeypatch) -> None:
        self.now = time.time()
        monkeypatch.setattr(keyring_module.time, "time", lambda: self.now)

    def pass_(self, seconds: float) -> None:
        self.now += seconds


def test_the_owner_has_a_key_and_members_get_it_by_asking(fleet: Fleet) -> None:
    owner, member = fleet.keyrings["drone-1"], fleet.keyrings["server"]
    assert "camera" in member.wanted()
    assert member.epoch("camera") is None
    give(fleet, "server")
    assert member.epoch("camera") == owner.epoch("camera")
    assert member.sealing("camera").key == owner.sealing("camera").key
    assert "camera" not in member.wanted()


def test_a_key_is_kept_over_a_restart_sealed_to_the_node(fleet: Fleet) -> None:
    give(fleet, "server")
    key, file = fleet.keyrings["server"].sealing("camera").key, fleet.homes["server"].path / "keys" / "camera.keys"
    assert Keyring(Home.open(fleet.homes["server"].path)).sealing("camera").key == key
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert key not in file.read_bytes()
    assert key.hex().encode() not in file.read_bytes()


def test_a_damaged_file_of_keys_is_asked_for_again(fleet: Fleet) -> None:
    give(fleet, "server")
    (fleet.homes["server"].path / "keys" / "camera.keys").write_bytes(b"?")
    again = Keyring(Home.open(fleet.homes["server"].path))
    assert again.epoch("camera") is None
    assert "camera" in again.wanted()


def test_a_folder_of_keys_that_was_removed_is_made_again(fleet: Fleet) -> None:
    """The owner must be able to change its keys; who it is does not depend on that folder."""
    give(fleet, "server")
    for name in ("drone-1", "server"):
        shutil.rmtree(fleet.homes[name].path / "keys")
    (push,) = fleet.keyrings["drone-1"].rotate("camera")
    fleet.keyrings["server"].accept("camera", push.grant)
    folder = fleet.homes["server"].path / "keys"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    shutil.rmtree(folder)
    folder.write_text("")
    with pytest.raises(KeysError, match=r"cannot make the folder \S+keys: File exists; move away what is there"):
        give(fleet, "server")


def test_a_member_that_asks_with_an_impossible_key_is_refused_and_stops_no_change_of_keys(fleet: Fleet) -> None:
    """A point of low order cannot be sealed to; nobody else may be left without the next key because of it."""
    owner, member = fleet.keyrings["drone-1"], fleet.keyrings["server"]
    give(fleet, "server")
    for point in (bytes(32), b"\1" + bytes(31)):
        public = types.SimpleNamespace(public_bytes_raw=lambda point=point: point)
        evil = Exchange(member.home.access.entry("camera")).ask(member.home, bytes(16), public)
        assert reason(owner.answer, "camera", evil) == Reason.MALFORMED
    (push,) = owner.rotate("camera")
    member.accept("camera", push.grant)
    assert member.sealing("camera", time.time() + 3.0).key == owner.sealing("camera", time.time() + 3.0).key


def test_nothing_in_a_request_or_grant_can_be_read_by_a_carrier(fleet: Fleet) -> None:
    request = fleet.keyrings["server"].ask("camera")
    grant = fleet.keyrings["drone-1"].answer("camera", request)
    key = fleet.keyrings["drone-1"].sealing("camera").key
    secret = fleet.homes["server"].access.entry("camera").secret
    clear = [b"server", b"drone", b"camera", key, secret, *(home.pseudonym.encode() for home in fleet.homes.values())]
    assert not [word for word in clear if word in request + grant]


def test_a_request_cannot_be_linked_to_the_one_before(fleet: Fleet) -> None:
    one, other = (fleet.keyrings["server"].ask("camera") for _ in range(2))
    assert not set(zip(range(40), one, strict=False)) >= set(zip(range(40), other, strict=False))
    assert one[:28] != other[:28]


def test_without_a_key_the_owner_is_named(fleet: Fleet) -> None:
    with pytest.raises(
        NoKey, match=r"server has no valid key for camera \(none has arrived yet\); is its owner, drone-1, running"
    ):
        fleet.keyrings["server"].sealing("camera")


def test_only_the_owner_answers_and_rotates(fleet: Fleet) -> None:
    for call in (lambda: fleet.keyrings["server"].answer("camera", b""), lambda: fleet.keyrings["server"].rotate("camera")):
        with pytest.raises(NotAllowed, match="server does not own camera; its owner in the policy is drone-1"):
            call()


def test_who_has_no_part_in_a_topic_gets_no_key(fleet: Fleet) -> None:
    """drone-2 has a part in camera, but not in teleop: it cannot even ask; with the topic's secret in hand it is refused."""
    with pytest.raises(NotAllowed):
        fleet.keyrings["drone-2"].ask("teleop")
    insider = fleet.keyrings["drone-2"]
    stolen = fleet.homes["server"].access
    object.__setattr__(insider.home.bundle, "access", stolen)
    request = insider.ask("teleop")
    assert reason(fleet.keyrings["operator-1"].answer, "teleop", request) == Reason.NOT_ALLOWED
    assert fleet.keyrings["operator-1"].refusals[Reason.NOT_ALLOWED] == 1


def test_a_router_gets_no_key(fleet: Fleet) -> None:
    router = fleet.join("router-1", Role.ROUTER)
    object.__setattr__(router.bundle, "access", fleet.homes["server"].access)
    assert reason(fleet.keyrings["drone-1"].answer, "camera", Keyring(router).ask("camera")) == Reason.NOT_ALLOWED


def test_a_stolen_certificate_without_its_private_key_gets_no_key(fleet: Fleet) -> None:
    """The thief holds server's credential and the topic's secret, but signs with another key."""
    thief = fleet.keyrings["operator-1"]
    object.__setattr__(thief.home, "_bundle", fleet.homes["server"].bundle)
    assert reason(fleet.keyrings["drone-1"].answer, "camera", thief.ask("camera")) == Reason.FORGED


def test_the_revoked_get_no_key(fleet: Fleet) -> None:
    fleet.revoke("server", tell=["drone-1"])
    assert reason(fleet.keyrings["drone-1"].answer, "camera", fleet.keyrings["server"].ask("camera")) == Reason.REVOKED


def test_an_expired_certificate_gets_no_key(fleet: Fleet, monkeypatch) -> None:
    fleet.homes["server"].accept(fleet.authority.renew(fleet.homes["server"].request(), hours=0.001))
    request = fleet.keyrings["server"].ask("camera")
    Clock(monkeypatch).pass_(10)
    assert reason(fleet.keyrings["drone-1"].answer, "camera", request) == Reason.EXPIRED


def test_a_grant_is_for_one_node(fleet: Fleet) -> None:
    grant = fleet.keyrings["drone-1"].answer("camera", fleet.keyrings["server"].ask("camera"))
    assert reason(fleet.keyrings["operator-1"].accept, "camera", grant) == Reason.NOT_FOR_US


def test_a_grant_of_somebody_else_than_the_owner_is_refused(fleet: Fleet) -> None:
    """drone-2 publishes on camera and has its secret, but drone-1 owns it."""
    give(fleet, "drone-2")
    impostor, member = fleet.keyrings["drone-2"], fleet.keyrings["server"]
    request, exchange = member.ask("camera"), impostor._keys("camera", time.time()).exchange
    asked, nonce = exchange.read_ask(request, impostor.home.trust)
    grant = exchange.grant(impostor.home, asked, impostor._keys("camera", time.time()).epochs.all(), nonce)
    assert reason(member.accept, "camera", grant) == Reason.NOT_ALLOWED
    assert member.epoch("camera") is None


def test_a_first_key_must_have_been_asked_for(fleet: Fleet) -> None:
    """A grant that a router kept and pushes to a node that knows nothing yet."""
    give(fleet, "server")
    push = next(push for push in fleet.keyrings["drone-1"].rotate("camera") if push.node == "server")
    (fleet.homes["server"].path / "keys" / "camera.keys").unlink()
    fresh = Keyring(fleet.homes["server"])
    assert reason(fresh.accept, "camera", push.grant) == Reason.NOT_FOR_US  # sealed to a key of the former start
    fresh._reply_to = fleet.keyrings["server"]._reply_to
    assert reason(fresh.accept, "camera", push.grant) == Reason.REPLAYED


def test_keys_can_be_carried_by_file_between_programs_that_do_not_run_at_the_same_time(fleet: Fleet) -> None:
    request = Keyring(fleet.homes["server"]).ask("camera", by_hand=True)
    grant = Keyring(fleet.homes["drone-1"]).answer("camera", request)
    later = Keyring(fleet.homes["server"])
    assert reason(later.accept, "camera", grant) == Reason.NOT_FOR_US
    assert later.accept("camera", grant, by_hand=True) == fleet.keyrings["drone-1"].epoch("camera")


def test_who_steals_a_folder_cannot_read_grants_that_were_recorded(fleet: Fleet, monkeypatch) -> None:
    clock = Clock(monkeypatch)
    recorded = fleet.keyrings["drone-1"].answer("camera", fleet.keyrings["server"].ask("camera"))
    fleet.keyrings["server"].accept("camera", recorded)
    clock.pass_(3 * 3600)
    fleet.keyrings["server"].tend()  # the key is over, and forgotten
    thief = Keyring(Home.open(fleet.homes["server"].path))
    assert thief.epoch("camera") is None
    for by_hand in (False, True):
        assert reason(thief.accept, "camera", recorded, by_hand=by_hand) == Reason.NOT_FOR_US


def test_when_the_owner_is_revoked_its_keys_are_dropped(fleet: Fleet) -> None:
    """It could read whatever is sealed under them."""
    give(fleet, "server")
    give(fleet, "drone-2")
    restarted = Keyring(Home.open(fleet.homes["server"].path))
    fleet.revoke("drone-1", tell=["server", "drone-2"])
    restarted.tend()
    for keyring in (fleet.keyrings["drone-2"], fleet.keyrings["server"], restarted):
        with pytest.raises(NoKey, match="has no key for camera: drone-1 is revoked; name another owner in the policy"):
            keyring.sealing("camera")
    fleet.publish(POLICY.replace('owner = "drone-1"', 'owner = "drone-2"'))
    give(fleet, "server")
    for _ in range(3):  # the new owner stays with the key that it made
        made, given = (fleet.keyrings[name].sealing("camera") for name in ("drone-2", "server"))
        assert (made.number, made.key) == (given.number, given.key)


def test_an_answer_is_taken_once_and_only_for_a_question(fleet: Fleet) -> None:
    member = fleet.keyrings["server"]
    grant = fleet.keyrings["drone-1"].answer("camera", member.ask("camera"))
    member.accept("camera", grant)
    assert reason(member.accept, "camera", grant) == Reason.REPLAYED


def test_an_older_key_is_refused(fleet: Fleet) -> None:
    owner, member = fleet.keyrings["drone-1"], fleet.keyrings["server"]
    give(fleet, "server")
    first = owner.rotate("camera")[0]
    second = owner.rotate("camera")[0]
    member.accept("camera", second.grant)
    assert reason(member.accept, "camera", first.grant) == Reason.ROLLBACK


def test_a_changed_key_is_used_by_all_at_the_same_time(fleet: Fleet, monkeypatch) -> None:
    clock = Clock(monkeypatch)
    owner, member = fleet.keyrings["drone-1"], fleet.keyrings["server"]
    old = give(fleet, "server")
    (push,) = owner.rotate("camera", delay=2.0)
    assert (push.alias, push.node) == ("camera", "server")
    new = member.accept("camera", push.grant)
    assert owner.epoch("camera") == member.epoch("camera") == old
    clock.pass_(2.5)
    assert owner.epoch("camera") == member.epoch("camera") == new


def test_the_old_key_is_accepted_for_a_grace_period_only(fleet: Fleet, monkeypatch) -> None:
    clock = Clock(monkeypatch)
    old = give(fleet, "server")
    member = fleet.keyrings["server"]
    member.accept("camera", fleet.keyrings["drone-1"].rotate("camera", delay=0.0)[0].grant)
    clock.pass_(29)
    assert member.opening("camera", old).number == old
    clock.pass_(2)
    assert reason(member.opening, "camera", old) == Reason.OLD_EPOCH
    member.tend()
    assert reason(member.opening, "camera", old) == Reason.OLD_EPOCH  # and not unknown, once it was dropped
    assert reason(member.opening, "camera", old + 10) == Reason.UNKNOWN_EPOCH


def test_the_owner_rotates_when_it_is_time(fleet: Fleet, monkeypatch) -> None:
    clock = Clock(monkeypatch)
    owner, old = fleet.keyrings["drone-1"], give(fleet, "server")
    assert owner.tend() == []
    clock.pass_(3600)
    aliases = {push.alias for push in owner.tend() if push.node == "server"}
    assert aliases == {"camera"}
    clock.pass_(3)
    assert owner.epoch("camera") > old
    assert owner.tend() == []


def test_revocation_changes_every_key_at_once_and_without_grace(fleet: Fleet) -> None:
    owner = fleet.keyrings["drone-1"]
    give(fleet, "server")
    old = give(fleet, "operator-1")
    fleet.revoke("operator-1", tell=["drone-1"])
    pushes = owner.tend()
    assert [push.node for push in pushes if push.alias == "camera"] == ["server"]
    assert owner.epoch("camera") > old
    server = fleet.keyrings["server"]
    server.accept("camera", next(push for push in pushes if push.alias == "camera").grant)
    assert reason(server.opening, "camera", old) == Reason.OLD_EPOCH


def test_revocation_changes_the_key_even_if_the_owner_was_off_meanwhile(fleet: Fleet) -> None:
    old = give(fleet, "server")
    fleet.revoke("server", tell=["drone-1"])
    restarted = Keyring(Home.open(fleet.homes["drone-1"].path))
    restarted.tend()
    assert restarted.epoch("camera") > old


def test_a_node_that_lost_its_right_gets_no_further_key(fleet: Fleet) -> None:
    old = give(fleet, "operator-1")
    give(fleet, "server")
    fleet.publish(POLICY.replace('subscribe = ["server", "operator-*"]', 'subscribe = ["server"]', 1))
    pushes = fleet.keyrings["drone-1"].tend()
    assert {push.node for push in pushes if push.alias == "camera"} == {"server"}
    assert fleet.keyrings["drone-1"].epoch("camera") > old
    fleet.keyrings["operator-1"].tend()
    assert not (fleet.homes["operator-1"].path / "keys" / "camera.keys").exists()
    with pytest.raises(NotAllowed):
        fleet.keyrings["operator-1"].epoch("camera")


def test_a_key_ends_by_itself_though_no_message_ever_comes(fleet: Fleet, monkeypatch) -> None:
    """Routers that hold back every grant and every deny list win two periods of rotation, and no more."""
    clock = Clock(monkeypatch)
    number = give(fleet, "server")
    member = fleet.keyrings["server"]
    clock.pass_(2 * 3600 + 1)
    with pytest.raises(NoKey, match="the last one is over"):
        member.sealing("camera")
    clock.pass_(CLOCK_TOLERANCE)
    assert reason(member.opening, "camera", number) == Reason.OLD_EPOCH


def test_a_sender_that_missed_a_change_asks_soon(fleet: Fleet, monkeypatch) -> None:
    clock = Clock(monkeypatch)
    for node in ("drone-2", "server"):
        for alias in fleet.keyrings[node].wanted():
            if not (node == "server" and alias == "teleop"):
                give(fleet, node, alias)
    assert fleet.keyrings["drone-2"].wanted() == []
    clock.pass_(31)
    assert "camera" in fleet.keyrings["drone-2"].wanted()  # it sends there
    assert "camera" not in fleet.keyrings["server"].wanted()  # it only listens
    clock.pass_(1.6 * 3600)
    assert "camera" in fleet.keyrings["server"].wanted()


def test_an_owner_that_lost_its_home_goes_on_above(fleet: Fleet, tmp_path) -> None:
    old = give(fleet, "server")
    fleet.authority.revoke("drone-1")
    home = Home.create(tmp_path / "again", "drone-1")
    home.accept(fleet.authority.issue(home.request()))
    time.sleep(1.01)
    fleet.keyrings["drone-1"] = Keyring(home)
    assert give(fleet, "server") > old


def test_two_processes_of_one_owner_agree(fleet: Fleet) -> None:
    one, other = fleet.keyrings["drone-1"], Keyring(Home.open(fleet.homes["drone-1"].path))
    assert one.epoch("camera") == other.epoch("camera")
    assert one.sealing("camera").key == other.sealing("camera").key
    one.rotate("camera", delay=0.0)
    other.tend()
    assert one.epoch("camera") == other.epoch("camera")
    fleet.revoke("server", tell=["drone-1"])
    one.tend()
    other.tend()
    assert one.sealing("camera").key == other.sealing("camera").key


def test_the_owner_knows_who_asked_and_members_know_the_owner(fleet: Fleet) -> None:
    give(fleet, "server")
    assert [member.node for member in fleet.keyrings["drone-1"].known("camera")] == ["server"]
    assert [member.node for member in fleet.keyrings["server"].known("camera")] == ["drone-1"]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_grant_or_request_with_a_changed_bit_is_refused(fleet: Fleet, data: st.DataObject) -> None:
    owner, member = fleet.keyrings["drone-1"], fleet.keyrings["server"]
    request = member.ask("camera")
    grant = owner.answer("camera", request)

    def changed(content: bytes) -> bytes:
        bit = data.draw(st.integers(0, 8 * len(content) - 1))
        copy = bytearray(content)
        copy[bit // 8] ^= 1 << bit % 8
        return bytes(copy)

    assert reason(owner.answer, "camera", changed(request)) == Reason.TAMPERED
    assert reason(member.accept, "camera", changed(grant)) in (Reason.TAMPERED, Reason.NOT_FOR_US)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=300))
def test_bytes_that_are_no_grant_or_request_are_refused(fleet: Fleet, data: bytes) -> None:
    known = (Reason.TAMPERED, Reason.NOT_FOR_US, Reason.MALFORMED)
    assert reason(fleet.keyrings["drone-1"].answer, "camera", data) in known
    assert reason(fleet.keyrings["server"].accept, "camera", data) in known


def test_an_oversized_request_is_refused_before_anything_else(fleet: Fleet) -> None:
    assert reason(fleet.keyrings["drone-1"].answer, "camera", bytes(1 << 20)) == Reason.OVERSIZE


@given(st.binary(max_size=300))
def test_bytes_that_are_no_epochs_are_refused(data: bytes) -> None:
    try:
        epochs = read_epochs(data, 0.0)
    except Refused as refused:
        assert refused.reason == Reason.MALFORMED
    else:
        assert b"".join(epoch.pack() for epoch in epochs) == data


@pytest.mark.parametrize("begins", [float("nan"), float("inf"), -1.0])
def test_epochs_at_impossible_times_are_refused(begins: float) -> None:
    assert reason(read_epochs, Epoch(1, bytes(32), begins, 2.0, 0.0).pack(), 0.0) == Reason.MALFORMED


def test_a_member_whose_clock_is_late_uses_the_key_that_it_was_given() -> None:
    epochs = Epochs([Epoch(1, bytes(32), begins=100.0, ends=200.0, grace=0.0)])
    assert epochs.sealing(100.0 - CLOCK_TOLERANCE / 2) is not None
    assert epochs.sealing(100.0 - 2 * CLOCK_TOLERANCE) is None
