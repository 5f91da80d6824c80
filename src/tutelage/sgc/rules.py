"""What the policy says of one topic, and who may send and receive on it."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from fnmatch import fnmatchcase
from typing import Any, TypeVar

from tutelage.errors import ConfigError
from tutelage.sgc.names import Topic


class Kind(StrEnum):
    """What a topic is."""

    STREAM = "stream"  # publishers -> subscribers
    SERVICE = "service"  # requesters -> servers, and replies back


class Authenticity(StrEnum):
    """How a receiver knows who sent a message. The topic's key is shared by its members, so it cannot tell."""

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
    PRESENCE = "presence"  # members to members: who is there, and how far away; always signed


class Role(StrEnum):
    """What a certificate is for."""

    NODE = "node"  # sends and receives; may not be taken for a router
    ROUTER = "router"  # moves packets; has no part in any topic


_Choice = TypeVar("_Choice", bound=StrEnum)
NODE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
_PATTERN = re.compile(r"[A-Za-z0-9*?][A-Za-z0-9._*?-]{0,62}")
_METADATA = tuple(field.name for field in fields(Topic))
_WHO = ("publish", "subscribe", "serve", "request")
_OF_KIND = {Kind.STREAM: ("publish", "subscribe"), Kind.SERVICE: ("serve", "request")}
_KNOWN = (*_METADATA, "owner", "kind", *_WHO, "authenticity", "delivery", "max_age", "rotate_every")
MIN_ROTATE, MAX_ROTATE = 1.0, 30 * 86400.0
MAX_AGE = 366 * 86400.0


@dataclass(frozen=True)
class TopicRule:
    """One topic of the policy. Names of nodes may hold the wildcards * and ?, such as "operator-*".

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
        if lane == Lane.PRESENCE:
            return self.is_member(node)
        return _any(node, {Lane.STREAM: self.publish, Lane.REQUEST: self.request, Lane.REPLY: self.serve}[lane])

    def may_receive(self, node: str, lane: Lane = Lane.STREAM) -> bool:
        """May this node receive on this lane?"""
        if lane == Lane.PRESENCE:
            return self.is_member(node)
        return _any(node, {Lane.STREAM: self.subscribe, Lane.REQUEST: self.serve, Lane.REPLY: self.request}[lane])

    def is_member(self, node: str) -> bool:
        """May this node hold the topic's key: owner, or sender or receiver on any lane?"""
        return node == self.owner or any(_any(node, getattr(self, who)) for who in _WHO)

    def names(self) -> set[str]:
        """All nodes that the rule names, patterns left out."""
        named = {self.owner, *(name for who in _WHO for name in getattr(self, who))}
        return {name for name in named if NODE_NAME.fullmatch(name)}

    def lanes(self) -> tuple[Lane, ...]:
        """STREAM for a stream, REQUEST and REPLY for a service; PRESENCE for both."""
        return (*((Lane.STREAM,) if self.kind == Kind.STREAM else (Lane.REQUEST, Lane.REPLY)), Lane.PRESENCE)

    def authenticity_on(self, lane: Lane) -> Authenticity:
        """How a receiver knows who sent a packet of this lane."""
        return Authenticity.SIGNATURE if lane == Lane.PRESENCE else self.authenticity

    def to_table(self) -> dict[str, Any]:
        """As in the policy file; `from_table` reads it."""
        table: dict[str, Any] = {name: getattr(self.topic, name) for name in _METADATA}
        table |= {"owner": self.owner, "kind": str(self.kind), "authenticity": str(self.authenticity)}
        table |= {"delivery": str(self.delivery), "rotate_every": self.rotate_every}
        table |= {who: list(getattr(self, who)) for who in _OF_KIND[self.kind]}
        return table if self.max_age is None else table | {"max_age": self.max_age}

    @classmethod
    def from_table(cls, alias: str, table: Mapping[str, Any]) -> TopicRule:
        """Read one topic of a policy.

        Raises:
            ConfigError: unknown or missing fields, wrong types, impossible combinations; one line that names the topic.
        """
        where = f"topic {alias!r} of the policy"
        if not NODE_NAME.fullmatch(alias):
            raise ConfigError(f"{where}: an alias is 1 to 63 letters, digits, '.', '_' and '-'")
        if not isinstance(table, Mapping):
            raise ConfigError(f"{where} must be a table, [topics.{alias}]")
        for field in table:
            if field not in _KNOWN:
                close = difflib.get_close_matches(str(field), _KNOWN, 1)
                raise ConfigError(
                    f"{where} has an unknown field {field!r}" + (f"; did you mean {close[0]!r}?" if close else "")
                )
        metadata = {name: table[name] for name in _METADATA if name in table}
        if missing := [name for name in ("node", "interface", "type", "owner") if not table.get(name)]:
            raise ConfigError(f"{where} lacks {', '.join(missing)}")
        try:
            topic = Topic(**metadata)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None
        owner = table["owner"]
        if not isinstance(owner, str) or not NODE_NAME.fullmatch(owner):
            raise ConfigError(f"{where}: owner must be the name of one node, not {owner!r}")
        kind = _choice(where, table, "kind", Kind, Kind.STREAM)
        rule = cls(
            alias=alias,
            topic=topic,
            owner=owner,
            kind=kind,
            authenticity=_choice(where, table, "authenticity", Authenticity, Authenticity.SIGNATURE),
            delivery=_choice(where, table, "delivery", Delivery, Delivery.RELIABLE),
            max_age=_seconds(where, table, "max_age", 1e-3, MAX_AGE) if "max_age" in table else None,
            rotate_every=_seconds(where, table, "rotate_every", MIN_ROTATE, MAX_ROTATE)
            if "rotate_every" in table
            else 3600.0,
            **{who: _patterns(where, table, who) for who in _OF_KIND[kind]},
        )
        rule._check(where, table)
        return rule

    def _check(self, where: str, table: Mapping[str, Any]) -> None:
        for who in _WHO:
            if who in table and who not in _OF_KIND[self.kind]:
                wanted = " and ".join(_OF_KIND[self.kind])
                raise ConfigError(f"{where} is a {self.kind}, which has {wanted}, not {who}")
        if self.kind == Kind.SERVICE and self.authenticity != Authenticity.SIGNATURE:
            raise ConfigError(f'{where}: a service needs authenticity = "signature", not "{self.authenticity}"')
        if self.kind == Kind.SERVICE and self.delivery != Delivery.RELIABLE:
            raise ConfigError(f"{where}: a service is always reliable; leave delivery out")


def _any(node: str, patterns: tuple[str, ...]) -> bool:
    return any(node == pattern or fnmatchcase(node, pattern) for pattern in patterns)


def _patterns(where: str, table: Mapping[str, Any], who: str) -> tuple[str, ...]:
    value = table.get(who)
    if not isinstance(value, list) or not value:
        raise ConfigError(f"{where} needs {who} = [...] with at least one name of a node")
    for pattern in value:
        if not isinstance(pattern, str) or not _PATTERN.fullmatch(pattern):
            raise ConfigError(f"{where}: {pattern!r} in {who} is no name of a node; letters, digits, '.', '_', '-', * and ?")
    return tuple(value)


def _choice(where: str, table: Mapping[str, Any], field: str, kind: type[_Choice], default: _Choice) -> _Choice:
    value = table.get(field, default)
    try:
        return kind(value)
    except ValueError:
        raise ConfigError(f"{where}: {field} must be one of {', '.join(kind)}, not {value!r}") from None


def _seconds(where: str, table: Mapping[str, Any], field: str, low: float, high: float) -> float:
    value = table[field]
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ConfigError(f"{where}: {field} must be at least {low:g} and at most {high:g} seconds, not {value!r}")
    return float(value)
