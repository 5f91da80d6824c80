"""A fleet of two nodes on loopback, with a router for each protocol that is measured."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.connectivity.stacks import FAR, NEAR, OURS, OVER_QUIC, alias
from tutelage.sgc import lanes
from tutelage.sgc.local import LocalFleet
from tutelage.sgc.ports import free_ports

LOOPBACK = """<CycloneDDS><Domain Id="any">
<General>
<Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
<MaxMessageSize>65500B</MaxMessageSize><FragmentSize>60000B</FragmentSize>
</General>
<Discovery>
<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers><SPDPInterval>500ms</SPDPInterval>
</Discovery>
<Internal><SocketReceiveBufferSize min="default" max="4MB"/></Internal>
</Domain></CycloneDDS>"""
"""Cyclone DDS must not leave the machine, finds its peers without multicast, and is tuned for large messages on loopback."""


MODES = {alias(stack): stack.split(", ")[0] for stack in (*OURS, *OVER_QUIC)}
"""Kind of authenticity, by the first part of the aliases."""

PLAIN = ("tcp", "tls", "quic")
"""Protocols of Zenoh alone; each has names of its own, as two of them share a router."""


def policy() -> str:
    """A topic each way for each kind of authenticity."""
    tables = ["version = 1"]
    for topic in (*MODES, *PLAIN):
        mode = MODES.get(topic, "signature")
        for way, (sender, receiver) in {"there": (NEAR, FAR), "back": (FAR, NEAR)}.items():
            tables.append(
                f'[topics.{topic}-{way}]\nnode = "{sender}"\ninterface = "/{topic}/{way}"\n'
                f'type = "std_msgs/msg/UInt8MultiArray"\nowner = "{sender}"\n'
                f'publish = ["{sender}"]\nsubscribe = ["{receiver}"]\nauthenticity = "{mode}"\n'
            )
    return "\n".join(tables)


@contextmanager
def prepare(folder: Path, host: str = "127.0.0.1", inside: Sequence[str] = ()) -> Iterator[dict[str, Any]]:
    """What all processes are told; routers run in processes of their own until the end.

    host: where routers and servers listen. inside: words before the commands of the far side, such as ip netns exec.
    """
    os.environ["CYCLONEDDS_URI"] = LOOPBACK
    homes = LocalFleet(folder, policy(), (NEAR, FAR), host=host).homes
    topics = homes[NEAR].access.topics
    keys = {
        each: {way: lanes.key(topics[f"{each}-{way}"].name, lanes.STREAM) for way in ("there", "back")} for each in PLAIN
    }
    ports = dict(zip(("sockets", "rosbridge", *PLAIN), free_ports(5), strict=True))
    setup = {
        "homes": {name: str(home.path) for name, home in homes.items()},
        "keys": keys,
        "host": host,
        "ports": ports,
        "inside": list(inside),
    }
    tls, quic = (f"{protocol}/{host}:{ports[protocol]}" for protocol in ("tls", "quic"))
    with ExitStack() as stack:
        for program, *arguments in (
            ("route", "plain", f"tcp/{host}:{ports['tcp']}"),
            ("route", str(homes["router-1"].path), tls, quic),
            ("hub", host, str(ports["rosbridge"])),
        ):
            command = [*inside, sys.executable, "-m", f"benchmarks.connectivity.{program}", *arguments]
            router = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            stack.callback(router.kill)
            assert router.stdout
            if not router.stdout.readline():
                raise RuntimeError("a router did not come up")
        yield setup
