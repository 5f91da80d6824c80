"""ROS 2 nodes as DDS sees them, made of plain Cyclone DDS participants; nothing of the proxies is used but raw topics.

Typed classes are Cyclone's own serialization; raw ends carry what rosbags serializes, of any type. (No postponed annotations
here: Cyclone DDS reads the types of fields.)
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int64, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.typesys import Stores, get_typestore

from tutelage.sgc.proxies import dds_raw
from tutelage.sgc.proxies.ros_names import service_channels, topic_channel

STORE = get_typestore(Stores.ROS2_JAZZY)
STRING, IMAGE = "std_msgs/msg/String", "sensor_msgs/msg/Image"
ADD = "example_interfaces/srv/AddTwoInts"
RELIABLE = Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(400))
BEST_EFFORT = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(400))
LATCHED = Qos(
    Policy.Reliability.Reliable(10**9),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(10),
    Policy.DurabilityService(0, Policy.History.KeepLast(10), -1, -1, -1),
)


@dataclass
class String(IdlStruct, typename="std_msgs.msg.dds_.String_"):
    data: str


@dataclass
class AddRequest(IdlStruct, typename="example_interfaces.srv.dds_.AddTwoInts_Request_"):
    client: uint64
    number: int64
    a: int64
    b: int64


@dataclass
class AddResponse(IdlStruct, typename="example_interfaces.srv.dds_.AddTwoInts_Response_"):
    client: uint64
    number: int64
    sum: int64


def until(condition: Callable[[], Any], timeout: float = 10.0) -> Any:
    """Wait until the condition holds; its value, or the last one when time is over."""
    end = time.monotonic() + timeout
    while not (value := condition()) and time.monotonic() < end:
        time.sleep(0.01)
    return value


def cdr(type_name: str, **fields: Any) -> bytes:
    """A message, serialized by rosbags."""
    return bytes(STORE.serialize_cdr(STORE.types[type_name](**fields), type_name))


class RosNode:
    """A participant with typed ends."""

    def __init__(self, domain: int) -> None:
        self.participant = DomainParticipant(domain)

    def publisher(self, name: str, kind: Any = String, qos: Any = RELIABLE) -> DataWriter[Any]:
        return DataWriter(self.participant, Topic(self.participant, f"rt{name}", kind), qos=qos)

    def subscription(self, name: str, kind: Any = String, qos: Any = RELIABLE) -> DataReader[Any]:
        return DataReader(self.participant, Topic(self.participant, f"rt{name}", kind), qos=qos)

    def raw_publisher(self, name: str, type_name: str, qos: Any = RELIABLE) -> DataWriter[Any]:
        return DataWriter(self.participant, dds_raw.raw_topic(self.participant, topic_channel(name, type_name)), qos=qos)

    def raw_subscription(self, name: str, type_name: str, qos: Any = RELIABLE) -> DataReader[Any]:
        return DataReader(self.participant, dds_raw.raw_topic(self.participant, topic_channel(name, type_name)), qos=qos)

    def say(self, name: str, texts: list[str], qos: Any = RELIABLE) -> DataWriter[Any]:
        """Publish once a subscription is there."""
        writer = self.publisher(name, qos=qos)
        assert until(writer.get_matched_subscriptions), f"nobody subscribes to {name}"
        for text in texts:
            writer.write(String(text))
        return writer


def taken(reader: DataReader[Any], count: int, timeout: float = 10.0) -> list[str]:
    """The texts that come, until there are `count`."""
    texts: list[str] = []

    def enough() -> bool:
        texts.extend(sample.data for sample in reader.take(N=500) if isinstance(sample, String))
        return len(texts) >= count

    until(enough, timeout)
    return texts


class AddServer:
    """A service server, as rmw_cyclonedds would be seen on the wire: answers with the sum."""

    def __init__(self, domain: int, name: str = "/add", delay: float = 0.0) -> None:
        self._node, self._delay = RosNode(domain), delay
        participant = self._node.participant
        requests, replies = service_channels(name, ADD)
        self._reader = DataReader(participant, Topic(participant, requests.topic, AddRequest), qos=RELIABLE)
        self._writer = DataWriter(participant, Topic(participant, replies.topic, AddResponse), qos=RELIABLE)
        self.asked: list[tuple[int, int]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.005):
            for request in self._reader.take(N=10):
                if isinstance(request, AddRequest):
                    self.asked.append((request.a, request.b))
                    time.sleep(self._delay)
                    self._writer.write(AddResponse(request.client, request.number, request.a + request.b))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


class AddClient:
    """A service client, likewise."""

    def __init__(self, domain: int, name: str = "/add", client: int = 7) -> None:
        self._node = RosNode(domain)
        participant = self._node.participant
        requests, replies = service_channels(name, ADD)
        self._reader = DataReader(participant, Topic(participant, replies.topic, AddResponse), qos=RELIABLE)
        self._writer = DataWriter(participant, Topic(participant, requests.topic, AddRequest), qos=RELIABLE)
        self._client, self._number = client, 0

    @property
    def server_is_there(self) -> bool:
        return bool(self._writer.get_matched_subscriptions() and self._reader.get_matched_publications())

    def ask(self, a: int, b: int) -> int:
        """Send a request; its number."""
        self._number += 1
        self._writer.write(AddRequest(self._client, self._number, a, b))
        return self._number

    def call(self, a: int, b: int, timeout: float = 5.0) -> int | None:
        """The sum, None if no reply comes."""
        assert until(lambda: self.server_is_there), "no server"
        number = self.ask(a, b)
        sums: list[int] = []

        def answered() -> bool:
            replies = [reply for reply in self._reader.take(N=10) if isinstance(reply, AddResponse)]
            sums.extend(reply.sum for reply in replies if (reply.client, reply.number) == (self._client, number))
            return bool(sums)

        until(answered, timeout)
        return sums[0] if sums else None
