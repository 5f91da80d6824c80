"""Who may say and hear what. One file of the fleet, the policy (TOML), decides; each node is told only its part of it.

version = 1

[topics.camera]
node = "drone-1"                    # metadata: with the topic's secret it gives the name
interface = "/camera"
type = "sensor_msgs/msg/Image"
owner = "drone-1"                   # hands out the topic's keys
publish = ["drone-1"]
subscribe = ["server", "operator-*"]
authenticity = "signature"          # or "session", "chain"
delivery = "lossy"                  # or "reliable"
max_age = 0.5                       # seconds
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from tutelage.sgc.names import Name, Topic


class Kind(StrEnum):
    """What a topic is."""

    STREAM = "stream"  # publishers -> subscribers
    SERVICE = "service"  # requesters -> servers, and replies back


class Authenticity(StrEnum):
    """How a receiver knows who sent a message of a topic. The key of a topic is shared by its members, so it cannot tell."""

    SIGNATURE = "signature"  # an Ed25519 signature a message or batch
    SESSION = "session"  # a tag a message under a key that only sender and receiver have; for a few receivers
    CHAIN = "chain"  # one signature for many messages, sent after them


class Delivery(StrEnum):
    """What the transport does when it cannot keep up."""

    RELIABLE = "reliable"  # gaps are noticed and replayed
    LOSSY = "lossy"  # the newest wins


class Lane(StrEnum):
    """Which way a message goes. A packet of one lane is refused on every other one."""

    STREAM = "stream"
    REQUEST = "request"
    REPLY = "reply"


class Role(StrEnum):
    """What a certificate is for."""

    NODE = "node"
    ROUTER = "router"


@dataclass(frozen=True)
class TopicRule:
    """One topic of the policy. Names of nodes may hold the wildcards of a shell, such as "operator-*".

    Attributes:
        alias: what the policy, and so every program, calls it.
        topic: its metadata.
        owner: the node that makes and hands out its keys; one name.
        publish, subscribe: who may, for a stream.
        serve, request: who may, for a service.
        max_age: seconds after which a message is refused, None for no limit.
        rotate_every: seconds after which the owner changes the topic's key; a key is refused at twice this age.
    """

    alias: str
    topic: Topic
    owner: str
    kind: Kind = Kind.STREAM
    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    serve: tuple[str, ...] = ()
    request: tuple[str, ...] = ()
    authenticity: Authenticity = Authenticity.SIGNATURE
    delivery: Delivery = Delivery.RELIABLE
    max_age: float | None = None
    rotate_every: float = 3600.0

    def may_send(self, node: str, lane: Lane = Lane.STREAM) -> bool:
        """May this node send on this lane?"""
        raise NotImplementedError

    def may_receive(self, node: str, lane: Lane = Lane.STREAM) -> bool:
        """May this node receive on this lane?"""
        raise NotImplementedError

    def is_member(self, node: str) -> bool:
        """May this node hold the topic's key: owner, or sender or receiver on any lane?"""
        raise NotImplementedError

    def lanes(self) -> tuple[Lane, ...]:
        """STREAM for a stream, REQUEST and REPLY for a service."""
        raise NotImplementedError


@dataclass(frozen=True)
class Policy:
    """All topics of a fleet, by alias."""

    topics: Mapping[str, TopicRule]

    @classmethod
    def parse(cls, text: str) -> Policy:
        """Read a policy.

        Raises:
            ConfigError: not TOML, an unknown field, or an impossible combination; the message names the topic.
        """
        raise NotImplementedError

    @classmethod
    def load(cls, path: Path) -> Policy:
        """Read a policy file.

        Raises:
            ConfigError: see `parse`; the message names the file.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Entry:
    """A topic as a member knows it: the rule and the secret that gives the name."""

    rule: TopicRule
    secret: bytes  # 32 bytes

    @property
    def name(self) -> Name:
        """The topic's name in the network."""
        raise NotImplementedError


@dataclass(frozen=True)
class Route:
    """A topic as a router knows it: a name, and who (by pseudonym) may send and receive. No metadata, no secret.

    Attributes:
        name: of the topic.
        kind: stream or service.
        owner: pseudonym of the node that answers for the topic's keys, "" while it has no certificate.
        send: pseudonyms that may publish (stream) or request (service).
        receive: pseudonyms that may subscribe (stream) or serve (service).
    """

    name: Name
    kind: Kind
    owner: str
    send: frozenset[str]
    receive: frozenset[str]


@dataclass(frozen=True)
class Access:
    """The part of the policy that one node is told, signed by the fleet's authority and sealed to the node.

    Attributes:
        fleet: name of the fleet.
        node: name of the node that this is for.
        serial: counts up with every change; an older one is refused.
        topics: by alias, only those in which the node has a part.
        control: name of the fleet's own channel, for notices such as the deny list; all members know it.
        routes: for routers only.
        members: for routers only: pseudonyms of all members with a valid certificate.
    """

    fleet: str
    node: str
    serial: int
    topics: Mapping[str, Entry]
    control: Name
    routes: tuple[Route, ...] = ()
    members: frozenset[str] = frozenset()

    def entry(self, alias: str) -> Entry:
        """The topic of an alias.

        Raises:
            NotAllowed: the node has no part in such a topic; the message names the node and the remedy.
        """
        raise NotImplementedError
