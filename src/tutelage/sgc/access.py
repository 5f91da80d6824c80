"""Who may say and hear what: the rules of one topic, and the part of the fleet's policy that one node is told."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from tutelage.errors import ConfigError
from tutelage.sgc.errors import NotAllowed
from tutelage.sgc.names import SECRET_BYTES, Name
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import Authenticity, Delivery, Kind, Lane, Role, TopicRule

__all__ = ["Access", "Authenticity", "Delivery", "Entry", "Kind", "Lane", "Renewals", "Role", "Route", "TopicRule"]


@dataclass(frozen=True)
class Entry:
    """A topic as a member knows it: the rule and the secret that gives the name."""

    rule: TopicRule
    secret: bytes = field(repr=False)  # 32 bytes

    @cached_property
    def name(self) -> Name:
        """The topic's name in the network."""
        return Name.of(self.rule.topic, self.secret)


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
class Renewals:
    """The node that renews certificates over the network.

    Attributes:
        pseudonym: its own.
        sealing: its X25519 public key, 32 bytes; requests are sealed to it.
    """

    pseudonym: str
    sealing: bytes


@dataclass(frozen=True)
class Access:
    """The part of the policy that one node is told, signed by the fleet's authority and sealed to the node.

    Attributes:
        fleet: name of the fleet.
        node: name of the node that this is for.
        serial: counts up with every change; an older one is refused.
        topics: by alias, only those in which the node has a part.
        control: name of the fleet's own channel, for notices such as the deny list; all members know it.
        secret: 32 bytes that all nodes of the fleet know and no router does; hides names of nodes on the control channel.
            Empty for routers.
        renewals: who renews certificates over the network; None if nobody does.
        routes: for routers only.
        members: for routers only: pseudonyms of all nodes that are not revoked.
        routers: for routers only: pseudonyms of all routers that are not revoked.
    """

    fleet: str
    node: str
    serial: int
    topics: Mapping[str, Entry]
    control: Name
    secret: bytes = field(default=b"", repr=False)
    renewals: Renewals | None = None
    routes: tuple[Route, ...] = ()
    members: frozenset[str] = frozenset()
    routers: frozenset[str] = frozenset()

    def entry(self, alias: str) -> Entry:
        """The topic of an alias.

        Raises:
            NotAllowed: the node has no part in such a topic; the message names the node and the remedy.
        """
        try:
            return self.topics[alias]
        except KeyError:
            known = f"its topics are {', '.join(sorted(self.topics))}" if self.topics else "it has none"
            raise NotAllowed(
                f"the policy gives {self.node} no part in a topic {alias!r} ({known}); "
                f"add it to the policy of {self.fleet}, then: tutelage keys issue --policy"
            ) from None

    def check(self, alias: str, lane: Lane, *, sends: bool) -> Entry:
        """The topic of an alias, if this node may send (or receive) on a lane of it.

        Raises:
            NotAllowed: the message names the node and the remedy.
        """
        entry = self.entry(alias)
        rule = entry.rule
        if lane not in rule.lanes():
            raise NotAllowed(f"{alias} is a {rule.kind} in the policy of {self.fleet}, so it has no {lane} lane")
        if not (rule.may_send if sends else rule.may_receive)(self.node, lane):
            field = {
                (Lane.STREAM, True): "publish", (Lane.STREAM, False): "subscribe", (Lane.REQUEST, True): "request",
                (Lane.REQUEST, False): "serve", (Lane.REPLY, True): "serve", (Lane.REPLY, False): "request",
            }[lane, sends]  # fmt: skip
            raise NotAllowed(
                f"{self.node} is not in {field} of topic {alias!r}; add it to the policy of {self.fleet}, "
                f"then: tutelage keys issue --policy"
            )
        return entry

    def to_json(self) -> str:
        """As text, to be signed and sealed: it holds secrets."""
        content: dict[str, Any] = {
            "fleet": self.fleet,
            "node": self.node,
            "serial": self.serial,
            "control": self.control.hex(),
            "secret": self.secret.hex(),
            "topics": {
                alias: {"rule": entry.rule.to_table(), "secret": entry.secret.hex()} for alias, entry in self.topics.items()
            },
            "renewals": [self.renewals.pseudonym, self.renewals.sealing.hex()] if self.renewals else [],
            "routes": [
                [route.name.hex(), route.kind, route.owner, sorted(route.send), sorted(route.receive)]
                for route in self.routes
            ],
            "members": sorted(self.members),
            "routers": sorted(self.routers),
        }
        return json.dumps(content, sort_keys=True, separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> Access:
        """Read what `to_json` gave.

        Raises:
            Refused: MALFORMED.
        """
        try:
            content = json.loads(text)
            topics = {
                str(alias): Entry(TopicRule.from_table(alias, topic["rule"]), _secret(topic["secret"]))
                for alias, topic in content["topics"].items()
            }
            routes = tuple(
                Route(Name(bytes.fromhex(name)), Kind(kind), str(owner), frozenset(send), frozenset(receive))
                for name, kind, owner, send, receive in content["routes"]
            )
            renewals = content["renewals"]
            return cls(
                fleet=str(content["fleet"]),
                node=str(content["node"]),
                serial=int(content["serial"]),
                topics=topics,
                control=Name(bytes.fromhex(content["control"])),
                secret=bytes.fromhex(content["secret"]),
                renewals=Renewals(str(renewals[0]), bytes.fromhex(renewals[1])) if renewals else None,
                routes=routes,
                members=frozenset(content["members"]),
                routers=frozenset(content["routers"]),
            )
        except (LookupError, ValueError, TypeError, AttributeError, RecursionError, ConfigError) as error:
            raise Refused(Reason.MALFORMED, f"not a part of a policy: {error}") from None


def _secret(text: str) -> bytes:
    secret = bytes.fromhex(text)
    if len(secret) != SECRET_BYTES:
        raise ValueError(f"a topic's secret has {len(secret)} bytes")
    return secret
