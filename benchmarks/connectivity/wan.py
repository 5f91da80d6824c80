"""Round trips over an emulated wide-area network, 40 ms and 1 % loss each way, as the dissertation's figure 8.7 has them
over a real one: a message goes to the cloud, which answers with 32 bytes. Routers and servers are in the cloud.

`python -m benchmarks.connectivity.wan SETUP ROUNDS` is the robot's side, which runs in a network namespace of its own.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.connectivity.pair import pairs
from benchmarks.connectivity.relay import ADDRESSES
from benchmarks.connectivity.setup import prepare
from benchmarks.connectivity.stacks import WAN

DELAY, LOSS = 0.040, 0.01
SIZES = {"64 B": 64, "8000 B": 8000, "256 KB": 256 << 10}
TRIPS = {"64 B": 20, "8000 B": 20, "256 KB": 4}
"""In a round."""


def why_not() -> str:
    """Why this machine cannot do it; "" if it can."""
    if os.geteuid() != 0 or not Path("/dev/net/tun").exists():
        return "an emulated wide-area network needs root and /dev/net/tun"
    return ""


def measure(quick: bool = False) -> dict[str, Any]:
    """Milliseconds, means over 60 messages (12 of 256 KB), so what a lost packet costs is in them."""
    if why_not():
        return {"skipped": why_not()}
    with namespaces() as (robot, cloud), tempfile.TemporaryDirectory() as folder:
        inside = ["ip", "netns", "exec"]
        relay = [sys.executable, "-m", "benchmarks.connectivity.relay", robot, cloud, str(DELAY), str(LOSS)]
        running = subprocess.Popen(relay, stdout=subprocess.PIPE)
        try:
            assert running.stdout
            if not running.stdout.readline():
                raise RuntimeError("the relay did not come up")
            with prepare(Path(folder), ADDRESSES[1], [*inside, cloud]) as setup:
                command = [sys.executable, "-m", "benchmarks.connectivity.wan", json.dumps(setup), "1" if quick else "3"]
                done = subprocess.run([*inside, robot, *command], stdout=subprocess.PIPE, check=True, timeout=600)
        finally:
            running.kill()
    return {"delay ms": 1e3 * DELAY, "loss %": 1e2 * LOSS, "round_trips": json.loads(done.stdout)}


@contextmanager
def namespaces() -> Iterator[list[str]]:
    """Two networks with nothing but their loopback devices."""
    with ExitStack() as stack:
        names = [f"wan{os.getpid()}-{place}" for place in ("robot", "cloud")]
        for name in names:
            subprocess.run(["ip", "netns", "add", name], check=True)
            stack.callback(subprocess.run, ["ip", "netns", "del", name], check=False)
            subprocess.run(["ip", "netns", "exec", name, "ip", "link", "set", "lo", "up"], check=True)
        yield names


def robot(setup: dict[str, Any], rounds: int) -> list[dict[str, Any]]:
    """All stacks in turns. Zenoh by itself loses what is on its way when a connection is given up; that is counted."""
    times: dict[str, dict[str, list[float]]] = {name: {size: [] for size in SIZES} for name in WAN}
    lost = dict.fromkeys(WAN, 0)

    def trips(name: str, size: str) -> None:
        for _ in range(TRIPS[size]):
            try:
                times[name][size].append(1e3 * made[name].round_trip(os.urandom(SIZES[size])))
            except TimeoutError:
                if not name.startswith("zenoh"):
                    raise
                lost[name] += 1

    with pairs(WAN, setup) as made:
        for pair in made.values():
            pair.answer_with("digest")
        for turn in range(rounds):
            for size in SIZES:
                for name in [*WAN[turn % len(WAN) :], *WAN[: turn % len(WAN)]]:
                    trips(name, size)
    return [
        {"stack": name} | {f"{size} mean ms": statistics.mean(taken) for size, taken in of.items()} | {"lost": lost[name]}
        for name, of in times.items()
    ]


if __name__ == "__main__":
    print(json.dumps(robot(json.loads(sys.argv[1]), int(sys.argv[2]))))
