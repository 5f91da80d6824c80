"""Nodes of one fleet in one process, and DDS that stays on the loopback interface."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field

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


def stay_on_loopback() -> None:
    """For all DDS domains of this process; a tag keeps them apart from those of other runs on the machine."""
    os.environ["CYCLONEDDS_URI"] = CYCLONE.format(tag=f"<Tag>{os.getpid()}</Tag>")


@dataclass
class Company:
    """Nodes joined in this process. Each is opened when it is first asked for: `company["robot"]`."""

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
