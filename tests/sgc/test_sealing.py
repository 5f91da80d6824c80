"""Messages end to end: what is sealed is opened by those who may, and by nobody else, in every mode of authenticity."""

from __future__ import annotations

import array
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from cryptography.exceptions import InvalidSignature
from hypothesis import given
from hypothesis import strategies as st
from members import POLICY, Fleet

from tutelage.errors import ConfigError
from tutelage.sgc import keyring as keyring_module
from tutelage.sgc import opener as opener_module
from tutelage.sgc.errors import NoKey, NotAllowed, NotIssued
from tutelage.sgc.home import Home
from tutelage.sgc.packet import HEADER, MAX_PAYLOAD, Statements, digest, join_batch, split_batch
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Lane
from tutelage.sgc.sealing import Opened, Opener, Sealer, ident

STREAMS = [("camera", "drone-1", "server"), ("teleop", "operator-1", "server"), ("lidar", "drone-1", "server")]
"""Topics with signatures, sessions and chains."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> Fleet:
    return Fleet(tmp_path_factory.mktemp("fleet"))


@pytest.fixture
def own_fleet(tmp_path) -> Fleet:
    """For tests that change it."""
    return Fleet(tmp_path)


def reason(call, *arguments, **named) -> Reason:
    with pytest.raises(Refused) as raised:
        call(*arguments, **named)
    assert "\n" not in str(raised.value)
    return raised.value.reason


def receive(opener: Opener, *packets) -> list[Opened]:
    return [message for packet in packets if packet is not None for message in opener.open_many(packet)]


@pytest.mark.parametrize(("alias", "sender", "receiver"), STREAMS)
@pytest.mark.parametrize("size", [0, 1, 64, 1000, 16_384, 16_385, 70_000, 3_000_000])
def test_a_message_arrives_as_it_was_sent(fleet: Fleet, alias: str, sender: str, receiver: str, size: int) -> None:
    sealer, opener = fleet.pair(alias, sender, receiver)
    payload, before = bytes(range(256)) * (size // 256) + bytes(size % 256), time.time_ns()
    (message,) = receive(opener, sealer.seal(payload), sealer.flush())
    assert (message.payload, message.sender, message.sequence, message.authentic) == (payload, sender, 1, True)
    assert (message.salt, message.epoch) == (sealer.salt, fleet.keyrings[receiver].epoch(alias))
    assert before <= message.sent <= time.time_ns()


@pytest.mark.parametrize(("alias", "sender", "receiver"), STREAMS)
def test_any_kind_of_buffer_is_sealed(fleet: Fleet, alias: str, sender: str, receiver: str) -> None:
    sealer, opener = fleet.pair(alias, sender, receiver)
    kinds = [b"abcd", bytearray(b"abcd"), memoryview(b"abcd"), memoryview(array.array("I", [1684234849]))]
    packets = [sealer.seal(kind) for kind in kinds]
    assert [message.payload for message in receive(opener, *packets, sealer.flush())] == [b"abcd"] * 4
    with pytest.raises(ConfigError, match="must lie in one piece of memory"):
        sealer.seal(memoryview(b"abcdef")[::2])


@pytest.mark.parametrize(("alias", "sender", "receiver"), STREAMS)
def test_packets_may_come_as_any_kind_of_buffer(fleet: Fleet, alias: str, sender: str, receiver: str) -> None:
    sealer, opener = fleet.pair(alias, sender, receiver)
    packets = [kind(sealer.seal(b"x")) for kind in (bytes, bytearray, memoryview)]
    assert len(receive(opener, *packets, sealer.flush())) == 3


@pytest.mark.parametrize(("alias", "sender", "receiver"), STREAMS)
def test_many_small_messages_share_one_proof(fleet: Fleet, alias: str, sender: str, receiver: str) -> None:
    sealer, opener = fleet.pair(alias, sender, receiver)
    payloads = [bytes([k]) * k for k in range(100)]
    packets = [sealer.seal(b"first"), sealer.seal_many(payloads), sealer.seal(b"last"), sealer.flush()]
    messages = receive(opener, *packets)
    assert [message.payload for message in messages] == [b"first", *payloads, b"last"]
    assert [message.sequence for message in messages] == list(range(1, 103))
    assert len({message.ident for message in messages}) == 102
    assert reason(opener.open_many, packets[1]) == Reason.REPLAYED


def test_one_message_is_asked_for_where_there_are_many(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("camera", "drone-1", "server")
    assert opener.open(sealer.seal(b"one")).payload == b"one"
    assert reason(opener.open, sealer.seal_many([b"a", b"b"])) == Reason.MALFORMED


@given(st.lists(st.binary(max_size=50), min_size=1, max_size=20))
def test_batches_come_apart_as_they_were_joined(payloads: list[bytes]) -> None:
    assert split_batch(join_batch(payloads)) == payloads


@given(st.binary(max_size=60))
def test_bytes_that_are_no_batch_are_refused(data: bytes) -> None:
    try:
        assert join_batch(split_batch(data)) == data
    except Refused as refused:
        assert refused.reason == Reason.MALFORMED


@pytest.mark.parametrize("payloads", [[], [b""] * 70_000])
def test_an_impossible_batch_is_said(fleet: Fleet, payloads: list[bytes]) -> None:
    with pytest.raises(ConfigError, match="a batch has 1 to 65536 messages, not"):
        fleet.sealer("drone-1", "camera").seal_many(payloads)


def test_a_message_that_is_too_long_is_said(fleet: Fleet) -> None:
    with pytest.raises(ConfigError, match=f"for camera; {MAX_PAYLOAD} fit: split or compress it"):
        fleet.sealer("drone-1", "camera").seal(bytes(MAX_PAYLOAD + 100))


@pytest.mark.parametrize(("alias", "sender", "receiver"), STREAMS)
def test_equal_messages_do_not_look_equal(fleet: Fleet, alias: str, sender: str, receiver: str) -> None:
    sealers = [fleet.sealer(sender, alias) for _ in range(2)]
    packets = [bytes(sealer.seal(bytes(64)))[-64:] for sealer in sealers for _ in range(2)]
    assert len(set(packets)) == 4
    assert sealers[0].salt != sealers[1].salt


@pytest.mark.parametrize(("alias", "sender", "receiver"), STREAMS)
def test_a_packet_names_neither_node_nor_topic(fleet: Fleet, alias: str, sender: str, receiver: str) -> None:
    sealer, _ = fleet.pair(alias, sender, receiver)
    packets = b"".join(
        bytes(packet) for packet in (sealer.seal(b"payload " * 8), sealer.seal(b"x"), sealer.flush()) if packet
    )
    home, entry = fleet.homes[sender], fleet.homes[sender].access.entry(alias)
    public = home.signing_key.public_key().public_bytes_raw()
    words = [b"payload", sender.encode(), alias.encode(), entry.rule.topic.interface.encode(), home.pseudonym.encode(),
             bytes.fromhex(home.pseudonym), bytes(entry.name), entry.secret, public, home.credential[:40]]  # fmt: skip
    assert not [word for word in words if word in packets]


def test_a_nodes_id_differs_from_topic_to_topic(fleet: Fleet) -> None:
    camera, lidar = (bytes(fleet.sealer("drone-1", alias).seal(b"x")) for alias in ("camera", "lidar"))
    assert camera[12:28] != lidar[12:28]


def test_a_signature_is_not_in_clear(fleet: Fleet) -> None:
    """Else, anyone who has seen a node's certificate could tell which packets are its own."""
    sealer = fleet.sealer("drone-1", "camera")
    sealer.seal(b"introduction")
    packet, key = bytes(sealer.seal(b"x")), fleet.homes["drone-1"].signing_key.public_key()
    statement = Statements(bytes(fleet.homes["drone-1"].access.entry("camera").name), Lane.STREAM).message(
        packet[:HEADER], b"", b"x"
    )
    for at in range(len(packet) - 63):
        with pytest.raises(InvalidSignature):
            key.verify(packet[at : at + 64], statement)


def test_the_first_packet_introduces_and_later_ones_are_short(fleet: Fleet) -> None:
    sealer, now = fleet.sealer("drone-1", "camera"), time.time_ns()
    lengths = [len(sealer.seal(b"x", now=now + k * 250_000_000)) for k in range(9)]
    assert [length > 1000 for length in lengths] == [True, False, False, False, True, False, False, False, True]
    sealer.introduce()
    assert len(sealer.seal(b"x", now=now + 2_100_000_000)) > 1000


def test_a_sender_that_was_not_introduced_is_refused_until_it_is(fleet: Fleet) -> None:
    sealer = fleet.sealer("drone-2", "camera")
    sealer.seal(b"before anybody listened")
    opener = fleet.opener("server", "camera")
    assert reason(opener.open, sealer.seal(b"who?")) == Reason.UNKNOWN_SENDER
    sealer.introduce()
    assert [opener.open(sealer.seal(text)).payload for text in (b"me", b"again")] == [b"me", b"again"]


def test_the_owner_of_the_topic_needs_no_introduction(fleet: Fleet) -> None:
    sealer = fleet.sealer("drone-1", "camera")
    sealer.seal(b"before anybody listened")
    assert fleet.opener("server", "camera").open(sealer.seal(b"x")).sender == "drone-1"


def test_receivers_tell_senders_apart(fleet: Fleet) -> None:
    opener = fleet.opener("server", "camera")
    messages = [opener.open(fleet.sealer(name, "camera").seal(b"x")) for name in ("drone-1", "drone-2")]
    assert [message.sender for message in messages] == ["drone-1", "drone-2"]


def test_a_request_and_its_reply_belong_together(fleet: Fleet) -> None:
    ask, serve = fleet.sealer("drone-1", "grasp", Lane.REQUEST), fleet.opener("server", "grasp", Lane.REQUEST)
    reply, hear = fleet.sealer("server", "grasp", Lane.REPLY), fleet.opener("drone-1", "grasp", Lane.REPLY)
    first, second = ask.seal(b"where?"), ask.seal(b"how?")
    requests = [serve.open(first), serve.open(second)]
    assert [request.ident for request in requests] == [ident(first), ident(second)]
    answer = reply.seal(b"here", bind=requests[0].ident)
    assert reason(hear.open, answer, bind=ident(second)) == Reason.TAMPERED
    assert reason(hear.open, answer) == Reason.TAMPERED
    assert hear.open(answer, bind=ident(first)).payload == b"here"


def test_a_packet_of_one_lane_is_refused_on_the_other(fleet: Fleet) -> None:
    request = fleet.sealer("drone-1", "grasp", Lane.REQUEST).seal(b"x")
    assert reason(fleet.opener("drone-1", "grasp", Lane.REPLY).open, request) == Reason.TAMPERED


def test_a_packet_of_one_topic_is_refused_on_another(own_fleet: Fleet) -> None:
    own_fleet.publish(POLICY + POLICY[POLICY.index("[topics.camera]") :].replace("[topics.", "[topics.other-").replace('interface = "', 'interface = "/other'))  # fmt: skip
    own_fleet.share()
    packet = own_fleet.sealer("drone-1", "other-camera").seal(b"x")
    opener = own_fleet.opener("server", "camera")
    own_fleet.keyrings["server"]._keys("camera", time.time()).epochs.add(
        own_fleet.keyrings["server"]._keys("other-camera", time.time()).epochs.all()
    )  # even under the same key
    assert reason(opener.open, packet) in (Reason.TAMPERED, Reason.UNKNOWN_EPOCH)


def test_a_renewed_certificate_is_followed_on_both_sides(own_fleet: Fleet) -> None:
    home = own_fleet.homes["drone-1"]
    home.accept(own_fleet.authority.renew(home.request(), hours=0.02))
    sealer, opener = own_fleet.pair("camera", "drone-1", "server")
    opener.open(sealer.seal(b"x"))
    later = time.time_ns() + 80 * 10**9
    with pytest.raises(NotIssued, match="the certificate of drone-1 expired"):
        sealer.seal(b"x", now=later)
    Home.open(home.path).accept(own_fleet.authority.renew(home.request()))  # another process: keys renew
    assert opener.open(sealer.seal(b"y", now=later), now=later).payload == b"y"


def give(fleet: Fleet, node: str, alias: str = "camera") -> int:
    owner = fleet.keyrings[fleet.homes[node].access.entry(alias).rule.owner]
    return fleet.keyrings[node].accept(alias, owner.answer(alias, fleet.keyrings[node].ask(alias)))


def test_a_sender_whose_certificate_expired_is_refused(own_fleet: Fleet, monkeypatch) -> None:
    home = own_fleet.homes["drone-1"]
    home.accept(own_fleet.authority.renew(home.request(), hours=0.02))
    sealer, opener = own_fleet.pair("camera", "drone-1", "server")
    opener.open(sealer.seal(b"x"))
    late = sealer.seal(b"x")
    assert reason(opener.open, late, now=time.time_ns() + 80 * 10**9) == Reason.EXPIRED


@pytest.mark.parametrize("alias", ["camera", "lidar"])
def test_no_packet_of_the_revoked_makes_way_for_the_next(own_fleet: Fleet, alias: str) -> None:
    """With or without its credential; a refused one must not count as a look at its sender."""
    sealer, opener = own_fleet.pair(alias, "drone-2", "server")
    receive(opener, sealer.seal(b"x"), sealer.flush())
    own_fleet.revoke("drone-2", tell=["server"])
    for introduced in (True, False, True, True, False, False):
        if introduced:
            sealer.introduce()
        assert reason(opener.open_many, sealer.seal(b"x")) == Reason.REVOKED


def test_the_revoked_are_refused_at_once_by_whoever_has_the_deny_list(own_fleet: Fleet) -> None:
    sealer, opener = own_fleet.pair("camera", "drone-2", "server")
    assert opener.open(sealer.seal(b"x")).sender == "drone-2"
    own_fleet.revoke("drone-2", tell=["server"])
    assert reason(opener.open, sealer.seal(b"x")) == Reason.REVOKED
    assert reason(opener.open, own_fleet.sealer("drone-2", "camera").seal(b"x")) == Reason.REVOKED
    own_fleet.homes["drone-2"].accept(own_fleet.authority.deny_notice())
    with pytest.raises(NotIssued, match="drone-2 is revoked"):
        sealer.seal(b"x")


def test_a_change_of_policy_takes_effect_while_running(own_fleet: Fleet) -> None:
    sealer, opener = own_fleet.pair("camera", "drone-2", "server")
    opener.open(sealer.seal(b"x"))
    packet = sealer.seal(b"x")
    changed = POLICY.replace('publish = ["drone-*"]\nsubscribe = ["server", "operator-*"]', 'publish = ["drone-1"]\nsubscribe = ["server"]', 1)  # fmt: skip
    own_fleet.publish(changed)
    assert reason(opener.open, packet) == Reason.NOT_ALLOWED
    with pytest.raises(NotAllowed, match="gives drone-2 no part in a topic 'camera'"):
        sealer.seal(b"x")
    own_fleet.publish(changed.replace('subscribe = ["server"]', 'subscribe = ["operator-1"]', 1))
    assert reason(opener.open, own_fleet.sealer("drone-1", "camera").seal(b"x")) == Reason.NOT_ALLOWED


def test_a_change_of_the_maximum_age_takes_effect_while_running(own_fleet: Fleet) -> None:
    sealer, opener = own_fleet.pair("camera", "drone-1", "server")
    now = time.time_ns()
    opener.open(sealer.seal(b"x", now=now - 2 * 10**9), now=now)
    own_fleet.publish(POLICY.replace('owner = "drone-1"', 'owner = "drone-1"\nmax_age = 1.0'))
    opener.open(sealer.seal(b"x", now=now), now=now)
    assert reason(opener.open, sealer.seal(b"x", now=now - 2 * 10**9), now=now) == Reason.TOO_OLD


def test_keys_change_while_messages_flow(own_fleet: Fleet) -> None:
    sealer, opener = own_fleet.pair("camera", "drone-1", "server")
    (first,) = receive(opener, sealer.seal(b"x"))
    push = next(push for push in own_fleet.keyrings["drone-1"].rotate("camera", delay=0) if push.node == "server")
    packet = sealer.seal(b"y")
    assert reason(opener.open, packet) == Reason.UNKNOWN_EPOCH
    own_fleet.keyrings["server"].accept("camera", push.grant)
    message = opener.open(packet)
    assert (message.payload, message.sequence) == (b"y", 2)
    assert message.epoch > first.epoch


def test_old_epochs_are_refused_after_the_grace_period(own_fleet: Fleet, monkeypatch) -> None:
    sealer, opener = own_fleet.pair("camera", "drone-2", "server")
    opener.open(sealer.seal(b"x"))
    own_fleet.keyrings["drone-1"].rotate("camera", delay=0)
    give(own_fleet, "server")
    assert opener.open(sealer.seal(b"drone-2 has not heard yet")).sequence == 2
    now = time.time_ns() + 31 * 10**9
    assert reason(opener.open, sealer.seal(b"x", now=now), now=now) == Reason.OLD_EPOCH


def test_a_message_that_is_too_old_is_refused(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("teleop", "operator-1", "server")
    now = time.time_ns()
    assert opener.open(sealer.seal(b"x", now=now), now=now + 400_000_000).payload == b"x"
    assert reason(opener.open, sealer.seal(b"x", now=now), now=now + 600_000_000) == Reason.TOO_OLD


def test_what_a_receiver_remembers_is_bounded_whatever_is_sent(fleet: Fleet, monkeypatch) -> None:
    monkeypatch.setattr(opener_module, "_MAX_STREAMS", 4)
    opener = fleet.opener("server", "camera")
    for _ in range(20):
        opener.open(fleet.sealer("drone-1", "camera").seal(b"x"))
    assert len(opener._streams) == 4
    assert len(opener._members) == 1


def test_a_restarted_sender_is_heard_at_once(fleet: Fleet) -> None:
    opener = fleet.opener("server", "camera")
    for _ in range(3):
        sealer = Sealer(fleet.keyrings["drone-1"], "camera")
        assert [opener.open(sealer.seal(b"x")).sequence for _ in range(3)] == [1, 2, 3]


def test_digests_of_long_messages_depend_on_every_chunk() -> None:
    body = bytearray(3 << 20)
    digests = {digest(body)}
    for at in (0, (1 << 20) - 1, 1 << 20, (3 << 20) - 1):
        body[at] ^= 1
        digests.add(digest(body))
    assert len(digests) == 5
    assert digest(bytes(1 << 20)) != digest(bytes((1 << 20) + 1))


class Emptied(list[bytes]):
    """What its owner uses again as soon as it was read."""

    def __iter__(self) -> Iterator[bytes]:
        yield from [self.pop(0) for _ in range(len(self))]


@pytest.mark.parametrize(("alias", "sender", "receiver"), STREAMS)
def test_a_list_that_changes_while_it_is_sealed_costs_no_number(
    fleet: Fleet, alias: str, sender: str, receiver: str
) -> None:
    """Two messages with one number would be two with one nonce."""
    sealer, _ = fleet.pair(alias, sender, receiver)
    sealer.seal(b"first")
    sealer.seal_many(Emptied([b"a", b"b", b"c"]))
    assert sealer.sequence == 4


def test_sealing_is_safe_from_several_threads(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("camera", "drone-1", "server")
    with ThreadPoolExecutor(4) as pool:
        packets = list(pool.map(lambda k: sealer.seal(bytes([k])), range(100)))
        messages = list(pool.map(opener.open, packets))
    assert sorted(message.sequence for message in messages) == list(range(1, 101))
    assert sorted(message.payload for message in messages) == [bytes([k]) for k in range(100)]


def test_a_sealer_asks_for_its_key_when_it_has_none(tmp_path) -> None:
    fleet = Fleet(tmp_path, share=False)
    with pytest.raises(NoKey, match="drone-2 has no valid key for camera"):
        fleet.sealer("drone-2", "camera").seal(b"x")
    assert keyring_module.Keyring(fleet.homes["drone-2"]).wanted() == ["camera", "grasp", "lidar"]


def test_a_bundle_that_is_damaged_while_a_node_runs_costs_no_message(own_fleet: Fleet, caplog) -> None:
    """What was believed before stays in force; `send` must not raise for it."""
    sealer, opener = own_fleet.pair("camera", "drone-1", "server")
    own_fleet.homes["drone-1"].path.joinpath("bundle").write_bytes(b"?")
    (message,) = receive(opener, sealer.seal(b"on"))
    assert (message.payload, message.sequence) == (b"on", 1)
    assert "holds a file of drone-1 that cannot be believed" in caplog.text
