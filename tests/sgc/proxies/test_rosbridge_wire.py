"""How rosbridge packs messages."""

from __future__ import annotations

import base64
import json
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tutelage.sgc.proxies.rosbridge_wire import Defragmenter, dump_cbor, dump_json, dump_png, fragments

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**64), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8"))
    | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(st.characters(codec="utf-8")), inner),
)


@given(VALUES)
def test_cbor_is_read_by_another_implementation(value):
    cbor2 = pytest.importorskip("cbor2")
    assert cbor2.loads(dump_cbor(value)) == value


@pytest.mark.parametrize(
    ("dtype", "tag"),
    [("u1", 64), ("u2", 69), ("u4", 70), ("u8", 71), ("i1", 72), ("i2", 77), ("i4", 78), ("i8", 79), ("f4", 85), ("f8", 86)],
)
def test_arrays_have_the_tags_of_rfc_8746(dtype, tag):
    array = np.arange(5, dtype=dtype)
    packed = dump_cbor(array)
    assert packed[:2] == bytes([0xD8, tag])
    assert packed.endswith(array.tobytes())


def test_truth_values_are_a_list():
    assert dump_cbor(np.array([True, False])) == b"\x82\xf5\xf4"


@pytest.mark.parametrize("text", ["", "a", '{"op":"publish"}', "é" * 1000, "x" * 100_001])
def test_png_holds_the_text_as_pixels_padded_with_line_ends(text):
    png = base64.b64decode(dump_png(text))
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    width, height, depth, colour = struct.unpack(">IIBB", png[16:26])
    assert (depth, colour) == (8, 2)
    at, body = 8, b""
    while at < len(png):
        length, kind = struct.unpack(">I4s", png[at : at + 8])
        content = png[at + 8 : at + 8 + length]
        assert struct.unpack(">I", png[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + content)
        body += content if kind == b"IDAT" else b""
        at += 12 + length
    rows = zlib.decompress(body)
    step = 3 * width + 1
    pixels = b"".join(rows[i * step + 1 : (i + 1) * step] for i in range(height))
    assert pixels.decode().rstrip("\n") == text


@given(st.text(min_size=1), st.integers(1, 50), st.randoms(use_true_random=False))
def test_fragments_come_together_in_any_order(text, size, random):
    pieces = [json.loads(piece) for piece in fragments(text, size, "m")]
    assert all(len(piece["data"]) <= size and piece["op"] == "fragment" for piece in pieces)
    random.shuffle(pieces)
    whole = Defragmenter(10_000)
    assert [whole.add(piece) for piece in pieces] == [None] * (len(pieces) - 1) + [text]


def test_fragments_are_bounded():
    assert len(fragments("x" * 1_000_000, 1, "m")) <= 10_000
    keeper = Defragmenter(100)
    for i in range(1000):
        keeper.add({"id": str(i), "data": "x" * 5, "num": 0, "total": 2})
    assert len(keeper._parts) <= keeper.MOST
    with pytest.raises(ValueError, match="more than 100 characters"):
        keeper.add({"id": "big", "data": "x" * 101, "num": 0, "total": 2})
    assert keeper.add({"id": "new", "data": "ok", "num": 0, "total": 1}) == "ok"


@pytest.mark.parametrize(
    "message",
    [
        {},
        {"id": 1, "data": "x", "num": 1, "total": 1},
        {"id": [], "data": "x", "num": 0, "total": 1},
        {"id": "a", "data": 5, "num": 0, "total": 1},
        {"id": "a", "data": "x", "num": -1, "total": 1},
        {"id": "a", "data": "x", "num": 0, "total": 10**9},
        {"id": "a", "data": "x", "num": "0", "total": 1},
    ],
)
def test_impossible_fragments_are_refused(message):
    with pytest.raises(ValueError, match="a fragment needs"):
        Defragmenter(100).add(message)


def test_fragments_of_two_totals_do_not_fit():
    keeper = Defragmenter(100)
    keeper.add({"id": "a", "data": "x", "num": 4, "total": 5})
    with pytest.raises(ValueError, match="do not fit together"):
        keeper.add({"id": "a", "data": "x", "num": 0, "total": 2})


def test_json_never_holds_what_json_lacks():
    with pytest.raises(ValueError):
        dump_json({"a": float("nan")})
