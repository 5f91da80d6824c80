"""The proxies: what a ROS 2 domain joined to another one over a router costs beside one domain, and rosbridge's rate.

Everything runs on loopback: DDS without multicast, the router with TLS and access control, messages sealed and signed, each
part in a process of its own. Every payload is checked.

- latency: a sender publishes a message, and an echo on the other side publishes it again on a second topic. `direct` is one
  DDS domain; `router` are two domains, each with a proxy, joined by a Zenoh router.
- flood: messages of 1000 bytes as fast as they go for two seconds, those that arrive are counted.
- rosbridge: JSON over WebSocket from a client of one bridge to a client of another, both joined by the router.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import queue
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import table
from tutelage.sgc.local import LocalFleet

IMAGE = "sensor_msgs/msg/Image"
SIZES = (64, 8192, 262_144, 14_000_000)
FLOOD_BYTES = 1000
TOPIC = """
[topics.{alias}]
node = "{sender}"
interface = "/{alias}"
type = "{type}"
owner = "{sender}"
publish = ["{sender}"]
subscribe = ["{receiver}"]
"""
TOPIC_ROUTE = """
[[topic]]
alias = "{alias}"
domain = {domain}
queue = 1000
qos = {{depth = 1000}}
"""
CYCLONE = """
<CycloneDDS><Domain Id="any">
  <General>
    <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
    <AllowMulticast>false</AllowMulticast><MaxMessageSize>65500B</MaxMessageSize>
  </General>
  <Discovery>
    <Tag>{tag}</Tag><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>"""
NEAR, FAR = 20, 21  # DDS domains


def run(quick: bool = False) -> dict[str, Any]:
    """Round trips in milliseconds, and messages a second."""
    os.environ["CYCLONEDDS_URI"] = CYCLONE.format(tag=f"benchmark-{os.getpid()}")
    with tempfile.TemporaryDirectory() as folder, _network(Path(folder)):
        latency = _latency(20 if quick else 100)
        floods = _floods(3 if quick else 5)
        bridges = _rosbridge(Path(folder), 3 if quick else 5)
    head = ["round trip, ms", "direct p50", "p99", "router p50", "p99", "router / direct"]
    columns = ("direct_p50", "direct_p99", "router_p50", "router_p99", "ratio")
    print(table(head, [[f"{result['bytes']:,} B", *(result[column] for column in columns)] for result in latency]))
    print()
    print(table(["messages of 1000 B", "a second"], [[name, round(rate)] for name, rate in {**floods, **bridges}.items()]))
    return {"latency": latency, "rates": {**floods, **bridges}}


@contextlib.contextmanager
def _network(folder: Path) -> Iterator[None]:
    """Two nodes with a ROS 2 proxy each, a router between them, all in processes of their own; two nodes for rosbridges."""
    pairs = {"there": ("near", "far"), "back": ("far", "near"), "web": ("web-near", "web-far")}
    types = {"there": IMAGE, "back": IMAGE, "web": "std_msgs/msg/String"}
    tables = (TOPIC.format(alias=a, sender=s, receiver=r, type=types[a]) for a, (s, r) in pairs.items())
    fleet = LocalFleet(folder, "version = 1\n" + "".join(tables), ("near", "far", "web-near", "web-far"))
    for name, domain in (("near", NEAR), ("far", FAR)):
        both = (TOPIC_ROUTE.format(alias=alias, domain=domain) for alias in ("there", "back"))
        (folder / f"{name}.toml").write_text("version = 1\n" + "".join(both))
    with contextlib.ExitStack() as stack:
        for verb in (
            ["router", str(folder / "router-1"), "--listen", fleet.addresses[0]],
            ["proxy", "ros2", str(folder / "near"), str(folder / "near.toml")],
            ["proxy", "ros2", str(folder / "far"), str(folder / "far.toml")],
        ):
            stack.enter_context(_started(verb))
        yield


@contextlib.contextmanager
def _started(arguments: list[str]) -> Iterator[str]:
    """A `tutelage` process; the line by which it says that it runs."""
    code = "import sys; from tutelage.cli import main; main(sys.argv[1:])"
    process = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process.stdout.readline()
    finally:
        process.terminate()
        process.wait(20)


# -- ROS 2 ----------------------------------------------------------------------------------------------------------------


class _Ends:
    """A DDS writer and a DDS reader of raw images."""

    def __init__(self, domain: int, says: str, hears: str) -> None:
        from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
        from cyclonedds.domain import DomainParticipant
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader

        from tutelage.sgc.proxies import dds_raw
        from tutelage.sgc.proxies.ros_names import topic_channel

        qos = Qos(Policy.Reliability.Reliable(10**10), Policy.History.KeepLast(1000))
        self.participant = DomainParticipant(domain)
        makes = [dds_raw.raw_topic(self.participant, topic_channel(name, IMAGE)) for name in (says, hears)]
        self.writer = DataWriter(self.participant, makes[0], qos=qos)
        self.reader = DataReader(self.participant, makes[1], qos=qos)
        self._waitset = WaitSet(self.participant)
        self._waitset.attach(ReadCondition(self.reader, ViewState.Any | SampleState.Any | InstanceState.Any))
        self._write, self._take = dds_raw.write, dds_raw.take

    def ready(self) -> None:
        """Wait for the other ends."""
        while not (self.writer.get_matched_subscriptions() and self.reader.get_matched_publications()):
            time.sleep(0.01)

    def write(self, data: bytes) -> None:
        """Publish."""
        self._write(self.writer, data)

    def take(self, timeout: float) -> list[bytes]:
        """What has come, within a time in seconds."""
        self._waitset.wait(int(timeout * 1e9))
        return [sample.data for sample in self._take(self.reader, 64)]


def _echo(domain: int, hears: str, says: str, counts: Any) -> None:
    """A process: what comes goes back, unless it is a flood, which is counted."""
    ends = _Ends(domain, says, hears)
    flood, first, last = 0, 0.0, 0.0
    while True:
        for data in ends.take(0.5):
            if len(data) == FLOOD_BYTES + 4:
                now = time.perf_counter()
                first = first if flood else now
                flood, last = flood + 1, now
            else:
                ends.write(data)
        if flood and time.perf_counter() - last > 0.5:
            counts.put((flood, last - first))
            flood = 0


@contextlib.contextmanager
def _echoing(domain: int, hears: str, says: str) -> Iterator[Any]:
    context = multiprocessing.get_context("spawn")
    counts = context.Queue()
    process = context.Process(target=_echo, args=(domain, hears, says, counts), daemon=True)
    process.start()
    try:
        yield counts
    finally:
        process.terminate()
        process.join()


def _latency(rounds: int) -> list[dict[str, Any]]:
    results = []
    with _echoing(NEAR, "/direct", "/direct_back"), _echoing(FAR, "/there", "/back"):
        ends = {"direct": _Ends(NEAR, "/direct", "/direct_back"), "router": _Ends(NEAR, "/there", "/back")}
        for each in ends.values():
            _warm_up(each)
        for size in SIZES:
            took: dict[str, list[float]] = {name: [] for name in ends}
            for _ in range(rounds if size < 1 << 20 else max(5, rounds // 10)):
                for name, each in ends.items():
                    took[name].append(1000 * _round_trip(each, b"\0\1\0\0" + os.urandom(size)))
            figures = {
                f"{name}_p{p}": round(float(np.percentile(times, p)), 3) for name, times in took.items() for p in (50, 99)
            }
            ratio = float(np.median(np.array(took["router"]) / np.array(took["direct"])))
            results.append({"bytes": size, **figures, "ratio": round(ratio, 2)})
    return results


def _warm_up(ends: _Ends) -> None:
    """Until discovery is done everywhere, and keys and introductions have been exchanged."""
    ends.ready()
    for _ in range(60):
        with contextlib.suppress(RuntimeError):
            _round_trip(ends, b"\0\1\0\0" + os.urandom(64), patience=1.0)
            break
    while ends.take(1.0):  # echoes that came too late
        pass


def _round_trip(ends: _Ends, data: bytes, patience: float = 10.0) -> float:
    start = time.perf_counter()
    ends.write(data)
    while time.perf_counter() - start < patience:
        for came in ends.take(0.5):
            if came == data:
                return time.perf_counter() - start
    raise RuntimeError(f"{len(data)} bytes did not come back within {patience:g} s")


def _floods(rounds: int) -> dict[str, float]:
    rates: dict[str, list[float]] = {"direct DDS": [], "ROS 2 over the router": []}
    payload = b"\0\1\0\0" + os.urandom(FLOOD_BYTES)
    with _echoing(NEAR, "/direct", "/direct_back") as near, _echoing(FAR, "/there", "/back") as far:
        ways = {"direct DDS": (_Ends(NEAR, "/direct", "/direct_back"), near)}
        ways["ROS 2 over the router"] = (_Ends(NEAR, "/there", "/back"), far)
        for ends, _ in ways.values():
            _warm_up(ends)
        for _ in range(rounds):
            for name, (ends, counts) in ways.items():
                until = time.perf_counter() + 2.0
                while time.perf_counter() < until:
                    ends.write(payload)
                count, seconds = counts.get(timeout=60.0)
                rates[name].append(count / seconds)
    return {name: float(np.median(found)) for name, found in rates.items()}


# -- rosbridge ------------------------------------------------------------------------------------------------------------


def _rosbridge(folder: Path, rounds: int) -> dict[str, float]:
    """Messages a second from client to client, in JSON; and from a bridge's client to another of the same bridge."""
    from websockets.sync.client import connect

    text = "x" * (FLOOD_BYTES - 9)  # with CDR's header and the length of the text: 1000 bytes
    frame = json.dumps({"op": "publish", "topic": "/web", "msg": {"data": text}})
    routes = folder / "web.toml"
    routes.write_text('version = 1\n[[topic]]\nalias = "web"\nqueue = 1000\n')
    rates: list[float] = []
    arguments = ["--routes", str(routes), "--listen", "127.0.0.1:0"]
    with contextlib.ExitStack() as stack:
        near, far = (
            stack.enter_context(_started(["proxy", "rosbridge", str(folder / name), *arguments]))
            for name in ("web-near", "web-far")
        )
        context = multiprocessing.get_context("spawn")
        counts = context.Queue()
        listener = context.Process(target=_listen, args=(_url(far), text, counts), daemon=True)
        listener.start()
        assert counts.get(timeout=60.0) == "ready"
        page = stack.enter_context(connect(_url(near), compression=None))
        for _ in range(rounds + 1):
            until = time.perf_counter() + 2.0
            while time.perf_counter() < until:
                page.send(frame)
            with contextlib.suppress(queue.Empty):
                count, seconds = counts.get(timeout=60.0)
                rates.append(count / seconds)
        listener.terminate()
    return {"rosbridge to rosbridge over the router": float(np.median(rates[1:]))}


def _url(said: str) -> str:
    return next(word.rstrip(";") for word in said.split() if word.startswith("ws://"))


def _listen(url: str, text: str, counts: Any) -> None:
    """A process: counts floods of messages, whose content is checked."""
    from websockets.sync.client import connect

    with connect(url, compression=None) as page:
        page.send(json.dumps({"op": "set_level", "level": "info"}))
        page.send(json.dumps({"op": "subscribe", "topic": "/web"}))
        assert json.loads(page.recv())["level"] == "info"
        counts.put("ready")
        while True:
            assert json.loads(page.recv())["msg"]["data"] == text
            count, first = 1, time.perf_counter()
            last = first
            while True:
                try:
                    came = page.recv(timeout=0.5)
                except TimeoutError:
                    break
                assert json.loads(came)["msg"]["data"] == text
                count, last = count + 1, time.perf_counter()
            if count > 100:
                counts.put((count, last - first))
