"""The one way state is written to disk: nested dictionaries of arrays and JSON values in a safetensors file.

Files are replaced atomically (write beside, flush, rename), so a crash or a full disk leaves the previous file whole.
No pickle anywhere: a file from a stranger can be wrong, but it cannot run code.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as save_bytes

from tutelage.errors import TutelageError
from tutelage.files import write_atomic as write_atomic

Tree = dict[str, Any]


def save_tree(path: Path, tree: Tree) -> None:
    """Write a nested dictionary whose leaves are numpy arrays or JSON values. Keys must not contain '/'."""
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    scalars = _split(tree, "", arrays)
    content = save_bytes(
        {name: np.asarray(array, order="C") for name, array in arrays.items()},
        metadata={"json": json.dumps(scalars, allow_nan=True)},
    )
    write_atomic(path, content)


def load_tree(path: Path) -> Tree:
    """Read what `save_tree` wrote.

    Raises:
        TutelageError: no such file, or not a file of this kind.
    """
    try:
        with safe_open(str(path), framework="numpy") as file:
            tree: Tree = json.loads((file.metadata() or {}).get("json", "{}"))
            for name in file.keys():  # noqa: SIM118 - not a dictionary
                *folders, leaf = name.split("/")
                branch = tree
                for folder in folders:
                    branch = branch.setdefault(folder, {})
                branch[leaf] = file.get_tensor(name)
        if not isinstance(tree, dict):
            raise TypeError("its values are not a dictionary")
        return tree
    except FileNotFoundError:
        raise TutelageError(f"no such file: {path}") from None
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        # The header is JSON from a stranger: any type, any depth, any length, any dtype.
        raise TutelageError(f"{path} is damaged or not a Tutelage file: {error}") from None


def _split(tree: Tree, prefix: str, arrays: dict[str, np.ndarray[Any, Any]]) -> Tree:
    """Move the arrays of a tree into `arrays` under their path; return the rest."""
    rest: Tree = {}
    for key, value in tree.items():
        if "/" in key:
            raise ValueError(f"a key must not contain '/': {key!r}")
        if isinstance(value, np.ndarray):
            arrays[prefix + key] = value
        elif isinstance(value, dict):
            rest[key] = _split(value, f"{prefix}{key}/", arrays)
        else:
            rest[key] = value
    return rest
