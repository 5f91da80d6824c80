"""DDS topics of any type without knowing the type: serialized samples (CDR with its 4-byte header), bytes unchanged.

The Python classes of Cyclone DDS want a description of each type and announce it to the network, where a description that is
not exactly the peer's own keeps the two from matching (XTypes). A proxy has none. So topics are made here through the C
functions of the same library, without type information: peers then match by the name of the type, as the middleware of
ROS 2 does. Other than `DataWriter.write`, these calls release Python's lock, so that a writer that blocks stops nobody else,
and they copy a message once.

CDR is taken to be little-endian, as on every processor that ROS 2 supports: Cyclone DDS would rewrite the header of
big-endian data, but cannot turn round its content without knowing the type.
"""

from __future__ import annotations

import ctypes as ct
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from tutelage.errors import ConfigError, MissingExtraError

if TYPE_CHECKING:
    from tutelage.sgc.proxies.ros_names import Channel

CDR_LITTLE_ENDIAN = b"\x00\x01"
"""How every serialized ROS 2 message starts; two bytes of options follow."""
HEADER = 4
_DATA = 2  # enum ddsi_serdata_kind: a sample, not a key
_ONE_BYTE_STRUCT = (0x01010000, 0, 0)  # serializer program "a uint8 at offset 0, end": the least that a message holds
_RESTRICT_REPRESENTATION, _XCDR1 = 1 << 7, 1 << 0
_TIMEOUT = -10


class _Blob(ct.Structure):
    _fields_ = (("data", ct.c_void_p), ("size", ct.c_uint32))


class _Descriptor(ct.Structure):
    """dds_topic_descriptor_t of Cyclone DDS 11, the argument of dds_create_topic."""

    _fields_ = (
        ("size", ct.c_uint32),
        ("align", ct.c_uint32),
        ("flags", ct.c_uint32),
        ("key_count", ct.c_uint32),
        ("type_name", ct.c_char_p),
        ("keys", ct.c_void_p),
        ("op_count", ct.c_uint32),
        ("ops", ct.POINTER(ct.c_uint32)),
        ("meta", ct.c_char_p),
        ("type_information", _Blob),
        ("type_mapping", _Blob),
        ("representations", ct.c_uint32),
    )


class _Piece(ct.Structure):
    """ddsrt_iovec_t (POSIX)."""

    _fields_ = (("base", ct.c_void_p), ("length", ct.c_size_t))


@dataclass(frozen=True, slots=True)
class Sample:
    """What was taken from a reader.

    Attributes:
        data: serialized, header included.
        writer: handle of the writer, valid for `DataReader.get_matched_publication_data` while it lives.
    """

    data: bytes
    writer: int


class _Library:
    """The C functions, with their types."""

    def __init__(self) -> None:
        try:
            from cyclonedds.internal import DDS, dds_c_t
        except ImportError:
            raise MissingExtraError("cyclonedds", "ros2") from None
        self.sample_info = dds_c_t.sample_info
        library = DDS._dll_handle
        entity, handle, size = ct.c_int32, ct.c_void_p, ct.c_size_t
        pieces = ct.POINTER(_Piece)

        def function(name: str, result: Any, *arguments: Any) -> Any:
            found = getattr(library, name, None)
            if found is None:
                raise ConfigError(f"this build of Cyclone DDS lacks {name}; install cyclonedds from PyPI, version 11")
            found.restype, found.argtypes = result, arguments
            return found

        self.create_topic = function(
            "dds_create_topic", entity, entity, ct.POINTER(_Descriptor), ct.c_char_p, handle, handle
        )
        self.sertype = function("dds_get_entity_sertype", ct.c_int32, entity, ct.POINTER(handle))
        self.from_bytes = function("ddsi_serdata_from_ser_iov", handle, handle, ct.c_int, size, pieces, size)
        self.write = function("dds_writecdr", ct.c_int32, entity, handle)
        infos = ct.POINTER(self.sample_info)
        self.take = function("dds_takecdr", ct.c_int32, entity, ct.POINTER(handle), ct.c_uint32, infos, ct.c_uint32)
        self.length = function("ddsi_serdata_size", ct.c_uint32, handle)
        self.borrow = function("ddsi_serdata_to_ser_ref", handle, handle, size, size, pieces)
        self.give_back = function("ddsi_serdata_to_ser_unref", None, handle, pieces)
        self.release = function("ddsi_serdata_unref", None, handle)


@cache
def _library() -> _Library:
    return _Library()


def raw_topic(participant: Any, channel: Channel) -> Any:
    """A `cyclonedds.topic.Topic` for readers and writers of serialized samples.

    participant: `cyclonedds.domain.DomainParticipant`.

    Raises:
        MissingExtraError: without cyclonedds.
        ConfigError: Cyclone DDS refuses the topic.
    """
    library = _library()
    from cyclonedds.core import DDSException, Entity
    from cyclonedds.topic import Topic

    ops = (ct.c_uint32 * len(_ONE_BYTE_STRUCT))(*_ONE_BYTE_STRUCT)
    descriptor = _Descriptor(
        size=1,
        align=1,
        flags=_RESTRICT_REPRESENTATION,
        type_name=channel.dds_type.encode(),
        op_count=len(ops),
        ops=ops,
        meta=b"",
        representations=_XCDR1,
    )
    reference = library.create_topic(participant._ref, ct.byref(descriptor), channel.topic.encode(), None, None)
    topic = Topic.__new__(Topic)
    try:
        Entity.__init__(topic, reference)
    except DDSException as error:
        raise ConfigError(f"Cyclone DDS refuses topic {channel.topic} of type {channel.dds_type}: {error}") from None
    topic.data_type = None
    topic._keepalive_entities = [participant]
    return topic


def is_cdr(data: bytes | memoryview) -> bool:
    """Does this start like a serialized ROS 2 message with at least one byte of content?"""
    return len(data) > HEADER and bytes(data[:2]) == CDR_LITTLE_ENDIAN


def write(writer: Any, *parts: bytes) -> bool:
    """Write one sample, given in pieces that are joined. False if the writer's history stayed full for its blocking time.

    Raises:
        ValueError: not CDR.
        OSError: Cyclone DDS reports another error.
    """
    library = _library()
    sertype = ct.c_void_p()
    if library.sertype(writer._ref, ct.byref(sertype)) != 0:
        raise OSError("the writer is closed")
    pieces = (_Piece * len(parts))(*(_Piece(ct.cast(ct.c_char_p(part), ct.c_void_p), len(part)) for part in parts))
    total = sum(len(part) for part in parts)
    sample = library.from_bytes(sertype, _DATA, len(parts), pieces, total)
    if not sample:
        raise ValueError("not a serialized message (CDR)")
    status = library.write(writer._ref, sample)  # takes over the reference
    if status not in (0, _TIMEOUT):
        raise OSError(f"Cyclone DDS could not write: error {status}")
    return bool(status == 0)


def take(reader: Any, most: int = 16) -> list[Sample]:
    """Remove up to `most` samples from a reader, in order. Notices without data, such as disposals, are left out.

    Raises:
        OSError: Cyclone DDS reports an error, such as a reader that is closed.
    """
    library = _library()
    samples, infos = (ct.c_void_p * most)(), (library.sample_info * most)()
    count = library.take(reader._ref, samples, most, infos, 0)
    if count < 0:
        raise OSError(f"Cyclone DDS could not read: error {count}")
    taken = []
    for sample, info in zip(samples[:count], infos[:count], strict=True):
        if info.valid_data:
            piece = _Piece()
            borrowed = library.borrow(sample, 0, library.length(sample), ct.byref(piece))
            taken.append(Sample(ct.string_at(piece.base, piece.length), info.publication_handle))
            library.give_back(borrowed, ct.byref(piece))
        library.release(sample)
    return taken
