"""Serialized ROS 2 messages (CDR) to and from plain values: dictionaries, lists, numbers, text, as rosbridge has them.

uint8[] and char[] are base64 text, NaN and infinity are null, times are {"sec", "nanosec"} (as input also secs and nsecs,
and "now" for a stamp).
"""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from tutelage.errors import ConfigError, TutelageError
from tutelage.sgc.proxies.ros_input import BYTES, FLOATS, BadValue, attribute_of, form_of, taker
from tutelage.sgc.proxies.ros_types import EMPTY, RosTypes

Show = Callable[[Any], Any]


class BadMessage(TutelageError):
    """Bytes that are no message of the type."""


class Codec:
    """One message type.

    Args:
        types: where its definition is.
        type_name: such as "sensor_msgs/msg/Image".

    Raises:
        ConfigError: the type is not known, or holds what rosbags cannot serialize.
    """

    def __init__(self, types: RosTypes, type_name: str) -> None:
        self.type_name = types.need(type_name)
        self._store = types.store
        try:
            self._store.get_msgdef(type_name)
        except Exception as error:  # generated code of rosbags; wstring and float128 end here
            raise ConfigError(f"{type_name} cannot be serialized: {error!r}") from None
        self._json = _shows(types, type_name, plain=True)
        self._arrays = _shows(types, type_name, plain=False)
        self._take = taker(types, type_name)

    def values(self, data: bytes, *, arrays: bool = False) -> dict[str, Any]:
        """A message as plain values.

        data: CDR with header.
        arrays: leave numbers in NumPy arrays, and uint8[] as bytes, as CBOR can carry them; NaN stays NaN.

        Raises:
            BadMessage: the bytes are no message of this type.
        """
        try:
            message = self._store.deserialize_cdr(memoryview(data), self.type_name)
            result: dict[str, Any] = (self._arrays if arrays else self._json)(message)
        except Exception as error:  # whatever generated code does with bytes from elsewhere
            raise BadMessage(f"no {self.type_name}: {error}") from None
        return result

    def serialize(self, values: Any) -> bytes:
        """Plain values as a message. Missing fields get their defaults, a missing stamp of a header the present time.

        Raises:
            BadValue: a field that the type does not have, or a value that does not fit.
        """
        message = self._take(values, "")
        try:
            return bytes(self._store.serialize_cdr(message, self.type_name))
        except (struct.error, OverflowError, UnicodeEncodeError) as error:
            raise BadValue(f"{self.type_name}: {error}") from None


def _shows(types: RosTypes, type_name: str, *, plain: bool) -> Show:
    fields = [
        (name, attribute_of(name), _show(types, desc, plain))
        for name, desc in types.store.fielddefs[type_name][1]
        if name != EMPTY
    ]

    def show(message: Any) -> dict[str, Any]:
        return {
            name: getattr(message, attribute) if convert is None else convert(getattr(message, attribute))
            for name, attribute, convert in fields
        }

    return show


def _show(types: RosTypes, desc: Any, plain: bool) -> Show | None:
    """None where the value is shown as it is."""
    form, element, _ = form_of(desc)
    if form == "base":
        return _finite_or_none if plain and element[0] in FLOATS else None
    if form == "name":
        return _shows(types, element, plain=plain)
    inner, detail = form_of(element)[:2]
    if inner == "name":
        each = _shows(types, detail, plain=plain)
        return lambda values: [each(value) for value in values]
    base = detail[0]
    if base in ("string", "wstring"):
        return list
    if base in BYTES:
        return (
            (lambda values: base64.standard_b64encode(values).decode("ascii"))
            if plain
            else (lambda values: values.tobytes())
        )
    if not plain:
        return None
    if base in FLOATS:
        return _finite_list
    return lambda values: values.tolist()


def _finite_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _finite_list(values: Any) -> list[float | None]:
    if np.isfinite(values).all():
        return values.tolist()  # type: ignore[no-any-return]
    return [_finite_or_none(value) for value in values.tolist()]


def _base64(values: Any) -> str:
    return base64.standard_b64encode(values).decode("ascii")
