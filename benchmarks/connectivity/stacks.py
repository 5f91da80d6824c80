"""Ways to get bytes from one process to another and back, each as a `Link`: all of them take bytes and give bytes.

sockets             TCP on loopback, no encryption, no router: the floor
cyclone             Cyclone DDS, reliable, raw CDR, no router, no encryption: ROS 2 without anything around it
zenoh tcp           Zenoh through one router, no encryption
zenoh mtls          the same with TLS and certificates on both sides; the router sees plaintext
zenoh quic          the same over QUIC
signature           ours: sealed end to end and signed, over zenoh mtls
session             ours, with the key of a session instead of a signature
session, direct     the same, with the callback on the network's thread, as Zenoh has it in the rows above
chain               ours, with a signed chain
chain, provisional  the same, delivered before the chain confirms it
..., quic           over zenoh quic
rosbridge           what rosbridge does to a message, without ROS: a server between the two (`hub`), JSON, base64, WebSocket
"""

from __future__ import annotations

import base64
import json
import socket
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

OnBytes = Callable[[bytes], Any]
OURS = ("signature", "session", "session, direct", "chain", "chain, provisional")
OVER_QUIC = ("signature, quic", "session, quic")
STACKS = ("sockets", "cyclone", "zenoh tcp", "zenoh mtls", "zenoh quic", *OURS, "rosbridge")
WAN = ("sockets", "zenoh mtls", "zenoh quic", "signature", "session", *OVER_QUIC, "rosbridge")
NEAR, FAR = "near", "far"
"""The two processes, and the two nodes of the fleet."""


class Link(ABC):
    """One end."""

    @abstractmethod
    def send(self, payload: bytes) -> None:
        """To the other end; waits if the way is full."""

    def flush(self) -> None:
        """Wait until what was sent is on its way."""
        return

    def counters(self) -> dict[str, Any]:
        """Whatever the stack counts."""
        return {}

    @abstractmethod
    def close(self) -> None:
        """End."""


def open_link(stack: str, side: str, setup: dict[str, Any], on_bytes: OnBytes) -> Link:
    """One end of a stack.

    side: near or far; far is opened first.
    setup: what both sides know: ports, folders.
    """
    if stack == "sockets":
        return Sockets(side, setup["host"], setup["ports"][stack], on_bytes)
    if stack == "rosbridge":
        return Rosbridge(side, setup["host"], setup["ports"][stack], on_bytes)
    if stack == "cyclone":
        return Cyclone(side, on_bytes)
    if stack.startswith("zenoh"):
        return Zenoh(stack, side, setup, on_bytes)
    return Ours(stack, side, setup, on_bytes)


class Sockets(Link):
    """Each message after its length."""

    def __init__(self, side: str, host: str, port: int, on_bytes: OnBytes) -> None:
        self._on_bytes = on_bytes
        self._socket: socket.socket | None = None
        self._listening: socket.socket | None = None
        if side == FAR:
            self._listening = socket.create_server((host, port))
            threading.Thread(target=self._accept, daemon=True).start()
        else:
            self._begin(socket.create_connection((host, port)))

    def _accept(self) -> None:
        assert self._listening
        self._begin(self._listening.accept()[0])

    def _begin(self, connected: socket.socket) -> None:
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connected
        threading.Thread(target=self._read, args=(connected,), daemon=True).start()

    def _read(self, connected: socket.socket) -> None:
        file = connected.makefile("rb", buffering=1 << 16)
        while head := file.read(4):
            payload = file.read(struct.unpack(">I", head)[0])
            self._on_bytes(payload)

    def send(self, payload: bytes) -> None:
        assert self._socket
        self._socket.sendall(struct.pack(">I", len(payload)) + payload)

    def close(self) -> None:
        for one in (self._socket, self._listening):
            if one is not None:
                one.close()


class Cyclone(Link):
    """A std_msgs/msg/UInt8MultiArray without dimensions, as ROS 2 would write it."""

    _HEAD = struct.Struct("<4sIII")

    def __init__(self, side: str, on_bytes: OnBytes) -> None:
        from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
        from cyclonedds.domain import DomainParticipant
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader

        from tutelage.sgc.proxies import dds_raw
        from tutelage.sgc.proxies.ros_names import topic_channel

        self._raw, self._on_bytes = dds_raw, on_bytes
        qos = Qos(Policy.History.KeepAll, Policy.Reliability.Reliable(100_000_000))
        participant = DomainParticipant(77)
        topics = [
            dds_raw.raw_topic(participant, topic_channel(name, "std_msgs/msg/UInt8MultiArray"))
            for name in (("/there", "/back") if side == NEAR else ("/back", "/there"))
        ]
        self._writer, self._reader = DataWriter(participant, topics[0], qos=qos), DataReader(participant, topics[1], qos=qos)
        self._waitset = WaitSet(participant)
        self._condition = ReadCondition(self._reader, ViewState.Any | SampleState.Any | InstanceState.Any)
        self._waitset.attach(self._condition)
        self._closed = False
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        head = self._HEAD
        while not self._closed:
            self._waitset.wait(100_000_000)
            while samples := self._raw.take(self._reader, 64):
                for sample in samples:
                    length = head.unpack_from(sample.data)[3]
                    self._on_bytes(sample.data[head.size : head.size + length])

    def wait(self) -> None:
        """Until the other side is there."""
        until = time.monotonic() + 20
        while not (self._writer.get_matched_subscriptions() and self._reader.get_matched_publications()):
            if time.monotonic() > until:
                raise TimeoutError("Cyclone DDS: the other side was not found")
            time.sleep(0.01)

    def send(self, payload: bytes) -> None:
        padding = bytes(-len(payload) % 4)
        while not self._raw.write(self._writer, self._HEAD.pack(b"\0\1\0\0", 0, 0, len(payload)), payload, padding):
            time.sleep(0.0001)

    def close(self) -> None:
        self._closed = True


def transport(protocol: str, side: str, setup: dict[str, Any]) -> Any:
    """Our transport, to the router of a protocol: tcp without certificates, tls, quic."""
    from tutelage.sgc.transport.config import Endpoint, Identity, NetworkConfig
    from tutelage.sgc.transport.zenoh import ZenohTransport

    home = Path(setup["homes"][side])
    identity = None if protocol == "tcp" else Identity(home / "root.pem", home / "leaf.pem", home / "signing.key")
    return ZenohTransport(NetworkConfig((Endpoint(protocol, setup["host"], setup["ports"][protocol]),)), identity)


class Zenoh(Link):
    """Our transport without anything on top."""

    def __init__(self, stack: str, side: str, setup: dict[str, Any], on_bytes: OnBytes) -> None:
        protocol = {"zenoh tcp": "tcp", "zenoh mtls": "tls", "zenoh quic": "quic"}[stack]
        self._transport = transport(protocol, side, setup)
        keys = setup["keys"][protocol]
        out, back = ("there", "back") if side == NEAR else ("back", "there")
        self._out = keys[out]
        self._transport.subscribe(keys[back], on_bytes)

    def send(self, payload: bytes) -> None:
        self._transport.publish(self._out, payload)

    def close(self) -> None:
        self._transport.close()


class Ours(Link):
    """Two topics of a fleet."""

    def __init__(self, stack: str, side: str, setup: dict[str, Any], on_bytes: OnBytes) -> None:
        from tutelage.sgc.node import Node

        _, *options = stack.split(", ")
        out, back = (f"{alias(stack)}-{way}" for way in (("there", "back") if side == NEAR else ("back", "there")))
        self._transport = transport("quic" if "quic" in options else "tls", side, setup)
        self._node = Node.open(Path(setup["homes"][side]), self._transport)
        self._subscription = self._node.subscribe(
            back,
            lambda message: on_bytes(message.payload),
            queue=1024,
            provisional="provisional" in options,
            direct="direct" in options,
        )
        self._publisher = self._node.publisher(out)

    def send(self, payload: bytes) -> None:
        self._publisher.send(payload, wait=10.0)

    def flush(self) -> None:
        self._publisher.flush(10.0)

    def counters(self) -> dict[str, Any]:
        return self._node.counters()

    def close(self) -> None:
        self._node.close()
        self._transport.close()


def alias(stack: str) -> str:
    """The first part of the aliases of a stack's two topics."""
    return stack.replace(", ", "-")


class Rosbridge(Link):
    """A client of `hub`, by the fastest JSON and base64 of the standard library."""

    def __init__(self, side: str, host: str, port: int, on_bytes: OnBytes) -> None:
        from websockets.sync.client import connect

        self._on_bytes = on_bytes
        out, back = ("/there", "/back") if side == NEAR else ("/back", "/there")
        self._out = out
        self._socket = connect(f"ws://{host}:{port}", proxy=None, max_size=None, compression=None)
        self._socket.send(json.dumps({"op": "subscribe", "topic": back}))
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for text in self._socket:
            self._on_bytes(base64.b64decode(json.loads(text)["msg"]["data"]))

    def send(self, payload: bytes) -> None:
        data = base64.b64encode(payload).decode()
        self._socket.send(json.dumps({"op": "publish", "topic": self._out, "msg": {"data": data}}))

    def close(self) -> None:
        self._socket.close()
