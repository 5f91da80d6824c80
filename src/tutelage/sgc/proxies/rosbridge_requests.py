"""What rosbridge clients send, checked before anything is done with it."""

from __future__ import annotations

import json
from typing import Any

from tutelage.errors import TutelageError
from tutelage.sgc.proxies.rosbridge_outbox import MAX_QUEUE, Wish

MAX_ID = 200
_COMPRESSIONS = ("none", "png", "cbor", "cbor-raw")


class BadRequest(TutelageError):
    """A message of a client that cannot be obeyed."""


def parse(frame: str | bytes) -> dict[str, Any]:
    """A message: an object with "op".

    Raises:
        BadRequest: it is none.
    """
    if isinstance(frame, bytes):
        raise BadRequest("binary frames (BSON) are not understood; send JSON as text")
    try:
        message = json.loads(frame)
    except (ValueError, RecursionError) as error:
        raise BadRequest(f"not JSON: {str(error)[:100]}") from None
    if not isinstance(message, dict) or not isinstance(message.get("op"), str):
        raise BadRequest('a message is an object with "op"')
    return message


def ident_of(message: dict[str, Any]) -> Any:
    """Its id: text (cut to a sane length) or a number; None for none."""
    ident = message.get("id")
    if isinstance(ident, str):
        return ident[:MAX_ID]
    return ident if isinstance(ident, int) and abs(ident) < 2**63 else None


def text_of(message: dict[str, Any], key: str) -> str:
    """A field that must be text.

    Raises:
        BadRequest: it is not.
    """
    value = message.get(key)
    if not isinstance(value, str):
        raise BadRequest(f"{message['op']} needs {key}, a text")
    return value


def wish_of(message: dict[str, Any]) -> Wish:
    """What a subscribe message asks for.

    Raises:
        BadRequest: something impossible.
    """

    def number(key: str, highest: int) -> int:
        value = message.get(key) or 0
        if not isinstance(value, int | float) or not 0 <= value <= highest:
            raise BadRequest(f"{key} must be a number from 0 to {highest}")
        return int(value)

    compression = message.get("compression") or "none"
    if compression not in _COMPRESSIONS:
        raise BadRequest(f"compression must be one of {', '.join(_COMPRESSIONS)}")
    return Wish(
        throttle=number("throttle_rate", 86_400_000) / 1000,
        queue=min(number("queue_length", 2**31), MAX_QUEUE),
        fragment=number("fragment_size", 2**31) or None,
        compression=compression,
    )
