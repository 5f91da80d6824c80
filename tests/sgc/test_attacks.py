"""Attackers: between the nodes, with a stolen certificate, or as a member of the topic. Each is refused and counted, none
crashes anything, and none delivers a message that its sender did not send, or one twice."""

from __future__ import annotations

import random
import struct
import time
from collections import namedtuple
from collections.abc import Callable

import pytest
from members import Fleet

from tutelage.seeding import derive
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.packet import BODY, HEADER, MAX_PACKET, PROOF, make_header, nonce
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.sealing import Opener, Sealer

STREAMS = [
    ("camera", "drone-1", "server"),
    ("teleop", "operator-1", "server"),
    ("teleop to two", "operator-1", "server"),
    ("lidar", "drone-1", "server"),
]
"""Topics with signatures, a session, two of them, and chains."""
COUNT = 10_000
Fields = namedtuple("Fields", "version mode flags introduction proof epoch sender salt first sent label")
HONEST = [b"%d" % k * 9 for k in range(30)]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> Fleet:
    return Fleet(tmp_path_factory.mktemp("fleet"))


def ends(fleet: Fleet, stream: str, sender: str, receiver: str) -> tuple[Sealer, Opener]:
    """Of one of the streams."""
    alias, *to_two = stream.split(maxsplit=1)
    sealer, opener = fleet.pair(alias, sender, receiver)
    if to_two:
        other = fleet.opener("drone-1", alias)
        other.complete_session(sealer.accept_session(other.offer_session()))
    return sealer, opener


def seeded(name: str) -> random.Random:
    """One stream for each purpose."""
    return random.Random(derive(0, name))


def flip(packets: list[bytes], dice: random.Random) -> bytes:
    """A changed bit."""
    packet = bytearray(dice.choice(packets))
    at = dice.randrange(8 * len(packet))
    packet[at // 8] ^= 1 << at % 8
    return bytes(packet)


def cut(packets: list[bytes], dice: random.Random) -> bytes:
    """The end is missing, or the beginning, or the middle."""
    packet = dice.choice(packets)
    first, last = sorted(dice.sample(range(len(packet) + 1), 2))
    return dice.choice([packet[:first], packet[last:], packet[:first] + packet[last:]])


def grow(packets: list[bytes], dice: random.Random) -> bytes:
    """Something was added."""
    packet = dice.choice(packets)
    at = dice.randrange(len(packet) + 1)
    return packet[:at] + dice.randbytes(dice.randrange(1, 100)) + packet[at:]


def noise(packets: list[bytes], dice: random.Random) -> bytes:
    """Nothing of ours."""
    return dice.randbytes(dice.choice([0, 1, HEADER - 1, HEADER, HEADER + 15, HEADER + 16, 100, 300]))


def header(packets: list[bytes], dice: random.Random) -> bytes:
    """A header with fields of an attacker's choice before the genuine rest."""
    packet = dice.choice(packets)
    fields = Fields._make(struct.unpack(">BBHHHI16s16sQQ16s", packet[:HEADER]))
    changes = {
        "version": dice.choice([0, 1, 2, 255]), "mode": dice.choice([0, 1, 2, 3, 255]), "flags": dice.randrange(65536),
        "epoch": dice.choice([0, fields.epoch - 1, fields.epoch + 1, 2**32 - 1]), "introduction": dice.randrange(65536),
        "proof": dice.choice([0, 1, 8, 15, 16, 24, 48, 80, fields.proof + 1, 65535]), "sender": dice.randbytes(16),
        "salt": dice.randbytes(16), "first": dice.choice([0, 1, fields.first + 1, 2**63, 2**64 - 1]),
        "sent": dice.choice([0, fields.sent + 1, 2**63, 2**64 - 1]), "label": dice.randbytes(16),
    }  # fmt: skip
    chosen = dice.sample(sorted(changes), dice.randrange(1, 4))
    return make_header(*fields._replace(**{name: changes[name] for name in chosen})) + packet[HEADER:]


def splice(packets: list[bytes], dice: random.Random) -> bytes:
    """The beginning of one packet and the end of another."""
    one, other = dice.sample(packets, 2)
    at = dice.randrange(1, min(len(one), len(other)))
    return one[:at] + other[at:]


def honest_packets(sealer: Sealer, now: int) -> list[bytes]:
    """Some plain, one batch, and in chain mode an anchor of its own."""
    packets = [sealer.seal(payload, now=now) for payload in HONEST[:20]]
    packets += [sealer.seal_many(HONEST[20:], now=now), sealer.flush(now=now)]
    return [bytes(packet) for packet in packets if packet is not None]


def deliver(opener: Opener, packets: list[bytes], now: int | None = None) -> list[bytes]:
    """Payloads of what gets through. now: nanoseconds, so that a slow machine makes nothing too old."""
    found = []
    for packet in packets:
        try:
            found += [message.payload for message in opener.open_many(packet, now=now)]
        except Refused as refused:
            assert "\n" not in str(refused)
    return found


@pytest.mark.parametrize("kind", [flip, cut, grow, noise, header, splice], ids=lambda kind: kind.__name__)
@pytest.mark.parametrize(("alias", "sender", "receiver"), STREAMS)
def test_whatever_is_made_of_packets_is_refused(
    fleet: Fleet, alias: str, sender: str, receiver: str, kind: Callable[[list[bytes], random.Random], bytes]
) -> None:
    sealer, opener = ends(fleet, alias, sender, receiver)
    now = time.time_ns()
    genuine = honest_packets(sealer, now)
    dice = seeded(f"{alias} {kind.__name__}")
    end = -24 if alias.endswith("two") else None  # the other receiver's tag is none of our business
    ours = [packet[:end] for packet in genuine]
    attacks = [attack for attack in (kind(genuine, dice) for _ in range(COUNT)) if attack[:end] not in ours]
    assert deliver(opener, attacks, now) == []
    assert opener.refusals.total() == len(attacks)
    assert sorted(deliver(opener, genuine, now)) == sorted(HONEST)  # and nothing of it harmed the honest


@pytest.mark.parametrize(("alias", "sender", "receiver"), STREAMS)
def test_repetition_and_reordering_deliver_every_message_once(fleet: Fleet, alias: str, sender: str, receiver: str) -> None:
    sealer, opener = ends(fleet, alias, sender, receiver)
    now = time.time_ns()
    packets = honest_packets(sealer, now)
    dice = seeded(alias)
    stream = packets * 300
    dice.shuffle(stream)
    assert sorted(deliver(opener, stream, now)) == sorted(HONEST)


@pytest.mark.parametrize(("alias", "sender", "receiver"), STREAMS)
def test_a_restarted_receiver_does_not_take_old_messages_again(fleet: Fleet, alias: str, sender: str, receiver: str) -> None:
    sealer, opener = ends(fleet, alias, sender, receiver)
    old = time.time_ns() - 6 * 10**9
    packets = [bytes(sealer.seal(b"x", now=old)), *([sealer.flush(now=old)] if alias == "lidar" else [])]
    assert deliver(opener, packets) == []
    assert opener.refusals[Reason.STALE] + opener.refusals[Reason.TOO_OLD] == 1


def test_an_oversized_packet_is_refused_before_any_work(fleet: Fleet) -> None:
    opener = fleet.opener("server", "camera")
    with pytest.raises(Refused) as raised:
        opener.open(bytes(MAX_PACKET + 1))
    assert raised.value.reason == Reason.OVERSIZE


def test_a_flood_of_invented_senders_takes_no_memory(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("camera", "drone-1", "server")
    packet = bytes(sealer.seal(b"x"))
    dice = seeded("flood")
    for _ in range(COUNT):
        with pytest.raises(Refused):
            opener.open(packet[:12] + dice.randbytes(32) + packet[44:])
    assert opener.refusals[Reason.TAMPERED] == COUNT
    assert (len(opener._streams), len(opener._members), len(opener._replay._senders)) == (0, 0, 0)


def member_forger(fleet: Fleet, alias: str, victim: str, genuine: Sealer, by: str) -> Sealer:
    """A member of the topic with its key, that seals under another's id and salt, and signs with its own key."""
    forger = fleet.sealer(victim, alias)
    forger.salt, forger.sequence = genuine.salt, genuine.sequence + 1000
    forger.seal(b"")
    forger._home = fleet.homes[by]
    forger._look = lambda now: forger._cipher  # type: ignore[method-assign, assignment, return-value]
    return forger


@pytest.mark.parametrize("introduced", [False, True])
def test_a_subscriber_cannot_speak_for_a_publisher(fleet: Fleet, introduced: bool) -> None:
    """It holds the topic's key, so only the signature stands in its way; it shows its own credential, or none."""
    sealer, opener = fleet.pair("camera", "drone-1", "operator-1")
    opener.open(sealer.seal(b"genuine"))
    forger = member_forger(fleet, "camera", "drone-1", sealer, by="server")
    if introduced:
        forger.introduce()
    with pytest.raises(Refused) as raised:
        opener.open(forger.seal(b"forged"))
    assert raised.value.reason == Reason.FORGED
    assert opener.open(sealer.seal(b"genuine")).sequence == 2


def test_a_subscriber_cannot_speak_for_a_publisher_with_its_credential_either(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("camera", "drone-1", "operator-1")
    forger = member_forger(fleet, "camera", "drone-1", sealer, by="server")
    bundle = fleet.homes["server"]._bundle
    try:
        fleet.homes["server"]._bundle = fleet.homes["drone-1"].bundle  # shows drone-1's, signs with its own key
        forger.introduce()
        packet = forger.seal(b"forged")
    finally:
        fleet.homes["server"]._bundle = bundle
    with pytest.raises(Refused) as raised:
        opener.open(packet)
    assert raised.value.reason == Reason.FORGED


def test_a_subscriber_cannot_publish_in_its_own_name_either(fleet: Fleet) -> None:
    """server may subscribe, and holds all keys; it even says truly who it is."""
    home = fleet.homes["server"]
    rule = home.access.entry("camera").rule
    object.__setattr__(rule, "publish", ("drone-*", "server"))  # in its own copy of the policy
    try:
        packet = fleet.sealer("server", "camera").seal(b"x")
    finally:
        object.__setattr__(rule, "publish", ("drone-*",))
    opener = fleet.opener("operator-1", "camera")
    with pytest.raises(Refused, match="server may not send camera; if it should, add it to the policy") as raised:
        opener.open(packet)
    assert raised.value.reason == Reason.NOT_ALLOWED


def test_a_signed_message_cannot_be_sealed_again_for_another_place(fleet: Fleet) -> None:
    """A member opens a genuine message, and seals it anew, signature and all, under another sequence number."""
    sealer, opener = fleet.pair("camera", "drone-1", "operator-1")
    opener.open(sealer.seal(b"introduction"))
    packet = bytes(sealer.seal(b"go"))
    fields = Fields._make(struct.unpack(">BBHHHI16s16sQQ16s", packet[:HEADER]))
    cipher = sealer._cipher  # members can derive it
    assert cipher is not None
    signature = cipher.decrypt(nonce(PROOF, packet), packet[-80:], packet[:HEADER])
    again = make_header(*fields._replace(first=fields.first + 1))
    body = cipher.encrypt(nonce(BODY, again), b"go", again)
    with pytest.raises(Refused) as raised:
        opener.open(again + body + cipher.encrypt(nonce(PROOF, again), signature, again))
    assert raised.value.reason == Reason.FORGED


def test_a_stolen_certificate_without_the_topics_key_sees_and_says_nothing(tmp_path) -> None:
    """The thief has a member's whole folder except for the keys of topics, and the member is revoked: the owner refuses."""
    fleet = Fleet(tmp_path)
    sealer, opener = fleet.pair("camera", "drone-1", "server")
    opener.open(sealer.seal(b"x"))
    for file in (fleet.homes["operator-1"].path / "keys").iterdir():
        file.unlink()
    thief = Keyring(fleet.homes["operator-1"])
    fleet.revoke("operator-1", tell=["drone-1", "server"])
    with pytest.raises(Refused) as raised:
        fleet.keyrings["drone-1"].answer("camera", thief.ask("camera"))
    assert raised.value.reason == Reason.REVOKED
    with pytest.raises(Refused) as raised:
        Opener(thief, "camera").open(sealer.seal(b"secret"))
    assert raised.value.reason == Reason.UNKNOWN_EPOCH


def test_another_fleet_with_the_same_names_is_another_world(fleet: Fleet, tmp_path) -> None:
    other = Fleet(tmp_path)
    mine, theirs = fleet.homes["server"].access.entry("camera"), other.homes["server"].access.entry("camera")
    assert mine.rule == theirs.rule
    assert mine.name != theirs.name
    packet = other.sealer("drone-1", "camera").seal(b"x")
    with pytest.raises(Refused) as raised:
        fleet.opener("server", "camera").open(packet)
    assert raised.value.reason in (Reason.TAMPERED, Reason.UNKNOWN_EPOCH, Reason.OLD_EPOCH)


CONTROL = (
    "request for a key",
    "grant",
    "bundle",
    "deny list",
    "offer of a session",
    "answer to an offer",
    "request for renewal",
)


def control(fleet: Fleet, what: str) -> tuple[list[bytes], Callable[[bytes], object]]:
    """A few genuine control messages of a kind, and what takes them."""
    owner, member, home = fleet.keyrings["drone-1"], fleet.keyrings["server"], fleet.homes["server"]
    sealer, opener = fleet.sealer("operator-1", "teleop"), fleet.opener("server", "teleop")
    few = range(4)
    if what == "request for a key":
        return [member.ask("camera") for _ in few], lambda message: owner.answer("camera", message)
    if what == "grant":
        grants = [owner.answer("camera", member.ask("camera")) for _ in few]
        return grants, lambda message: member.accept("camera", message)
    if what == "bundle":
        return [fleet.authority.renew(home.request()) for _ in few], home.accept
    if what == "deny list":
        for name in ("m-1", "m-2"):
            fleet.join(name)
        return [fleet.authority.revoke(name) for name in ("m-1", "m-2")], home.accept
    if what == "offer of a session":
        return [opener.offer_session() for _ in few], sealer.accept_session
    if what == "answer to an offer":
        return [sealer.accept_session(opener.offer_session()) for _ in few], opener.complete_session
    return [home.request() for _ in few], fleet.authority.renew


@pytest.mark.parametrize("what", CONTROL)
def test_control_messages_made_of_others_are_refused(fleet: Fleet, what: str) -> None:
    genuine, take = control(fleet, what)
    dice, kinds = seeded(what), (flip, cut, grow, noise, splice)
    harmless = 0
    for k in range(COUNT):
        attack = kinds[k % len(kinds)](genuine, dice)
        if attack in genuine:
            continue
        try:
            take(attack)
            harmless += 1
        except Refused as refused:
            assert "\n" not in str(refused)
    # Text around a signing request, the ends of its lines, and the number of unused bits of a signature mean nothing.
    assert harmless == 0 or what in ("request for renewal", "deny list")
    assert harmless < COUNT / 10
    assert fleet.homes["server"].access.entry("camera").rule.publish == ("drone-*",)
