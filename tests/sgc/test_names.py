"""Names: deterministic, injective, unrelated after any change, and nothing without the secret."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tutelage.errors import ConfigError
from tutelage.sgc.names import Name, Topic
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.wire import pack, unpack

words = st.text(st.characters(codec="utf-8"), max_size=12)
topics = st.builds(
    Topic, node=words.filter(bool), interface=words.filter(bool), type=words, author=words, maintainer=words,
    description=words, unique=words,
)  # fmt: skip
secrets = st.binary(min_size=32, max_size=32)
CAMERA = Topic("drone-1", "/camera", "sensor_msgs/msg/Image", "ann", "bob", "front", "7")


@given(topics, topics, secrets)
def test_different_metadata_gives_different_bytes_and_names(one: Topic, other: Topic, secret: bytes) -> None:
    assert (one.canonical() == other.canonical()) == (one == other)
    assert (Name.of(one, secret) == Name.of(other, secret)) == (one == other)


@given(st.lists(st.binary(max_size=6), max_size=5), st.lists(st.binary(max_size=6), max_size=5))
def test_packing_is_injective_and_unpacking_undoes_it(one: list[bytes], other: list[bytes]) -> None:
    assert (pack(*one) == pack(*other)) == (one == other)
    assert unpack(pack(*one), len(one)) == one


@given(st.binary(max_size=40), st.integers(0, 4))
def test_unpacking_refuses_whatever_was_not_packed(data: bytes, count: int) -> None:
    try:
        assert pack(*unpack(data, count)) == data
    except Refused as refused:
        assert refused.reason == Reason.MALFORMED


def test_moving_a_character_between_fields_changes_the_name() -> None:
    assert Topic("ab", "c", "t").canonical() != Topic("a", "bc", "t").canonical()


@given(topics, secrets)
def test_a_name_is_deterministic(topic: Topic, secret: bytes) -> None:
    assert Name.of(topic, secret) == Name.of(dataclasses.replace(topic), secret)


def test_a_name_is_the_same_in_another_process_and_version() -> None:
    code = (
        "from tutelage.sgc.names import *; "
        "print(Name.of(Topic('drone-1', '/camera', 'sensor_msgs/msg/Image', 'ann', 'bob', 'front', '7'), bytes(32)).hex())"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert said == Name.of(CAMERA, bytes(32)).hex()
    assert said == "dfeb5031d3a1cab0a6cd372aec5322d789e23df1b6ba9b98da1218045b891b4c"


@given(topics, secrets, st.sampled_from([field.name for field in dataclasses.fields(Topic)]), st.integers(0, 255))
def test_any_change_of_metadata_or_secret_changes_about_half_of_the_bits(
    topic: Topic, secret: bytes, field: str, bit: int
) -> None:
    name = Name.of(topic, secret)
    other_topic = dataclasses.replace(topic, **{field: getattr(topic, field) + "x"})
    other_secret = (int.from_bytes(secret, "big") ^ 1 << bit).to_bytes(32, "big")
    for other in (Name.of(other_topic, secret), Name.of(topic, other_secret)):
        changed = (int.from_bytes(name, "big") ^ int.from_bytes(other, "big")).bit_count()
        assert 76 <= changed <= 180  # 128 with a standard deviation of 8


def test_metadata_that_is_guessed_right_does_not_give_the_name_without_the_secret() -> None:
    assert Name.of(CAMERA, bytes(32)) != Name.of(CAMERA, bytes(31) + b"\1")


def test_text_that_looks_the_same_is_the_same() -> None:
    assert Topic("café", "/a", "t") == Topic("cafe\u0301", "/a", "t")


def test_channels_are_never_topics() -> None:
    assert Name.of_channel("notices", bytes(32)) != Name.of(CAMERA, bytes(32))
    assert Name.of_channel("a", bytes(32)) != Name.of_channel("b", bytes(32))


def test_a_name_does_not_print_itself_whole() -> None:
    name = Name.of(CAMERA, bytes(32))
    assert str(name) == repr(name) == f"Name({name.hex()[:8]}...)"


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Topic("", "/camera", "t"), "needs a node and an interface"),
        (lambda: Topic("a", "b", "\ud800"), "characters that UTF-8 cannot"),
        (lambda: Topic("a", 3, "t"), "must be text, not 3"),
        (lambda: Name.of(CAMERA, b"short"), "has 32 bytes, not 5"),
        (lambda: Name(b"short"), "has 32 bytes, not 5"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(make, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as raised:
        make()
    assert "\n" not in str(raised.value)
