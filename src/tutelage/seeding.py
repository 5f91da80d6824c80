"""Every random stream of a run comes from one root seed and a name.

`derive(seed, "policy")` is a 63-bit integer that depends on both, so adding a stream never shifts another one,
and the same seed gives the same run on the same machine.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np


def derive(seed: int, name: str) -> int:
    """The seed of the stream `name` under the root `seed`: 63 bits of SHA-256, independent for any two names."""
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def stream(seed: int, name: str) -> np.random.Generator:
    """A numpy generator for the stream `name` under the root `seed`."""
    return np.random.Generator(np.random.PCG64(derive(seed, name)))


def rng_state(rng: np.random.Generator) -> dict[str, Any]:
    """The state of a generator as plain JSON values."""
    return dict(rng.bit_generator.state)


def set_rng_state(rng: np.random.Generator, state: dict[str, Any]) -> None:
    """Restore what `rng_state` returned."""
    rng.bit_generator.state = state
