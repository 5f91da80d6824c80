"""The policy on the robot: weights come from the server, the robot proposes, the server overrides."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from remote.field import Field, drive
from sgc.fleets import eventually

from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.remote.fleet import RemoteFleet
from tutelage.remote.messages import Weights
from tutelage.remote.weights import PulledPolicy, SharedPolicy
from tutelage.remote.wire import pack_weights

Policies = tuple[RemoteFleet, SharedPolicy, EnsemblePolicy]


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Field]:
    pytest.importorskip("zenoh", reason="needs the extra sgc")
    with Field(tmp_path_factory.mktemp("field"), 1) as made:
        made.router()
        made.robots[1] = made.robot(1, "--hz", 20, "--policy", "--no-cameras")
        yield made


@pytest.fixture
def policies(field: Field) -> Iterator[Policies]:
    fleet = RemoteFleet.connect(field.server, hz=20.0)
    try:
        fleet.reset()
        policy = EnsemblePolicy((2,), fleet.action_low, fleet.action_high, members=2, hidden=(8,), seed=3)
        shared = SharedPolicy(fleet, policy)
        still = np.zeros((1, 2), np.float32)
        drive(lambda: fleet.step(still), lambda: fleet.proposals()[1][0] == shared.version)
        yield fleet, shared, policy
    finally:
        fleet.close()


def test_a_robot_proposes_what_the_policy_says_and_goes_on_by_itself(field: Field, policies: Policies) -> None:
    fleet, shared, policy = policies
    began = time.monotonic()
    obs = fleet.step(np.zeros((1, 2), np.float32))[0]
    for _ in range(15):
        action = shared.act(obs)
        assert action == pytest.approx(policy.act(obs), abs=1e-5)
        obs, *_, info = fleet.step(action)
    assert info["online"].all()
    acts = field.notes(1, began + 0.2, "act")
    assert len(acts) > 5
    assert tuple(map(float, acts[-1].words)) == pytest.approx(tuple(policy.act(obs)[0]), abs=0.05)


def test_new_weights_are_swapped_in_while_the_robot_works(policies: Policies) -> None:
    fleet, shared, policy = policies
    for member in policy.net.parameters():
        member.data.mul_(0.5)
    policy.forget()
    before = shared.version
    shared.share()
    assert shared.version == before + 1
    obs = fleet.step(np.zeros((1, 2), np.float32))[0]
    assert shared.act(obs) == pytest.approx(policy.act(obs), abs=1e-5)  # until they arrive, what the server would do
    drive(lambda: fleet.step(shared.act(fleet._obs)), lambda: fleet.proposals()[1][0] == shared.version)
    obs = fleet.step(shared.act(fleet._obs))[0]
    assert fleet.proposals()[0] == pytest.approx(policy.act(obs), abs=1e-5)


def test_the_server_overrides(field: Field, policies: Policies) -> None:
    fleet, _, _ = policies
    for _ in range(3):
        fleet.step(np.array([[0.125, -0.25]], np.float32))
    began = time.monotonic()
    for _ in range(5):
        fleet.step(np.array([[0.125, -0.25]], np.float32))
    assert {note.words for note in field.notes(1, began, "act")} == {("0.125", "-0.25")}


def test_weights_of_an_earlier_server_are_not_taken_for_those_of_the_next(policies: Policies) -> None:
    fleet, shared, policy = policies
    for member in policy.net.parameters():
        member.data.mul_(0.25)
    policy.forget()
    again = SharedPolicy(fleet, policy)  # as a server does that starts anew
    assert again.version != shared.version
    obs = fleet.step(np.zeros((1, 2), np.float32))[0]
    assert again.act(obs) == pytest.approx(policy.act(obs), abs=1e-5)
    drive(lambda: fleet.step(again.act(fleet._obs)), lambda: fleet.proposals()[1][0] == again.version)


def full(*given: object) -> int:
    raise OSError(28, "No space left on device")


def test_a_robot_whose_disk_is_full_for_a_while_fetches_the_weights_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = EnsemblePolicy((2,), np.full(2, -1.0), np.ones(2), members=2, hidden=(8,), seed=3)
    made.save(tmp_path / "weights", {})
    answer = pack_weights(Weights(5, (tmp_path / "weights").read_bytes()))
    node: Any = SimpleNamespace(
        name="arm", access=SimpleNamespace(entry=lambda alias: None), request=lambda alias, asked, wait: answer
    )
    monkeypatch.setattr("tutelage.remote.weights.FETCH_EVERY", 0.05)
    with monkeypatch.context() as broken:
        broken.setattr("tutelage.remote.weights.Path.write_bytes", full)
        pulled = PulledPolicy(node)
        time.sleep(0.5)
        assert pulled.version == 0
    eventually(lambda: pulled.version == 5)
    pulled.close()
    assert caplog.text.count("arm goes on with the policy that it has: OSError: [Errno 28] No space left on device") == 1


def test_a_server_whose_disk_is_full_for_a_while_hands_out_the_weights_later(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    offered: list[Weights] = []
    fleet: Any = SimpleNamespace(offer_policy=offered.append)
    shared = SharedPolicy(fleet, EnsemblePolicy((2,), np.full(2, -1.0), np.ones(2), members=2, hidden=(8,), seed=3))
    monkeypatch.setattr("tutelage.remote.weights.SHARE_EVERY", 0.0)
    learned: Any = SimpleNamespace(losses={"loss": 1.0})
    loop: Any = None
    before = shared.version
    with monkeypatch.context() as broken:
        broken.setattr("tutelage.remote.weights.tempfile.mkdtemp", full)
        shared.on_step(loop, learned)
    assert shared.version == before
    assert "the robots do not get the newest weights yet" in caplog.text
    shared.on_step(loop, SimpleNamespace(losses={}))  # type: ignore[arg-type]
    assert offered[-1].version == shared.version == before + 1
