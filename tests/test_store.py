"""The one file format: round trips, files from strangers, and full disks."""

from __future__ import annotations

import errno
import io
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tutelage.errors import TutelageError
from tutelage.store import load_tree, save_tree, write_atomic

DTYPES = ["bool", "int8", "uint8", "int16", "int32", "int64", "uint64", "float16", "float32", "float64"]
KEYS = st.text(st.characters(exclude_characters="/", exclude_categories=["Cs"]), max_size=6)
NUMBERS = st.one_of(st.none(), st.booleans(), st.integers(), st.floats())
JSON = st.recursive(st.one_of(NUMBERS, st.text(max_size=8)), lambda inner: st.lists(inner, max_size=3), max_leaves=6)
SHAPES = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
ARRAYS = st.sampled_from(DTYPES).flatmap(lambda dtype: hnp.arrays(dtype, SHAPES))
BRANCHES = st.recursive(st.one_of(JSON, ARRAYS), lambda inner: st.dictionaries(KEYS, inner, max_size=4), max_leaves=8)
TREES = st.dictionaries(KEYS, BRANCHES, max_size=4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("store")


def equal(a, b) -> bool:
    """Equal in type, shape and bits; NaN equals NaN."""
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(equal, a, b))
    return type(a) is type(b) and (a == b or a != a)


@given(TREES)
def test_what_is_written_is_read(folder, tree) -> None:
    save_tree(folder / "tree", tree)
    assert equal(load_tree(folder / "tree"), tree)


def test_the_shape_of_a_number_and_of_nothing_survives(folder) -> None:
    tree = {"scalar": np.array(3.0), "none": np.zeros((0, 3)), "columns": np.arange(6).reshape(2, 3).T, "empty": {}}
    save_tree(folder / "tree", tree)
    again = load_tree(folder / "tree")
    assert again["scalar"].shape == ()
    assert again["none"].shape == (0, 3)
    np.testing.assert_array_equal(again["columns"], tree["columns"])
    assert again["empty"] == {}


def test_the_state_of_a_generator_survives(folder) -> None:
    rng = np.random.default_rng(0)
    save_tree(folder / "tree", {"rng": dict(rng.bit_generator.state)})
    assert load_tree(folder / "tree")["rng"] == rng.bit_generator.state  # 128-bit integers


def test_arrays_that_were_read_may_be_written_to(folder) -> None:
    save_tree(folder / "tree", {"a": np.zeros(3)})
    load_tree(folder / "tree")["a"][0] = 1.0


@pytest.mark.parametrize("tree", [{"a/b": 1}, {"a": {"b/c": np.zeros(1)}}, {"a/b": {}}])
def test_a_key_with_a_slash_is_refused_before_anything_is_written(tree, tmp_path) -> None:
    with pytest.raises(ValueError, match="must not contain '/'"):
        save_tree(tmp_path / "tree", tree)
    assert list(tmp_path.iterdir()) == []


# -- files from strangers -------------------------------------------------------------------------------------------


def read(folder: Path, content: bytes):
    """What `load_tree` makes of it: a tree, or None for a `TutelageError` (any other error passes through)."""
    (folder / "strange").write_bytes(content)
    try:
        tree = load_tree(folder / "strange")
    except TutelageError:
        return None
    assert isinstance(tree, dict)
    return tree


def header(entries: dict, data: bytes = b"") -> bytes:
    """A safetensors file with the given header."""
    content = json.dumps(entries).encode()
    return struct.pack("<Q", len(content)) + content + data


def good() -> bytes:
    """The bytes of a file with a bit of everything."""
    array = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}
    return header({"__metadata__": {"json": '{"a": {"n": 1}, "l": [1, 2]}'}, "a/x": array}, bytes(8))


@given(st.binary(max_size=200))
def test_random_bytes_are_refused(folder, content) -> None:
    assert read(folder, content) is None


@given(st.integers(0, len(good()) - 1))
def test_a_truncated_file_is_refused(folder, length) -> None:
    assert read(folder, good()[:length]) is None


@given(st.integers(0, len(good()) - 1), st.integers(1, 255))
def test_a_file_with_a_damaged_byte_is_refused_or_read_as_a_tree(folder, position, change) -> None:
    content = bytearray(good())
    content[position] ^= change
    read(folder, bytes(content))


@given(st.one_of(JSON, st.dictionaries(KEYS, JSON, max_size=3), st.dictionaries(st.sampled_from("ax"), JSON)))
def test_any_json_for_values_is_refused_or_read_as_a_tree(folder, value) -> None:
    array = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}
    read(folder, header({"__metadata__": {"json": json.dumps(value)}, "a/x": array}, bytes(8)))
    tree = read(folder, header({"__metadata__": {"json": json.dumps(value)}}))
    assert (tree is None) == (not isinstance(value, dict))


@pytest.mark.parametrize("text", ["", "nonsense", "[" * 100_000, '{"a":' * 100_000, "1" * 5000, '"x"', "[]", "null"])
def test_strange_values_are_refused(folder, text) -> None:
    assert read(folder, header({"__metadata__": {"json": text}})) is None


@pytest.mark.parametrize("dtype", ["BF16", "F8_E4M3", "F8_E5M2", "Q9"])
def test_a_type_that_numpy_does_not_know_is_refused(folder, dtype) -> None:
    assert read(folder, header({"x": {"dtype": dtype, "shape": [4], "data_offsets": [0, 8]}}, bytes(8))) is None
    assert read(folder, header({"x": {"dtype": dtype, "shape": [8], "data_offsets": [0, 8]}}, bytes(8))) is None


def test_a_file_of_arrays_alone_is_read(folder) -> None:
    tree = read(folder, header({"x": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}}, bytes(8)))
    np.testing.assert_array_equal(tree["x"], [0, 0])


def test_no_file_and_a_folder_are_said_so(tmp_path) -> None:
    with pytest.raises(TutelageError, match=f"no such file: {tmp_path / 'nothing'}"):
        load_tree(tmp_path / "nothing")
    with pytest.raises(TutelageError, match="damaged or not a Tutelage file"):
        load_tree(tmp_path)


# -- full disks -----------------------------------------------------------------------------------------------------


def full(*args, **kwargs):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class FullFile:
    """A file on a disk with room for three bytes."""

    def __init__(self, path, mode) -> None:
        self.file = io.FileIO(path, mode)

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        self.file.close()

    def write(self, content: bytes) -> None:
        self.file.write(content[:3])
        full()


@pytest.mark.parametrize("moment", ["open", "write", "fsync", "rename"])
def test_a_full_disk_leaves_the_old_file_whole_and_nothing_beside_it(moment, tmp_path, monkeypatch) -> None:
    path = tmp_path / "tree"
    save_tree(path, {"a": np.arange(3), "version": 1})
    target = {"open": ("builtins.open", full), "write": ("builtins.open", FullFile), "fsync": ("os.fsync", full),
              "rename": ("os.replace", full)}[moment]  # fmt: skip
    with monkeypatch.context() as patch:
        patch.setattr(*target)
        with pytest.raises(TutelageError, match=f"cannot write {path}: No space left on device; free some space"):
            save_tree(path, {"a": np.arange(999), "version": 2})
    assert equal(load_tree(path), {"a": np.arange(3), "version": 1})
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_cannot_be_made_is_said_so(tmp_path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(TutelageError, match=r"cannot write .*: Not a directory"):
        write_atomic(tmp_path / "file" / "below" / "tree", b"x")
    with pytest.raises(TutelageError, match=r"cannot write .*: File exists"):
        write_atomic(tmp_path / "file" / "tree", b"x")


def test_folders_are_made_and_files_replaced(tmp_path) -> None:
    path = tmp_path / "a" / "b" / "c"
    write_atomic(path, b"one")
    write_atomic(path, b"two")
    assert path.read_bytes() == b"two"
    assert list(path.parent.iterdir()) == [path]
