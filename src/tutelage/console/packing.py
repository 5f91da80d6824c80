"""Trees of arrays as bytes, for pipes between processes: a JSON header and safetensors, never pickle."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from safetensors.numpy import load, save

Tree = dict[str, Any]
_LENGTH = struct.Struct("<I")


def pack(tree: Tree) -> bytes:
    """A nested dictionary whose leaves are numpy arrays or JSON values, with string keys without "/"."""
    arrays: dict[str, Any] = {}
    header = json.dumps(_split(tree, "", arrays)).encode()
    return _LENGTH.pack(len(header)) + header + save({k: np.asarray(a, order="C") for k, a in arrays.items()})


def unpack(content: bytes) -> Tree:
    """What `pack` was given."""
    (length,) = _LENGTH.unpack_from(content)
    tree: Tree = json.loads(content[_LENGTH.size : _LENGTH.size + length])
    for path, array in load(content[_LENGTH.size + length :]).items():
        *folders, leaf = path.split("/")
        branch = tree
        for folder in folders:
            branch = branch.setdefault(folder, {})
        branch[leaf] = array
    return tree


def _split(tree: Tree, prefix: str, arrays: dict[str, Any]) -> Tree:
    rest: Tree = {}
    for key, value in tree.items():
        if isinstance(value, np.ndarray):
            arrays[prefix + key] = value
        elif isinstance(value, dict):
            rest[key] = _split(value, f"{prefix}{key}/", arrays)
        else:
            rest[key] = value
    return rest
