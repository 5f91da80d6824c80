"""Sessions: pairwise keys, with whom they are made, and when they end."""

from __future__ import annotations

import struct
import time
from dataclasses import replace

import pytest
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from members import POLICY, Fleet

from tutelage.sgc.errors import NotAllowed
from tutelage.sgc.packet import BODY, HEADER, MODES, make_header, message_key, nonce
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Lane
from tutelage.sgc.session import MAX_SESSIONS


@pytest.fixture
def fleet(tmp_path) -> Fleet:
    return Fleet(tmp_path, ["operator-1", "server", "drone-1", "operator-2"])


def reason(call, *arguments, **named) -> Reason:
    with pytest.raises(Refused) as raised:
        call(*arguments, **named)
    return raised.value.reason


def test_each_receiver_has_a_session_of_its_own(fleet: Fleet) -> None:
    sealer = fleet.sealer("operator-1", "teleop")
    openers = [fleet.opener(name, "teleop") for name in ("server", "drone-1")]
    for opener in openers:
        assert opener.complete_session(sealer.accept_session(opener.offer_session())) == "operator-1"
    assert sealer.receivers() == ["drone-1", "server"]
    packet = sealer.seal(b"left")
    assert [opener.open(packet).payload for opener in openers] == [b"left", b"left"]


def test_without_a_session_a_packet_is_refused_and_says_so(fleet: Fleet) -> None:
    sealer, opener = fleet.sealer("operator-1", "teleop"), fleet.opener("server", "teleop")
    assert reason(opener.open, sealer.seal(b"x")) == Reason.NO_SESSION


def test_a_restarted_sender_needs_a_new_session(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("teleop", "operator-1", "server")
    opener.open(sealer.seal(b"x"))
    again = fleet.sealer("operator-1", "teleop")
    assert reason(opener.open, again.seal(b"x")) == Reason.NO_SESSION
    opener.complete_session(again.accept_session(opener.offer_session()))
    assert opener.open(again.seal(b"x")).payload == b"x"
    assert opener.open(sealer.seal(b"x")).payload == b"x"


def test_a_receiver_with_a_session_cannot_forge_for_another_receiver(fleet: Fleet) -> None:
    """drone-1 knows the topic's key and its own session's; it makes a packet of operator-1's for server, tag and all."""
    sealer, honest = fleet.pair("teleop", "operator-1", "server")
    traitor = fleet.opener("drone-1", "teleop")
    traitor.complete_session(sealer.accept_session(traitor.offer_session()))
    forger = fleet.sealer("operator-1", "teleop")  # stands for drone-1 using the topic's key under operator-1's id and salt
    forger.salt, forger.sequence = sealer.salt, sealer.sequence + 10
    forger.seal(b"")
    forger._open(list(traitor._sessions.values()))
    forged = forger.seal(b"stop everything")
    assert traitor.open(forged).payload == b"stop everything"  # it can only fool itself
    assert reason(honest.open, forged) == Reason.NO_SESSION
    forger._open(
        [
            replace(own, ident=other.ident)
            for own, other in zip(traitor._sessions.values(), honest._sessions.values(), strict=True)
        ]
    )
    assert reason(honest.open, forger.seal(b"stop everything")) == Reason.TAMPERED  # it does not have the key of the two
    forger._open(2 * forger._sessions)
    assert reason(honest.open, forger.seal(b"stop everything")) == Reason.FORGED  # nor can it make their tag


def test_only_receivers_may_offer_and_only_senders_may_answer(fleet: Fleet) -> None:
    sealer = fleet.sealer("operator-1", "teleop")
    stranger = fleet.opener("server", "teleop")
    stranger._handshake._home = fleet.homes["operator-2"]  # it publishes, but does not subscribe
    assert reason(sealer.accept_session, stranger.offer_session()) == Reason.NOT_ALLOWED
    assert sealer.refusals[Reason.NOT_ALLOWED] == 1
    opener, impostor = fleet.opener("server", "teleop"), fleet.sealer("operator-1", "teleop")
    impostor._handshake._home = fleet.homes["drone-1"]
    assert reason(opener.complete_session, impostor.accept_session(opener.offer_session())) == Reason.NOT_ALLOWED


def test_an_answer_in_the_name_of_another_sender_is_refused(fleet: Fleet) -> None:
    opener, impostor = fleet.opener("server", "teleop"), fleet.sealer("operator-1", "teleop")
    impostor._handshake._home = fleet.homes["operator-2"]
    assert reason(opener.complete_session, impostor.accept_session(opener.offer_session())) == Reason.FORGED


def test_a_repeated_offer_is_refused(fleet: Fleet) -> None:
    sealer, opener = fleet.sealer("operator-1", "teleop"), fleet.opener("server", "teleop")
    offer = opener.offer_session()
    sealer.accept_session(offer)
    assert reason(sealer.accept_session, offer) == Reason.REPLAYED
    assert sealer.receivers() == ["server"]


def test_an_old_offer_is_refused(fleet: Fleet, monkeypatch) -> None:
    sealer, opener = fleet.sealer("operator-1", "teleop"), fleet.opener("server", "teleop")
    offer, now = opener.offer_session(), time.time()
    answer = sealer.accept_session(offer)
    monkeypatch.setattr("tutelage.sgc.session.time.time", lambda: now + 100)
    assert reason(fleet.sealer("operator-1", "teleop").accept_session, offer) == Reason.TOO_OLD
    assert reason(opener.complete_session, answer) == Reason.REPLAYED


def test_an_answer_to_somebody_elses_offer_is_refused(fleet: Fleet) -> None:
    sealer = fleet.sealer("operator-1", "teleop")
    one, other = fleet.opener("server", "teleop"), fleet.opener("server", "teleop")
    assert reason(other.complete_session, sealer.accept_session(one.offer_session())) == Reason.REPLAYED


@pytest.mark.parametrize("which", ["offer", "answer"])
def test_a_handshake_with_a_changed_byte_is_refused(fleet: Fleet, which: str) -> None:
    sealer, opener = fleet.sealer("operator-1", "teleop"), fleet.opener("server", "teleop")
    offer = opener.offer_session()
    message = bytearray(offer if which == "offer" else sealer.accept_session(offer))
    take = sealer.accept_session if which == "offer" else opener.complete_session
    for at in range(0, len(message), 7):
        message[at] ^= 1
        assert reason(take, bytes(message)) == Reason.TAMPERED
        message[at] ^= 1
    for wrong in (b"", b"x" * 20, bytes(1 << 20)):
        assert reason(take, wrong) in (Reason.MALFORMED, Reason.OVERSIZE)


def test_sessions_are_few_and_those_of_one_node_do_not_push_out_others(fleet: Fleet) -> None:
    sealer = fleet.sealer("operator-1", "teleop")
    quiet = fleet.opener("drone-1", "teleop")
    quiet.complete_session(sealer.accept_session(quiet.offer_session()))
    for _ in range(3 * MAX_SESSIONS):
        sealer.accept_session(fleet.opener("server", "teleop").offer_session())
    assert sealer.receivers() == ["drone-1", "server"]
    assert quiet.open(sealer.seal(b"x")).payload == b"x"
    assert len(sealer._sessions) == 3


def test_a_session_ends_with_the_certificate_and_with_revocation(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("teleop", "operator-2", "server")
    opener.open(sealer.seal(b"x"))
    other = fleet.opener("drone-1", "teleop")
    other.complete_session(sealer.accept_session(other.offer_session()))
    fleet.revoke("drone-1", tell=["operator-2"])
    opener.open(sealer.seal(b"x"))
    assert sealer.receivers() == ["server"]
    fleet.revoke("operator-2", tell=["server"])
    assert reason(opener.open, sealer.seal(b"x")) == Reason.REVOKED


def test_packets_of_a_session_carry_no_credential(fleet: Fleet) -> None:
    """A credential excuses a packet from the look at whom its stream is known to be of."""
    sealer, opener = fleet.pair("teleop", "operator-2", "server")
    packet = sealer.seal(b"x")
    version, mode, flags, _, *rest = struct.unpack(">BBHHHI16s16sQQ16s", packet[:HEADER])
    forged = make_header(version, mode, flags, 3, *rest) + b"abc" + packet[HEADER:]
    assert reason(opener.open, forged) == Reason.MALFORMED
    assert opener.open(packet).payload == b"x"


def test_a_session_ends_when_the_policy_says_so(fleet: Fleet) -> None:
    sealer, _ = fleet.pair("teleop", "operator-1", "server")
    fleet.publish(POLICY.replace('subscribe = ["drone-1", "server"]', 'subscribe = ["drone-1"]'))
    sealer.seal(b"x")
    assert sealer.receivers() == []


def test_other_topics_have_no_sessions(fleet: Fleet) -> None:
    offer = fleet.opener("server", "teleop").offer_session()
    with pytest.raises(NotAllowed, match='camera has authenticity "signature" in the policy, so it has no sessions'):
        fleet.sealer("drone-1", "camera").accept_session(offer)
    assert len(set(MODES.values())) == 3


def test_what_a_message_is_bound_to_is_under_the_tag_of_the_session(fleet: Fleet) -> None:
    """A member knows the topic's key, so it can find other bytes for which the tag of AES-GCM is the same: two blocks that
    differ by x and x * H cancel in GHASH. The session's tag must not let them pass."""

    def times(x: int, y: int) -> int:  # in GF(2^128), as GHASH counts its bits
        product = 0
        for bit in range(127, -1, -1):
            product ^= x if y >> bit & 1 else 0
            x = x >> 1 ^ (0xE1 << 120 if x & 1 else 0)
        return product

    sealer, opener = fleet.pair("teleop", "operator-1", "server")
    second = fleet.opener("drone-1", "teleop")
    second.complete_session(sealer.accept_session(second.offer_session()))
    bind = bytes(range(40))
    packet = sealer.seal(b"yes", bind=bind)
    _, _, _, _, _, epoch, sender, salt, *_ = struct.unpack(">BBHHHI16s16sQQ16s", packet[:HEADER])
    entry = fleet.homes["server"].access.entry("teleop")
    epoch_key = fleet.keyrings["server"].opening("teleop", epoch).key
    key = message_key(epoch_key, bytes(entry.name), Lane.STREAM, epoch, sender, salt)
    encryptor = Cipher(algorithms.AES(key), modes.ECB()).encryptor()
    h = int.from_bytes(encryptor.update(bytes(16)), "big")
    difference = bytes(4) + (1).to_bytes(16, "big") + times(1, h).to_bytes(16, "big") + bytes(4)
    other = bytes(a ^ b for a, b in zip(bind, difference, strict=True))
    with pytest.raises(Refused) as raised:
        opener.open(packet, bind=other)
    assert raised.value.reason == Reason.FORGED
    with pytest.raises(Refused):
        opener.open(packet)
    assert opener.open(packet, bind=bind).payload == b"yes"


def meet(sealer, opener) -> None:
    opener.complete_session(sealer.accept_session(opener.offer_session()))


def test_a_message_for_one_receiver_is_sealed_for_it_alone(fleet: Fleet) -> None:
    """Other members of the topic, who have its key, cannot even read it; a second receiver ends that."""
    sealer, opener = fleet.pair("teleop", "operator-1", "server")
    other = fleet.opener("drone-1", "teleop")
    packet = sealer.seal(b"left", bind=b"request")
    assert reason(other.open, packet, bind=b"request") == Reason.NO_SESSION
    with pytest.raises(InvalidTag):
        sealer._cipher.decrypt(nonce(BODY, packet[:HEADER]), packet[HEADER:-8], packet[:HEADER] + b"request")
    assert reason(opener.open, packet, bind=b"another") == Reason.TAMPERED
    assert opener.open(packet, bind=b"request").payload == b"left"
    meet(sealer, other)
    both = sealer.seal(b"right")
    assert [each.open(both).payload for each in (opener, other)] == [b"right", b"right"]
    assert len(both) == len(sealer.seal(b"right"))


def test_a_session_alone_ends_with_the_epoch_of_the_topic_too(fleet: Fleet) -> None:
    """Who is denied the next key of the topic cannot read on, although the session is open."""
    sealer, opener = fleet.pair("teleop", "operator-1", "server")
    before = sealer.seal(b"x")
    pushes = {push.node: push.grant for push in fleet.keyrings["operator-1"].rotate("teleop", delay=0.0)}
    after = sealer.seal(b"y")
    assert opener.open(before).payload == b"x"
    assert reason(opener.open, after) == Reason.UNKNOWN_EPOCH
    fleet.keyrings["server"].accept("teleop", pushes["server"])
    assert opener.open(after).payload == b"y"


def test_a_renewed_session_replaces_the_earlier_one(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("teleop", "operator-1", "server")
    assert opener.replacements() == []
    early = sealer.seal(b"early")
    meet(sealer, opener)
    assert len(sealer._sessions) == 2
    between = sealer.seal(b"between")
    (replacement,) = opener.replacements()
    assert opener.replacements() == []
    sealer.end_session(replacement)
    sealer.end_session(replacement)  # repeated by a router
    assert len(sealer._sessions) == 1
    late = sealer.seal(b"late")
    assert [opener.open(packet).payload for packet in (late, between, early)] == [b"late", b"between", b"early"]


def test_nobody_else_can_end_a_session(fleet: Fleet) -> None:
    """Neither a router with bytes of its own, nor another receiver, nor a replacement that went to another sender."""
    sealer, opener = fleet.pair("teleop", "operator-1", "server")
    traitor = fleet.opener("drone-1", "teleop")
    meet(sealer, traitor)
    victim, own = sealer._sessions
    for wrong in (b"", b"x" * 31, own.ident + victim.ident + b"x" * 16):
        assert reason(sealer.end_session, wrong) in (Reason.MALFORMED, Reason.FORGED)
    sealer.end_session(own.replacing(victim.ident))  # genuine, but about a session that is not its own
    sealer.end_session(b"x" * 32)  # of another sender
    assert sealer._sessions == [victim, own]
    meet(sealer, opener)
    (replacement,) = opener.replacements()
    fleet.sealer("operator-2", "teleop").end_session(replacement)
    for at in range(8, len(replacement)):
        changed = bytearray(replacement)
        changed[at] ^= 1
        assert reason(sealer.end_session, bytes(changed)) == Reason.FORGED
    assert len(sealer._sessions) == 3
    sealer.end_session(replacement)
    assert victim not in sealer._sessions
    assert len(sealer._sessions) == 2


def test_an_expired_session_of_a_packet_does_not_hide_the_one_that_is_open(fleet: Fleet) -> None:
    sealer, opener = fleet.pair("teleop", "operator-1", "server")
    meet(sealer, opener)
    first = next(iter(opener._sessions))
    opener._sessions[first] = replace(opener._sessions[first], until=0)
    assert opener.open(sealer.seal(b"x")).payload == b"x"


def test_a_repeated_answer_ends_nothing(fleet: Fleet) -> None:
    """The network may deliver twice, and a router may at will."""
    sealer, opener = fleet.sealer("operator-1", "teleop"), fleet.opener("server", "teleop")
    answers = [sealer.accept_session(opener.offer_session()) for _ in range(2)]
    opener.complete_session(answers[0])
    opener.complete_session(answers[0])
    assert opener.replacements() == []
    opener.complete_session(answers[1])
    (replacement,) = opener.replacements()
    sealer.end_session(replacement)
    for answer in answers:
        assert opener.complete_session(answer) == "operator-1"
    assert opener.replacements() == []
    assert opener.open(sealer.seal(b"x")).payload == b"x"
    (session,) = sealer._sessions
    sealer.end_session(session.replacing(session.ident))
    assert sealer._sessions == [session]


def test_a_session_under_a_new_certificate_outlives_the_old_one(tmp_path) -> None:
    """Also if nothing was opened under it before the old certificate ended."""
    fleet = Fleet(tmp_path, ["drone-1", "server"], share=False)
    home = fleet.join("operator-1", hours=0.3)
    fleet.share()
    sealer, opener = fleet.pair("teleop", "operator-1", "server")
    opener.open(sealer.seal(b"x"))
    home.accept(fleet.authority.issue(home.request(), hours=24))
    meet(sealer, opener)
    later = time.time_ns() + round(0.4 * 3600e9)
    assert opener.open(sealer.seal(b"y", now=later), now=later).payload == b"y"


def test_a_session_does_not_print_its_secret(fleet: Fleet) -> None:
    sealer, _ = fleet.pair("teleop", "operator-1", "server")
    (session,) = sealer._sessions
    assert repr(session.secret) not in repr(session)
