"""The policy: one file (TOML) for a fleet that says who may say and hear what.

    version = 1

    [topics.camera]
    node = "drone-1"                    # metadata, from which the name is made: see `tutelage.sgc.names.Topic`
    interface = "/camera"
    type = "sensor_msgs/msg/Image"
    owner = "drone-1"                   # hands out the topic's keys
    publish = ["drone-1"]
    subscribe = ["server", "operator-*"]
    authenticity = "signature"          # or "session", "chain"
    delivery = "lossy"                  # or "reliable"
    max_age = 0.5                       # seconds

Beside `topics` there may be `renewals = "office"`: the node that renews certificates over the network
(`tutelage keys serve`).

The fleet's authority signs each node's part of it (`Access`); no node is told more than its own part.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from tutelage.errors import ConfigError
from tutelage.sgc.access import Entry, Route
from tutelage.sgc.rules import NODE_NAME, Kind, Lane, TopicRule

VERSION = 1
TEMPLATE = """version = 1

# Who may say and hear what. Without a table here nobody may do anything. After a change: tutelage keys issue FOLDER --policy
#
# renewals = "office"               # the node that renews certificates over the network: tutelage keys serve
#
# [topics.camera]
# node = "drone-1"                  # metadata: its 256-bit name is made from it
# interface = "/camera"
# type = "sensor_msgs/msg/Image"
# owner = "drone-1"                 # the node that hands out the topic's keys
# publish = ["drone-1"]
# subscribe = ["server", "operator-*"]
# authenticity = "signature"        # or "session", "chain"
# delivery = "lossy"                # or "reliable"
# max_age = 0.5                     # seconds; commands should have one
"""
"""The file of a new fleet."""


@dataclass(frozen=True)
class Policy:
    """What the file says.

    Attributes:
        topics: all of the fleet, by alias.
        renewals: the node that renews certificates and hands out changes of the policy over the network; "" for none.
    """

    topics: Mapping[str, TopicRule]
    renewals: str = ""

    @classmethod
    def parse(cls, text: str) -> Policy:
        """Read a policy.

        Raises:
            ConfigError: not TOML, an unknown field, or an impossible combination; the message names the topic.
        """
        try:
            content = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"the policy is not TOML: {error}") from None
        if unknown := sorted(content.keys() - {"version", "topics", "renewals"}):
            raise ConfigError(f"the policy has an unknown field {unknown[0]!r}; topics are tables, [topics.camera]")
        if content.get("version") != VERSION:
            raise ConfigError(f"the policy needs version = {VERSION}, not {content.get('version')!r}")
        tables = content.get("topics", {})
        if not isinstance(tables, dict):
            raise ConfigError("topics of the policy must be tables, [topics.camera]")
        topics = {alias: TopicRule.from_table(alias, table) for alias, table in tables.items()}
        seen: dict[bytes, str] = {}
        for alias, rule in topics.items():
            other = seen.setdefault(rule.topic.canonical(), alias)
            if other != alias:
                raise ConfigError(
                    f"topics {other!r} and {alias!r} of the policy have the same metadata, so the same name; "
                    f'give one of them unique = "..."'
                )
        renewals = content.get("renewals", "")
        if renewals != "" and not (isinstance(renewals, str) and NODE_NAME.fullmatch(renewals)):
            raise ConfigError(f"renewals of the policy must be the name of one node, not {renewals!r}")
        return cls(topics, renewals)

    @classmethod
    def load(cls, path: Path) -> Policy:
        """Read a policy file.

        Raises:
            ConfigError: see `parse`; the message names the file.
        """
        try:
            return cls.parse(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ConfigError(f"no policy file {path}") from None
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"cannot read {path}: {error}") from None
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None

    def of_node(self, node: str) -> dict[str, TopicRule]:
        """The topics in which a node has a part."""
        return {alias: rule for alias, rule in self.topics.items() if rule.is_member(node)}


def routes(entries: Iterable[Entry], pseudonyms: Mapping[str, str]) -> tuple[Route, ...]:
    """What a router must know of topics.

    pseudonyms: of all nodes that are members now, by name.
    """

    def who(patterns_allow: Iterable[tuple[str, bool]]) -> frozenset[str]:
        return frozenset(pseudonyms[node] for node, allowed in patterns_allow if allowed)

    found = []
    for entry in entries:
        rule = entry.rule
        lane = Lane.STREAM if rule.kind == Kind.STREAM else Lane.REQUEST
        send = who((node, rule.may_send(node, lane)) for node in pseudonyms)
        receive = who((node, rule.may_receive(node, lane)) for node in pseudonyms)
        found.append(Route(entry.name, rule.kind, pseudonyms.get(rule.owner, ""), send, receive))
    return tuple(found)
