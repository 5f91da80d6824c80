"""Plain values from a client to a ROS 2 message: everything is checked against the type, and errors name the field."""

from __future__ import annotations

import base64
import binascii
import keyword
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from tutelage.errors import TutelageError
from tutelage.sgc.proxies.ros_types import EMPTY, RosTypes

_INTEGERS = {
    name: (int(np.iinfo(kind).min), int(np.iinfo(kind).max))
    for name, kind in {
        "byte": np.int8,
        "char": np.uint8,
        **{f"{sign}int{bits}": getattr(np, f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)},
    }.items()
}
FLOATS = ("float32", "float64")
_DTYPES = {"byte": np.int8, "char": np.uint8, "bool": np.bool_}
BYTES = ("uint8", "char")
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_TIME_FIELDS = {"secs": "sec", "nsecs": "nanosec"}
_HEADER = "std_msgs/msg/Header"
_NUMBER = "a number"

Take = Callable[[Any, str], Any]


class BadValue(TutelageError):
    """A value that does not fit the type; the message names the field."""


def attribute_of(field: str) -> str:
    """The name that rosbags gives to a field."""
    return f"{field}_" if keyword.iskeyword(field) else field


def form_of(desc: Any) -> tuple[str, Any, int | None]:
    """(form, element, count): base, name, array or sequence; count: length of an array, or bound of a sequence (0: none)."""
    form = desc[0].name.lower()
    if form == "base":
        return "base", desc[1], None
    if form == "name":
        return "name", desc[1], None
    element, count = desc[1]
    return form, element, count


def taker(types: RosTypes, type_name: str) -> Take:
    """What makes messages of a type (objects of rosbags) from values; raises `BadValue`."""
    cls = types.store.types[type_name]
    fields = {name: (attribute_of(name), _take(types, desc)) for name, desc in types.store.fielddefs[type_name][1]}
    is_time, is_header = type_name in _TIMES, type_name == _HEADER

    def take(value: Any, path: str) -> Any:
        if is_time and value in ("now", None) and type_name == _TIMES[0]:
            value = _now()
        if not isinstance(value, dict):
            raise BadValue(f"{path or type_name} must be an object, not {_shown(value)}")
        given = {}
        for name, item in value.items():
            name = str(_TIME_FIELDS.get(name, name) if is_time else name)
            if is_header and name == "seq":  # of ROS 1; many clients still send it
                continue
            if name not in fields or name == EMPTY:
                raise BadValue(f"{type_name} has no field {_join(path, name)!r}")
            attribute, convert = fields[name]
            given[attribute] = convert(item, _join(path, name))
        if is_header and "stamp" not in given:
            given["stamp"] = fields["stamp"][1]("now", _join(path, "stamp"))
        for attribute, convert in fields.values():
            if attribute not in given:
                given[attribute] = convert(_MISSING, _join(path, attribute))
        return cls(**given)

    def take_or_default(value: Any, path: str) -> Any:
        return take({"sec": 0, "nanosec": 0} if value is _MISSING and is_time else {} if value is _MISSING else value, path)

    return take_or_default


_MISSING: Any = object()


def _take(types: RosTypes, desc: Any) -> Take:
    form, element, count = form_of(desc)
    if form == "base":
        return _take_base(*element)
    if form == "name":
        return taker(types, element)
    fixed = count if form == "array" else None
    bound = count if form == "sequence" and count else None
    inner, detail = form_of(element)[:2]
    if inner == "base" and detail[0] not in ("string", "wstring"):
        return _take_numbers(detail[0], fixed, bound)
    each = taker(types, detail) if inner == "name" else _take_base(*detail)

    def take(value: Any, path: str) -> list[Any]:
        if value is _MISSING:
            return [each(_MISSING, path) for _ in range(fixed or 0)]
        if not isinstance(value, list):
            raise BadValue(f"{path} must be a list, not {_shown(value)}")
        _check_length(len(value), fixed, bound, path)
        return [each(item, f"{path}[{i}]") for i, item in enumerate(value)]

    return take


def _take_base(name: str, bound: int = 0) -> Take:
    if name in ("string", "wstring"):

        def text(value: Any, path: str) -> str:
            if value is _MISSING:
                return ""
            if not isinstance(value, str) or "\0" in value:
                raise BadValue(f"{path} must be text, not {_shown(value)}")
            _check_length(len(value), None, bound or None, path)
            return value

        return text
    if name == "bool":

        def truth(value: Any, path: str) -> bool:
            if value is _MISSING:
                return False
            if not isinstance(value, bool):
                raise BadValue(f"{path} must be true or false, not {_shown(value)}")
            return value

        return truth
    if name in FLOATS:

        def real(value: Any, path: str) -> float:
            if value is _MISSING:
                return 0.0
            if value is None:
                return math.nan
            if not isinstance(value, int | float) or isinstance(value, bool):
                raise BadValue(f"{path} must be {_NUMBER}, not {_shown(value)}")
            return _as_float(value, path)

        return real
    low, high = _INTEGERS[name]

    def whole(value: Any, path: str) -> int:
        if value is _MISSING:
            return 0
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise BadValue(f"{path} must be a whole number from {low} to {high}, not {_shown(value)}")
        return value

    return whole


def _take_numbers(name: str, fixed: int | None, bound: int | None) -> Take:
    dtype = np.dtype(_DTYPES.get(name, name))
    each = _take_base(name)

    def take(value: Any, path: str) -> Any:
        if value is _MISSING:
            return np.zeros(fixed or 0, dtype)
        if isinstance(value, str) and name in BYTES:
            array = np.frombuffer(_base64(value, path), dtype)
        elif isinstance(value, list):
            array = np.array([each(item, f"{path}[{i}]") for i, item in enumerate(value)], dtype)
        else:
            raise BadValue(f"{path} must be a list{' or base64' if name in BYTES else ''}, not {_shown(value)}")
        _check_length(len(array), fixed, bound, path)
        return array

    return take


def _base64(value: str, path: str) -> bytes:
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError):
        raise BadValue(f"{path} must be base64, not {_shown(value)}") from None


def _as_float(value: float, path: str) -> float:
    try:
        return float(value)
    except OverflowError:
        raise BadValue(f"{path} must be {_NUMBER} that a double can hold") from None


def _check_length(length: int, fixed: int | None, bound: int | None, path: str) -> None:
    if fixed is not None and length != fixed:
        raise BadValue(f"{path} must have {fixed} elements, not {length}")
    if bound is not None and length > bound:
        raise BadValue(f"{path} must have {bound} elements at most, not {length}")


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else str(name)


def _shown(value: Any) -> str:
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else "a list"
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


def _now() -> dict[str, int]:
    return dict(zip(("sec", "nanosec"), divmod(time.time_ns(), 10**9), strict=True))
