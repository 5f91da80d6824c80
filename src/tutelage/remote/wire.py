"""What robots and server say to each other: a header, fields of fixed size, then arrays; all little-endian.

    "TR" | version | kind | fields | arrays: dtype, number of dimensions, shape, data

Every message is checked here, at the edge: whoever gets one from `unpack_...` may rely on its ranges. Nothing that a message
says sets aside more memory than the message has bytes.
"""

from __future__ import annotations

import json
import math
import struct
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.remote.messages import (
    MAX_ARRAY,
    MAX_CAMERAS,
    MAX_PICTURE,
    MAX_SIDE,
    MAX_TEXT,
    MAX_WEIGHTS,
    Answer,
    Ask,
    Command,
    Description,
    Flag,
    Malformed,
    Observation,
    Operation,
    Order,
    Picture,
    Stop,
    StopOperation,
    Weights,
)

Array = NDArray[Any]

VERSION = 1
_MAGIC = b"TR"
_HEAD = struct.Struct("<2sBB")
_OBSERVATION = struct.Struct("<QQIIHHQQQfdIII")
_COMMAND = struct.Struct("<QQQQHHf")
_STOP = struct.Struct("<QQB")
_ASK = struct.Struct("<QQBBQ")
_ANSWER = struct.Struct("<BQI")
_PICTURE = struct.Struct("<QQBHH")
_WEIGHTS = struct.Struct("<I")
_DTYPES = tuple(np.dtype(name) for name in ("<f4", "<f8", "u1", "<i2", "<i4", "<u2"))


class Kind(IntEnum):
    """The fourth byte of a message."""

    OBSERVATION = 1
    COMMAND = 2
    STOP = 3
    ASK = 4
    ANSWER = 5
    PICTURE = 6
    DESCRIPTION = 7
    WEIGHTS = 8


# -- to bytes -------------------------------------------------------------------------------------------------------------


def pack_observation(o: Observation) -> bytes:
    """See `Observation`."""
    head = _OBSERVATION.pack(
        o.boot, o.number, o.episode, o.step, o.flags, 1 if o.proposal is None else 2, o.server, o.heard, o.executed,
        o.waited, o.episode_return, o.stale & 0xFFFFFFFF, o.refused & 0xFFFFFFFF, o.policy,
    )  # fmt: skip
    arrays = _array(o.obs) if o.proposal is None else _array(o.obs) + _array(o.proposal)
    return _head(Kind.OBSERVATION) + head + arrays


def pack_command(c: Command) -> bytes:
    """See `Command`."""
    head = _COMMAND.pack(c.server, c.number, c.boot, c.answers, c.order, c.watch, c.period)
    return _head(Kind.COMMAND) + head + _array(c.action)


def pack_stop(s: Stop) -> bytes:
    """See `Stop`."""
    return _head(Kind.STOP) + _STOP.pack(s.server, s.number, s.operation)


def pack_ask(a: Ask) -> bytes:
    """See `Ask`."""
    return _head(Kind.ASK) + _ASK.pack(a.server, a.number, a.operation, a.seed is not None, a.seed or 0)


def pack_answer(a: Answer) -> bytes:
    """See `Answer`."""
    return _head(Kind.ANSWER) + _ANSWER.pack(a.accepted, a.boot, a.episode)


def pack_picture(p: Picture) -> bytes:
    """See `Picture`."""
    return _head(Kind.PICTURE) + _PICTURE.pack(p.boot, p.number, p.camera, p.width, p.height) + p.jpeg


def pack_description(d: Description) -> bytes:
    """See `Description`."""
    return _head(Kind.DESCRIPTION) + json.dumps(d.to_json()).encode()


def pack_weights(w: Weights) -> bytes:
    """See `Weights`."""
    return _head(Kind.WEIGHTS) + _WEIGHTS.pack(w.version) + w.data


# -- from bytes -----------------------------------------------------------------------------------------------------------


def unpack_observation(data: bytes) -> Observation:
    """Read an observation; the arrays are read-only views.

    Raises:
        Malformed: not one.
    """
    body = _body(data, Kind.OBSERVATION)
    boot, number, episode, step, flags, arrays, server, heard, executed, waited, total, stale, refused, policy = _fields(
        _OBSERVATION, body
    )
    if not (boot and number and episode) or flags >= 2 * Flag.FAULT or arrays not in (1, 2):
        raise Malformed("an observation with a field out of range")
    if not (0 <= waited < 1e9 and abs(total) < 1e15):  # and no NaN
        raise Malformed("an observation with an impossible time or return")
    obs, at = _read_array(body, _OBSERVATION.size)
    proposal = None
    if arrays == 2:
        proposal, at = _read_array(body, at)
        if proposal.ndim != 1 or proposal.dtype != np.float32:
            raise Malformed("a proposal that is no vector of float32")
    _ends(body, at)
    return Observation(
        boot, number, episode, step, Flag(flags), server, heard, executed, waited, total, stale, refused, policy,
        obs, proposal,
    )  # fmt: skip


def unpack_command(data: bytes) -> Command:
    """Read a command.

    Raises:
        Malformed: not one.
    """
    body = _body(data, Kind.COMMAND)
    server, number, boot, answers, order, watch, period = _fields(_COMMAND, body)
    if not (server and number) or order >= 2 * Order.OWN or not (math.isfinite(period) and period >= 0):
        raise Malformed("a command with a field out of range")
    action, at = _read_array(body, _COMMAND.size)
    _ends(body, at)
    if action.ndim != 1 or action.dtype != np.float32:
        raise Malformed("an action that is no vector of float32")
    return Command(server, number, boot, answers, Order(order), watch, period, action)


def unpack_stop(data: bytes) -> Stop:
    """Read an emergency stop.

    Raises:
        Malformed: not one.
    """
    body = _body(data, Kind.STOP)
    server, number, operation = _fields(_STOP, body)
    _ends(body, _STOP.size)
    if not (server and number) or operation not in set(StopOperation):
        raise Malformed("a stop with a field out of range")
    return Stop(server, number, StopOperation(operation))


def unpack_ask(data: bytes) -> Ask:
    """Read a request.

    Raises:
        Malformed: not one.
    """
    body = _body(data, Kind.ASK)
    server, number, operation, seeded, seed = _fields(_ASK, body)
    _ends(body, _ASK.size)
    if not (server and number) or operation not in set(Operation) or seeded > 1 or (seed and not seeded):
        raise Malformed("a request with a field out of range")
    return Ask(server, number, Operation(operation), seed if seeded else None)


def unpack_answer(data: bytes) -> Answer:
    """Read an answer.

    Raises:
        Malformed: not one.
    """
    body = _body(data, Kind.ANSWER)
    accepted, boot, episode = _fields(_ANSWER, body)
    _ends(body, _ANSWER.size)
    if accepted > 1 or not boot:
        raise Malformed("an answer with a field out of range")
    return Answer(bool(accepted), boot, episode)


def unpack_picture(data: bytes) -> Picture:
    """Read a picture. Its JPEG is not decoded, but has the size that the message says.

    Raises:
        Malformed: not one.
    """
    if len(data) > MAX_PICTURE:
        raise Malformed("a picture that is too large")
    body = _body(data, Kind.PICTURE)
    boot, number, camera, width, height = _fields(_PICTURE, body)
    if not (boot and number and 0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE) or camera >= MAX_CAMERAS:
        raise Malformed("a picture with a field out of range")
    jpeg = bytes(body[_PICTURE.size :])
    if jpeg_size(jpeg) != (width, height):
        raise Malformed("a picture that is no JPEG of the size that it says")
    return Picture(boot, number, camera, width, height, jpeg)


def unpack_weights(data: bytes) -> Weights:
    """Read weights, or the question for them. The file in them is not read.

    Raises:
        Malformed: not one.
    """
    if len(data) > MAX_WEIGHTS:
        raise Malformed("weights that are too large")
    body = _body(data, Kind.WEIGHTS)
    (version,) = _fields(_WEIGHTS, body)
    return Weights(version, bytes(body[_WEIGHTS.size :]))


def unpack_description(data: bytes) -> Description:
    """Read a description.

    Raises:
        Malformed: not one.
    """
    if len(data) > MAX_TEXT:
        raise Malformed("a description that is too long")
    try:
        table = json.loads(bytes(_body(data, Kind.DESCRIPTION)))
    except (ValueError, RecursionError):
        raise Malformed("a description that is no JSON") from None
    return Description.from_json(table)


def jpeg_size(jpeg: bytes) -> tuple[int, int] | None:
    """Width and height that a JPEG file says it has; None: it is none."""
    if jpeg[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 9 <= len(jpeg):
        if jpeg[at] != 0xFF:
            return None
        marker = jpeg[at + 1]
        if marker == 0xFF:  # padding
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", jpeg, at + 5)
            return int(width), int(height)
        (length,) = struct.unpack_from(">H", jpeg, at + 2)
        if length < 2 or marker in (0xD8, 0xD9, 0xDA):
            return None
        at += 2 + length
    return None


def _head(kind: Kind) -> bytes:
    return _HEAD.pack(_MAGIC, VERSION, kind)


def _body(data: bytes, kind: Kind) -> memoryview:
    if len(data) < _HEAD.size:
        raise Malformed("a message that is too short")
    magic, version, found = _HEAD.unpack_from(data)
    if magic != _MAGIC:
        raise Malformed("bytes of another protocol")
    if version != VERSION:
        raise Malformed(f"a message of version {version}; this program speaks version {VERSION}: update the older end")
    if found != kind:
        raise Malformed(f"a message of kind {found} where kind {int(kind)} belongs")
    return memoryview(data)[_HEAD.size :]


def _fields(layout: struct.Struct, body: memoryview) -> tuple[Any, ...]:
    if len(body) < layout.size:
        raise Malformed("a message that is too short")
    return layout.unpack_from(body)


def _ends(body: memoryview, at: int) -> None:
    if at != len(body):
        raise Malformed("a message that goes on after its end")


def _array(array: Array) -> bytes:
    little = array.dtype.newbyteorder("<") if array.dtype.itemsize > 1 else array.dtype
    code = _DTYPES.index(np.dtype(little))
    shape = struct.pack(f"<BB{array.ndim}I", code, array.ndim, *array.shape)
    return shape + np.ascontiguousarray(array, dtype=little).tobytes()


def _read_array(body: memoryview, at: int) -> tuple[Array, int]:
    if at + 2 > len(body):
        raise Malformed("a message that ends before an array")
    code, dimensions = body[at], body[at + 1]
    at += 2
    if code >= len(_DTYPES) or dimensions > 4 or at + 4 * dimensions > len(body):
        raise Malformed("an array of no known kind")
    shape = struct.unpack_from(f"<{dimensions}I", body, at)
    at += 4 * dimensions
    dtype = _DTYPES[code]
    size = math.prod(shape) * dtype.itemsize
    if size > MAX_ARRAY or size > len(body) - at:
        raise Malformed("an array that is longer than its message")
    array = np.frombuffer(body, dtype, math.prod(shape), at).reshape(shape)
    if dtype.kind == "f" and not np.isfinite(array).all():
        raise Malformed("an array with a number that is not finite")
    return array, at + size
