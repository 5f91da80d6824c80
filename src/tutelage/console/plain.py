"""JSON that every browser reads: numbers that are not finite become null."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """A copy made of JSON values."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def text(value: Any) -> str:
    """As JSON, on one line."""
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"))
    except (ValueError, TypeError):
        return json.dumps(plain(value), allow_nan=False, separators=(",", ":"), default=str)


def text_in_pieces(value: dict[str, Any]) -> str:
    """The same for an object with long lists: one piece after the other, as encoding a long list in one go holds up all
    other threads for as long as it takes."""
    pieces = []
    for name, content in value.items():
        if isinstance(content, list):
            said = "[" + ",".join([text(plain(item)) for item in content]) + "]"
        else:
            said = text(plain(content))
        pieces.append(f"{json.dumps(name)}:{said}")
    return "{" + ",".join(pieces) + "}"


def parsed(value: str) -> Any:
    """JSON from the record; damaged text is shown as it is."""
    try:
        return json.loads(value)
    except ValueError:
        return {"text": value}
