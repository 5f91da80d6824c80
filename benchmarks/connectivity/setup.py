"""A fleet of two nodes on loopback, with a router for each protocol that is measured."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.connectivity.stacks import FAR, NEAR
from tutelage.sgc.local import LocalFleet
from tutelage.sgc.transport.config import Endpoint, NetworkConfig

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


MODES = {"signature": "signature", "session": "session", "chain": "chain", "provisional": "chain"}
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


def free_ports(count: int) -> list[int]:
    """Ports of loopback that nobody uses, TCP and UDP."""
    import socket

    with ExitStack() as stack:
        found = []
        for _ in range(count):
            tcp = stack.enter_context(socket.socket())
            tcp.bind(("127.0.0.1", 0))
            found.append(tcp.getsockname()[1])
        return found


@contextmanager
def prepare(folder: Path) -> Iterator[dict[str, Any]]:
    """What all processes are told; routers run in processes of their own until the end."""
    os.environ["CYCLONEDDS_URI"] = LOOPBACK
    homes = LocalFleet(folder, policy(), (NEAR, FAR)).homes
    sockets, rosbridge, tcp, tls, quic = free_ports(5)
    for name in (NEAR, FAR):
        NetworkConfig((Endpoint("tls", "127.0.0.1", tls),)).save(homes[name].path)
    topics = homes[NEAR].access.topics
    names = {each: {way: topics[f"{each}-{way}"].name.hex() for way in ("there", "back")} for each in PLAIN}
    ports = {"sockets": sockets, "rosbridge": rosbridge, "zenoh tcp": tcp, "zenoh mtls": tls, "zenoh quic": quic}
    setup = {
        "homes": {name: str(home.path) for name, home in homes.items()},
        "names": names,
        "ports": ports,
    }
    with ExitStack() as stack:
        for arguments in (
            ("plain", str(tcp)),
            (str(homes["router-1"].path), f"tls/127.0.0.1:{tls}", f"quic/127.0.0.1:{quic}"),
        ):
            command = [sys.executable, "-m", "benchmarks.connectivity.route", *arguments]
            router = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            stack.callback(router.kill)
            assert router.stdout
            if not router.stdout.readline():
                raise RuntimeError("a router did not come up")
        yield setup
