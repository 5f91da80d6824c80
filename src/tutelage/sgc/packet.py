"""What a packet looks like, and the two digests that proofs are made over.

    header (76 bytes) | introduction, sometimes | ciphertext | tag (16) | proof of the sender

    header: version 1 | mode 1 | flags 2 | length of introduction 2 | of proof 2 | epoch 4 | sender 16 | salt 16 |
            sequence 8 | sent 8 | label 16

All integers are big endian; `sent` is in nanoseconds since 1970. The header is in clear and authenticated. The sender is a
key id that only members of the topic can link to a node; it differs from topic to topic. The label says what kind of frame
the message is (`tutelage.sgc.frames`); in front of the message itself it would cost a copy of it at either end.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import accumulate, pairwise
from typing import NamedTuple

from tutelage.errors import ConfigError
from tutelage.sgc.envelope import derive
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Authenticity, Lane
from tutelage.sgc.wire import pack

Buffer = bytes | bytearray | memoryview
Packet = bytes | bytearray
"""What `Sealer` gives and a transport carries. A bytearray saves a copy of large messages; it is the caller's own."""

MAX_PAYLOAD = 64 << 20
MAX_BATCH = 65_536
MAX_PART = 65_535
TAG = 16
SALT_BYTES = 16
VERSION = 2
SIGNATURE, SESSION, CHAIN = 1, 2, 3
MODES = {Authenticity.SIGNATURE: SIGNATURE, Authenticity.SESSION: SESSION, Authenticity.CHAIN: CHAIN}
_HEADER = struct.Struct(">BBHHHI16s16sQQ16s")
_LAYOUT = struct.Struct(">BBHHH")
_STREAM = struct.Struct(">I16s16s")
HEADER = _HEADER.size
BEGINNING = 44
"""Bytes of a header that are alike from packet to packet while nothing special happens: up to the sequence number."""
_FLAGS = 3
_IDENT, _SEQUENCE = slice(12, 52), slice(BEGINNING, 52)
NO_LABEL = bytes(16)
SESSION_ID = 8
SLOT = SESSION_ID + TAG
"""Bytes of a session in a proof: its id, and a tag."""
MAX_SESSIONS = 16
MAX_PACKET = HEADER + MAX_PAYLOAD + 4 * (MAX_BATCH + 1) + TAG + 2 * MAX_PART
_CONTEXT = b"tutelage message 2"
_CHUNK = 1 << 20
_COUNT = struct.Struct(">I")

BATCH, ANCHOR, BARE, SOLE = 1, 2, 4, 8
"""Flags: the body holds many messages; the proof confirms earlier ones too; there is no message, only a proof; the body is
sealed for one session, whose id is all the proof there is."""
_ALLOWED = {SIGNATURE: BATCH, SESSION: BATCH | SOLE, CHAIN: BATCH | ANCHOR | BARE}

BODY, PROOF, BARE_BODY, BARE_PROOF, INTRODUCTION, SESSION_TAG, BOUND_TAG, REPLACED = (p.to_bytes(4, "big") for p in range(8))
"""What a nonce is for: the first 4 of its 12 bytes, so that one sequence number serves several without repetition."""


class Layout(NamedTuple):
    """What the first bytes of a packet say of the rest: its flags, and the lengths of introduction and proof."""

    flags: int
    introduction: int
    proof: int


make_header = _HEADER.pack
"""The fields of a header as bytes: all that the table above names, in its order."""

read_header = struct.Struct(">8s36sQQ16s").unpack
"""The layout in 8 bytes, the stream in 36, two numbers, sequence and time of sending, and the label."""

read_end = struct.Struct(">QQ16s").unpack_from
"""What follows the beginning: two numbers, sequence and time of sending, and the label."""

read_stream = _STREAM.unpack
"""Epoch, sender and salt."""


def read_layout(start: bytes, mode: int) -> Layout:
    """Read the layout of a packet, if it is one of ours of this mode.

    Raises:
        Refused: MALFORMED or WRONG_MODE.
    """
    version, found, flags, introduction, proof = _LAYOUT.unpack(start)
    if version != VERSION:
        raise Refused(Reason.MALFORMED, f"a packet of version {version}; this is version {VERSION}")
    if found != mode:
        raise Refused(Reason.WRONG_MODE, f"authenticity {found}, and the policy says {mode}")
    if flags & ~_ALLOWED[mode] or (flags & BARE and not flags & ANCHOR):
        raise Refused(Reason.MALFORMED, "a packet with flags of another mode")
    if mode == SESSION and (proof != SESSION_ID if flags & SOLE else proof % SLOT or proof > SLOT * MAX_SESSIONS):
        raise Refused(Reason.MALFORMED, "a proof of sessions with an impossible length")
    if mode == SESSION and introduction:
        raise Refused(Reason.MALFORMED, "a packet of a session with a credential, which only its beginning has")
    return Layout(flags, introduction, proof)


def ident(packet: Buffer) -> bytes:
    """40 bytes that identify a packet: sender, salt and sequence. A reply binds to that of its request."""
    return bytes(memoryview(packet)[_IDENT])


def anchored(packet: Buffer) -> bool:
    """Does a packet of a chain carry an anchor?"""
    return bool(packet[_FLAGS] & ANCHOR)


def nonce(purpose: bytes, header: bytes) -> bytes:
    """12 bytes that never repeat under one key: what for, and the sequence number in a header. Keys differ by salt, and a
    salt is never used twice."""
    return purpose + header[_SEQUENCE]


def message_key(epoch_key: bytes, name: bytes, lane: Lane, epoch: int, sender: bytes, salt: bytes) -> bytes:
    """The AES-256 key of one start of one sender: HKDF-SHA256(epoch's key, salt; topic, lane, epoch, sender)."""
    return derive(epoch_key, salt, pack(_CONTEXT, name, lane.encode(), epoch.to_bytes(4, "big"), sender))


class Statements:
    """What is signed about messages of a topic and lane."""

    def __init__(self, name: bytes, lane: Lane) -> None:
        self._message = pack(_CONTEXT, name, lane.encode())
        self._anchor = pack(_CONTEXT + b" anchor", name, lane.encode())

    def message(self, header: bytes, bind: bytes, body: Buffer) -> bytes:
        """Everything that a message is: topic, lane, header, what it is bound to, and a digest of its body."""
        return b"".join((self._message, header, len(bind).to_bytes(4, "big"), bind, digest(body)))

    def anchor(self, sender: bytes, salt: bytes, entries: bytes) -> bytes:
        """That these messages are ours. entries: sequence (8) and SHA-256 of its statement (32), for each."""
        return b"".join((self._anchor, sender, salt, entries))


def digest(body: Buffer) -> bytes:
    """SHA-256; of more than 1 MiB: SHA-256 over the SHA-256 of each MiB, in threads. The two cannot be confused, as the
    statement that holds the digest is about a message of one length."""
    if len(body) <= _CHUNK:
        return b"\0" + hashlib.sha256(body).digest()
    view = memoryview(body)
    chunks = [view[at : at + _CHUNK] for at in range(0, len(view), _CHUNK)]
    parts = _pool().map(lambda chunk: hashlib.sha256(chunk).digest(), chunks)
    return b"\1" + hashlib.sha256(b"".join(parts)).digest()


def join_batch(payloads: Sequence[Buffer]) -> bytes:
    """The body of a batch: count, lengths, payloads.

    Raises:
        ConfigError: none, or too many.
    """
    if not 0 < len(payloads) <= MAX_BATCH:
        raise ConfigError(f"a batch has 1 to {MAX_BATCH} messages, not {len(payloads)}")
    lengths = struct.pack(f">{len(payloads)}I", *map(len, payloads))
    return b"".join((_COUNT.pack(len(payloads)), lengths, *payloads))


def split_batch(body: bytes) -> list[bytes]:
    """The payloads of a batch.

    Raises:
        Refused: MALFORMED.
    """
    if len(body) < 4:
        raise Refused(Reason.MALFORMED, "a batch without a count")
    (count,) = _COUNT.unpack_from(body)
    if not 0 < count <= MAX_BATCH or len(body) < 4 + 4 * count:
        raise Refused(Reason.MALFORMED, f"a batch of {count} messages")
    lengths = struct.unpack_from(f">{count}I", body, 4)
    ends = list(accumulate(lengths, initial=4 + 4 * count))
    if ends[-1] != len(body):
        raise Refused(Reason.MALFORMED, "a batch whose lengths do not add up")
    return [body[start:end] for start, end in pairwise(ends)]


class Opened(NamedTuple):
    """A message that was opened.

    Attributes:
        payload: the message.
        sender: name of the node.
        sequence: 1, 2, ... within (sender, salt), without gaps where nothing was lost. Batches count every message.
        salt: 16 bytes, new each time that the sender starts.
        sent: nanoseconds since 1970 on the sender's clock.
        epoch: of the key.
        authentic: False only for provisional messages of chain mode that are not confirmed yet.
        stream: 32 bytes, the sender's key id and the salt.
        label: 16 bytes, as the sender gave them.
    """

    payload: bytes
    sender: str
    sequence: int
    salt: bytes
    sent: int
    epoch: int
    authentic: bool
    stream: bytes
    label: bytes = NO_LABEL

    @property
    def ident(self) -> bytes:
        """40 bytes that identify the message: sender, salt and sequence; a reply binds to its request's."""
        return self.stream + self.sequence.to_bytes(8, "big")


make_opened: Callable[[tuple[bytes, str, int, bytes, int, int, bool, bytes, bytes]], Opened] = partial(tuple.__new__, Opened)
"""`Opened` of all its fields, in two thirds of the time that its own constructor takes."""

_threads: ThreadPoolExecutor | None = None


def _pool() -> ThreadPoolExecutor:
    global _threads
    if _threads is None:
        _threads = ThreadPoolExecutor(min(4, os.cpu_count() or 1), thread_name_prefix="digest")
    return _threads
