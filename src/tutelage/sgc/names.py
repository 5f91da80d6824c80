"""Globally unique, location-independent names of topics: 256 bits, from which nothing can be read (section 8.4).

The dissertation hashes a topic's metadata with SHA-256. Metadata such as "/camera" can be guessed, and a bare hash confirms
the guess; so a name is HMAC-SHA256 under a secret that only the members of the topic and the fleet's authority hold. It
stays deterministic: whoever holds metadata and secret derives the same name, anywhere.
"""

from __future__ import annotations

import hashlib
import hmac
import unicodedata
from dataclasses import dataclass, fields

from tutelage.errors import ConfigError
from tutelage.sgc.wire import pack

NAME_BYTES = 32
SECRET_BYTES = 32
_VERSION = b"tutelage topic 1"


@dataclass(frozen=True)
class Topic:
    """What a topic is, for people: the metadata that its name is made from (section 8.4). All of it is text in NFC.

    Attributes:
        node: name of the node that the topic belongs to, such as "arm-3".
        interface: name within the node, such as "/joint_states".
        type: type of its messages, such as "sensor_msgs/msg/JointState".
        author: who wrote the node.
        maintainer: who looks after it.
        description: free text.
        unique: tells apart two otherwise equal topics in different places.

    Raises:
        ConfigError: node or interface is empty, or a field is not text that UTF-8 can hold.
    """

    node: str
    interface: str
    type: str
    author: str = ""
    maintainer: str = ""
    description: str = ""
    unique: str = ""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, str):
                raise ConfigError(f"{field.name} of a topic must be text, not {value!r}")
            try:
                value.encode()
            except UnicodeEncodeError:
                raise ConfigError(f"{field.name} of a topic holds characters that UTF-8 cannot: {value!r}") from None
            # The same text typed on two systems may differ in code points; it must not differ in name.
            object.__setattr__(self, field.name, unicodedata.normalize("NFC", value))
        if not self.node or not self.interface:
            raise ConfigError(f"a topic needs a node and an interface, not {self.node!r} and {self.interface!r}")

    def canonical(self) -> bytes:
        """The metadata as bytes: a version, then every field in a fixed order, each with its length. Injective."""
        return pack(_VERSION, *(getattr(self, field.name).encode() for field in fields(self)))


class Name(bytes):
    """The name of a topic in the network: 32 bytes; `hex()` is what a transport uses as key."""

    def __new__(cls, value: bytes) -> Name:
        """Wrap 32 bytes.

        Raises:
            ConfigError: not 32 bytes.
        """
        if len(value) != NAME_BYTES:
            raise ConfigError(f"a name has {NAME_BYTES} bytes, not {len(value)}")
        return super().__new__(cls, value)

    @classmethod
    def of(cls, topic: Topic, secret: bytes) -> Name:
        """The name of a topic: HMAC-SHA256(secret, canonical metadata).

        secret: 32 bytes; the topic's, from `Access`.
        """
        return cls(_mac(secret, topic.canonical()))

    @classmethod
    def of_channel(cls, channel: str, secret: bytes) -> Name:
        """The name of something that is not a topic, such as the fleet's notices. Never equal to a topic's name."""
        return cls(_mac(secret, pack(b"tutelage channel 1", channel.encode())))

    def __repr__(self) -> str:
        return f"Name({self.hex()[:8]}...)"

    __str__ = __repr__


def _mac(secret: bytes, message: bytes) -> bytes:
    if len(secret) != SECRET_BYTES:
        raise ConfigError(f"a topic's secret has {SECRET_BYTES} bytes, not {len(secret)}")
    return hmac.digest(secret, message, hashlib.sha256)
