"""Renewal over the network: certificates, changes of the policy and revocations reach running nodes by themselves."""

from __future__ import annotations

import random
import time

import pytest
from fleets import eventually
from members import POLICY, Fleet

from tutelage.seeding import derive
from tutelage.sgc import lanes
from tutelage.sgc import renewal as renewal_module
from tutelage.sgc.home import Home
from tutelage.sgc.node import Node
from tutelage.sgc.office import Office
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.renewal import Renewer, due, question
from tutelage.sgc.rules import Role
from tutelage.sgc.transport.base import NoReply
from tutelage.sgc.transport.memory import MemoryTransport, Network

WITH_OFFICE = POLICY.replace("version = 1", 'version = 1\nrenewals = "server"')


@pytest.fixture
def fleet(tmp_path) -> Fleet:
    fleet = Fleet(tmp_path, ["server", "drone-1", "drone-2"], share=False)
    fleet.publish(WITH_OFFICE)
    return fleet


@pytest.fixture
def office(fleet: Fleet) -> Office:
    return Office(fleet.authority, fleet.homes["server"])


def renewer(fleet: Fleet, office: Office, name: str = "drone-1") -> Renewer:
    def ask(key: str, payload: bytes, timeout: float) -> bytes:
        assert key == lanes.key(fleet.homes[name].access.control, lanes.RENEW)
        answer = office.answer(payload)
        if answer is None:
            raise NoReply("no answer")
        return answer

    return Renewer(fleet.homes[name], ask)


def test_nothing_new_costs_no_certificate(fleet: Fleet, office: Office) -> None:
    assert renewer(fleet, office).once() is False
    assert office.renewed == 0


def test_a_certificate_is_renewed_after_a_third_of_its_life(fleet: Fleet, office: Office, monkeypatch) -> None:
    home = fleet.homes["drone-1"]
    assert not due(home)
    now = time.time() + 9 * 3600
    monkeypatch.setattr("time.time", lambda: now)
    assert due(home)
    assert renewer(fleet, office).once()
    assert home.expires - now == pytest.approx(24 * 3600, abs=60)
    assert not due(home)


def test_a_change_of_the_policy_arrives(fleet: Fleet, office: Office) -> None:
    (fleet.authority.path / "policy.toml").write_text(WITH_OFFICE.replace('publish = ["drone-*"]', 'publish = ["drone-1"]'))
    fleet.authority.publish()
    assert renewer(fleet, office, "drone-2").once()
    assert "camera" not in fleet.homes["drone-2"].access.topics
    assert renewer(fleet, office, "drone-2").once() is False


def test_a_revocation_arrives_without_a_new_certificate(fleet: Fleet, office: Office) -> None:
    fleet.authority.revoke("drone-2")
    assert renewer(fleet, office).once()
    assert fleet.homes["drone-1"].trust.deny_list.serial == 1
    assert office.renewed == 0


def test_a_router_hears_of_a_new_member(fleet: Fleet, office: Office) -> None:
    router = fleet.join("router-1", Role.ROUTER)
    drone = fleet.join("drone-3")
    assert drone.pseudonym not in router.access.members
    assert renewer(fleet, office, "router-1").once()
    assert drone.pseudonym in router.access.members
    assert renewer(fleet, office).once() is False  # nodes need not know


def test_the_revoked_and_strangers_get_no_answer(fleet: Fleet, office: Office, tmp_path) -> None:
    asked = question(fleet.homes["drone-2"], renew=True)
    fleet.authority.revoke("drone-2")
    assert asked is not None
    assert office.answer(asked) is None
    assert office.refusals.as_dict() == {"not_allowed": 1}
    stranger = Fleet(tmp_path / "other", ["server", "drone-1"], WITH_OFFICE, share=False).homes["drone-1"]
    stolen = question(stranger, renew=True)
    assert stolen is not None
    assert office.answer(stolen) is None
    assert office.refusals.as_dict() == {"not_allowed": 1, "not_for_us": 1}


def test_a_repeated_question_costs_no_new_certificate_and_helps_nobody_else(fleet: Fleet, office: Office) -> None:
    asked = question(fleet.homes["drone-1"], renew=True)
    assert asked is not None
    answers = {office.answer(asked) for _ in range(5)}
    assert len(answers) == office.renewed == 1
    with pytest.raises(Refused) as raised:
        fleet.homes["drone-2"].accept(answers.pop() or b"")
    assert raised.value.reason == Reason.NOT_FOR_US


def test_nothing_in_a_question_can_be_read_by_a_carrier(fleet: Fleet) -> None:
    asked = question(fleet.homes["drone-1"], renew=True)
    assert asked is not None
    assert not [word for word in (b"drone-1", b"CERTIFICATE", fleet.homes["drone-1"].pseudonym.encode()) if word in asked]


def test_a_damaged_question_is_refused(fleet: Fleet, office: Office) -> None:
    asked, dice = question(fleet.homes["drone-1"], renew=True), random.Random(derive(0, "renewal"))
    assert asked is not None
    for _ in range(500):
        changed = bytearray(asked)
        changed[dice.randrange(len(changed))] ^= 1 << dice.randrange(8)
        assert office.answer(bytes(changed)) is None
        assert office.answer(asked[: dice.randrange(len(asked))]) is None
    assert office.answer(bytes(1 << 20)) is None
    assert office.refusals.total() == 1001
    assert office.renewed == 0


def test_everybody_learns_of_an_office_that_joins_later(tmp_path) -> None:
    fleet = Fleet(tmp_path, ["drone-1"], WITH_OFFICE, share=False)
    home = fleet.homes["drone-1"]
    assert home.access.renewals is None
    fleet.join("server")
    home.accept(fleet.authority.renew(home.request()))
    assert home.access.renewals is not None
    assert home.access.renewals.pseudonym == fleet.homes["server"].pseudonym


def test_without_an_office_nobody_asks(tmp_path) -> None:
    fleet = Fleet(tmp_path, ["drone-1"], share=False)
    assert question(fleet.homes["drone-1"], renew=True) is None
    assert Renewer(fleet.homes["drone-1"], lambda *_: b"").once() is False


def test_running_nodes_renew_themselves(fleet: Fleet, office: Office, monkeypatch) -> None:
    """Over a network in this process: the certificate of a running node is due, and is renewed without anybody's doing."""
    monkeypatch.setattr(renewal_module, "POLL", 0.05)
    monkeypatch.setattr(Renewer.__init__, "__kwdefaults__", {"every": 0.05, "due": due})
    home = fleet.homes["drone-1"]
    home.accept(fleet.authority.renew(home.request(), hours=0.05))  # 3 minutes, but backdated by 5: it is due
    assert due(home)
    network = Network()
    with (
        Node.open(fleet.homes["server"], MemoryTransport(network)) as server,
        server.transport.serve(lanes.key(server.access.control, lanes.RENEW), office.answer),
        Node.open(home, MemoryTransport(network)),
    ):
        eventually(lambda: not due(home))
    assert Home.open(home.path).expires - time.time() > 23 * 3600
