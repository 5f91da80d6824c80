"""Messages between robots and server: what is packed is what is read, and nothing else is read."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tutelage.remote import messages, wire
from tutelage.remote.jpeg import decode, encode

boots = st.integers(1, 2**64 - 1)
counts = st.integers(1, 2**64 - 1)
floats = st.floats(-1e9, 1e9)
seen = st.sampled_from([np.float32, np.float64, np.uint8]).flatmap(
    lambda dtype: arrays.arrays(
        dtype, arrays.array_shapes(max_dims=4, max_side=5),
        elements=st.floats(-1e6, 1e6, width=32) if dtype != np.uint8 else None,
    )
)  # fmt: skip
actions = arrays.arrays(np.float32, st.integers(0, 9), elements=st.floats(-1e6, 1e6, width=32))
observations = st.builds(
    messages.Observation, boots, counts, st.integers(1, 2**32 - 1), st.integers(0, 2**32 - 1),
    st.integers(0, 127).map(messages.Flag), st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1),
    st.floats(0, 1e6, width=32), floats, st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1),
    seen, st.none() | actions,
)  # fmt: skip
commands = st.builds(
    messages.Command, boots, counts, boots, counts, st.integers(0, 7).map(messages.Order), st.integers(0, 2**16 - 1),
    st.floats(0, 100, width=32), actions,
)  # fmt: skip
stops = st.builds(messages.Stop, boots, counts, st.sampled_from(messages.StopOperation))
asks = st.builds(messages.Ask, boots, counts, st.sampled_from(messages.Operation), st.none() | st.integers(0, 2**64 - 1))
answers = st.builds(messages.Answer, st.booleans(), boots, st.integers(0, 2**32 - 1))
DESCRIPTION = messages.Description((2,), "float32", (-1.0,), (1.0,), cameras=("front",))
PICTURE = messages.Picture(1, 1, 0, 64, 48, encode(np.zeros((48, 64, 3), np.uint8)))

KINDS: list[tuple[Any, Callable[[Any], bytes], Callable[[bytes], Any]]] = [
    (observations, wire.pack_observation, wire.unpack_observation),
    (commands, wire.pack_command, wire.unpack_command),
    (stops, wire.pack_stop, wire.unpack_stop),
    (asks, wire.pack_ask, wire.unpack_ask),
    (answers, wire.pack_answer, wire.unpack_answer),
    (st.just(DESCRIPTION), wire.pack_description, wire.unpack_description),
    (st.builds(messages.Weights, st.integers(0, 2**32 - 1), st.binary(max_size=50)), wire.pack_weights, wire.unpack_weights),
    (st.just(PICTURE), wire.pack_picture, wire.unpack_picture),
]


def same(a: Any, b: Any) -> bool:
    """The same message, arrays included."""
    for name in type(a).__dataclass_fields__:
        one, other = getattr(a, name), getattr(b, name)
        if isinstance(one, np.ndarray):
            if one.dtype != other.dtype or not np.array_equal(one, other):
                return False
        elif one != other:
            return False
    return True


@pytest.mark.parametrize(("kinds", "pack", "unpack"), KINDS)
@given(data=st.data())
def test_what_is_packed_is_what_is_read(kinds: Any, pack: Any, unpack: Any, data: st.DataObject) -> None:
    message = data.draw(kinds)
    assert same(unpack(pack(message)), message)


@pytest.mark.parametrize(("kinds", "pack", "unpack"), KINDS)
@given(data=st.data())
def test_damaged_messages_are_refused_or_read_but_raise_nothing_else(
    kinds: Any, pack: Any, unpack: Any, data: st.DataObject
) -> None:
    whole = bytearray(pack(data.draw(kinds)))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(whole[: data.draw(st.integers(0, len(whole)))]) + data.draw(st.binary(max_size=8))
    for bad in (bytes(whole), cut):
        try:
            unpack(bad)
        except messages.Malformed as error:
            assert "\n" not in str(error)


@given(data=st.binary(max_size=200))
def test_noise_is_refused(data: bytes) -> None:
    for _, _, unpack in KINDS:
        with pytest.raises(messages.Malformed):
            unpack(data)


@pytest.mark.parametrize(("kinds", "pack", "unpack"), KINDS)
def test_a_message_of_one_kind_is_not_read_as_another_nor_of_another_version(kinds: Any, pack: Any, unpack: Any) -> None:
    whole = wire.pack_stop(messages.Stop(1, 1, messages.StopOperation.STOP))
    if unpack is not wire.unpack_stop:
        with pytest.raises(messages.Malformed):
            unpack(whole)
    with pytest.raises(messages.Malformed, match="version 9; this program speaks version 1"):
        wire.unpack_stop(whole[:2] + b"\x09" + whole[3:])


def test_an_array_cannot_claim_more_than_its_message_holds() -> None:
    command = wire.pack_command(messages.Command(1, 1, 1, 1, messages.Order.ACT, 0, 0.1, np.zeros(1, np.float32)))
    huge = command[:-8] + b"\xff\xff\xff\xff" + command[-4:]
    with pytest.raises(messages.Malformed, match="longer than its message"):
        wire.unpack_command(huge)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_are_finite(bad: float) -> None:
    action = np.array([bad], np.float32)
    with pytest.raises(messages.Malformed, match="not finite"):
        wire.unpack_command(wire.pack_command(messages.Command(1, 1, 1, 1, messages.Order.ACT, 0, 0.1, action)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("shape", []), ("shape", [0]), ("shape", [1 << 30, 1 << 30]), ("dtype", "object"), ("action_low", [2.0]),
        ("action_low", []), ("horizon", 0), ("horizon", True), ("task", 3), ("goal", 1), ("dt", 0), ("dt", float("nan")),
        ("cameras", ["a", "a"]), ("cameras", [""]), ("cameras", ["x"] * 17),
    ],
)  # fmt: skip
def test_impossible_descriptions_are_refused_by_the_name_of_the_field(field: str, value: object) -> None:
    table = {**DESCRIPTION.to_json(), field: value}
    with pytest.raises(messages.Malformed, match=field):
        messages.Description.from_json(json.loads(json.dumps(table)))


def test_pictures_survive_compression_and_lies_about_their_size_do_not() -> None:
    rgb = np.zeros((48, 64, 3), np.uint8)
    rgb[:, :32, 0] = 200
    assert abs(decode(encode(rgb, 90)).astype(int) - rgb).mean() < 3
    lie = messages.Picture(1, 1, 0, 640, 480, PICTURE.jpeg)
    with pytest.raises(messages.Malformed, match="no JPEG of the size"):
        wire.unpack_picture(wire.pack_picture(lie))
    bomb = PICTURE.jpeg.replace((48).to_bytes(2, "big") + (64).to_bytes(2, "big"), b"\xff\xff\xff\xff")
    with pytest.raises(messages.Malformed):
        decode(bomb)
