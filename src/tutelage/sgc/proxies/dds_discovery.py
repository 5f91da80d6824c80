"""What there is on a DDS domain: the topics and services of its ROS 2 nodes, to write a list of routes from."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, field

from tutelage.sgc.proxies.dds_domain import Domain
from tutelage.sgc.proxies.dds_qos import mark_of

_TYPE = re.compile(r"(\w+)::(msg|srv|action)::dds_::(\w+)_")


@dataclass
class Found:
    """A topic or service of a domain.

    Attributes:
        name, type: in ROS 2.
        service: a service; otherwise a topic.
        writers, readers: how many; of a service, clients and servers. Those of proxies do not count.
        qos: of its writers, as words, such as {"reliable", "volatile"}.
    """

    name: str
    type: str
    service: bool
    writers: int = 0
    readers: int = 0
    qos: set[str] = field(default_factory=set)


def discover(domain: Domain, seconds: float) -> list[Found]:
    """Listen to discovery for a while."""
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
    from cyclonedds.core import Policy

    readers = {
        True: BuiltinDataReader(domain.participant, BuiltinTopicDcpsPublication),
        False: BuiltinDataReader(domain.participant, BuiltinTopicDcpsSubscription),
    }
    time.sleep(seconds)
    found: dict[tuple[str, str], Found] = {}
    for writes, reader in readers.items():
        for endpoint in reader.take(N=10_000):
            if not endpoint.sample_info.valid_data:
                continue
            entry = _entry(endpoint.topic_name, endpoint.type_name)
            if entry is None or mark_of(endpoint.qos):
                continue
            entry = found.setdefault((entry.name, entry.type), entry)
            if entry.service and endpoint.topic_name.startswith("rr/"):
                continue  # a server reads requests and a client writes them: one side is enough to count
            entry.writers += writes
            entry.readers += not writes
            if writes:
                entry.qos |= {_word(endpoint.qos[policy]) for policy in (Policy.Reliability, Policy.Durability)}
    return sorted(found.values(), key=lambda entry: (entry.service, entry.name))


def _word(policy: object) -> str:
    """BestEffort -> best_effort"""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", type(policy).__name__.rpartition(".")[2]).lower()


def _entry(topic: str, dds_type: str) -> Found | None:
    """None if this is nothing of ROS 2's."""
    prefix, _, rest = topic.partition("/")
    match = _TYPE.fullmatch(dds_type)
    if match is None or prefix not in ("rt", "rq", "rr"):
        return None
    package, kind, name = match.groups()
    if prefix == "rt":
        return Found(f"/{rest}", f"{package}/{kind}/{name}", False)
    ending = {"rq": ("Request", "_Request"), "rr": ("Reply", "_Response")}[prefix]
    return Found(f"/{rest.removesuffix(ending[0])}", f"{package}/{kind}/{name.removesuffix(ending[1])}", True)
