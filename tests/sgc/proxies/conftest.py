"""DDS stays on the loopback interface, without multicast; a tag keeps this run apart from others on the machine."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from sgc.fleets import Fleet

from tutelage.sgc.node import Node
from tutelage.sgc.transport.memory import MemoryTransport, Network

CYCLONE = """
<CycloneDDS><Domain Id="any">
  <General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast></General>
  <Discovery>
    {tag}<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>"""
os.environ["CYCLONEDDS_URI"] = CYCLONE.format(tag=f"<Tag>{os.getpid()}</Tag>")
_domains = itertools.cycle(range(1, 80))


@dataclass
class Company:
    """Nodes of one fleet, joined in this process. Each is opened when it is first asked for: `company["robot"]`."""

    fleet: Fleet
    network: Network = field(default_factory=Network)
    nodes: dict[str, Node] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Node:
        if name not in self.nodes:
            self.nodes[name] = Node.open(self.fleet[name], MemoryTransport(self.network))
        return self.nodes[name]

    def __iter__(self) -> Iterator[Node]:
        return (self[name] for name in self.fleet.homes)

    def close(self) -> None:
        for node in self.nodes.values():
            node.close()


@pytest.fixture
def domains() -> Iterator[int]:
    """DDS domains that no other test has at the same time: `next(domains)`. From 80 on they are for Fast DDS."""
    return _domains


@pytest.fixture
def company(tmp_path: Path) -> Iterator[Callable[..., Company]]:
    """`company(policy, "robot", "server")`: nodes with real keys, closed after the test."""
    made: list[Company] = []

    def make(policy: str, *names: str) -> Company:
        made.append(Company(Fleet(tmp_path / f"fleet{len(made)}", policy, names)))
        return made[-1]

    yield make
    for each in made:
        each.close()
