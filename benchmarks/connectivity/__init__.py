"""Connectivity against what others use, between processes on loopback, shared memory off, every payload checked.

Round trips at four sizes and a flood of 1000-byte messages. All stacks are up at the same time and take turns, round after
round, so a busy machine loads all of them alike; what counts are ratios.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.connectivity.setup import prepare
from benchmarks.connectivity.stacks import NEAR, STACKS, Cyclone, Link, open_link

SIZES = {"64 B": 64, "8 KB": 8 << 10, "256 KB": 256 << 10, "14 MB": 14 << 20}
FLOOD_BYTES = 1000
TIMEOUT = 30.0
HELLO = b"are you there?"


class Pair:
    """One stack: our end, and the process with the other end."""

    def __init__(self, stack: str, setup: dict[str, Any]) -> None:
        self.stack = stack
        command = [sys.executable, "-m", "benchmarks.connectivity.far", stack, json.dumps(setup)]
        self._far = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._hear()
        self._came = threading.Event()
        self._got, self._length = b"", len(HELLO)
        self.link: Link = open_link(stack, NEAR, setup, self._on_bytes)
        if isinstance(self.link, Cyclone):
            self.link.wait()
        self._meet()

    def _on_bytes(self, payload: bytes) -> None:
        if len(payload) == self._length:  # and no late answer to an earlier question
            self._got = payload
            self._came.set()

    def _meet(self) -> None:
        """Until both ends hear each other."""
        until = time.monotonic() + TIMEOUT
        while not self._came.is_set():
            if time.monotonic() > until:
                raise TimeoutError(f"{self.stack}: the other end does not answer")
            self.link.send(HELLO)
            self._came.wait(0.2)
        time.sleep(0.5)

    def round_trip(self, payload: bytes) -> float:
        """Seconds there and back."""
        self._came.clear()
        self._length = len(payload)
        start = time.perf_counter()
        self.link.send(payload)
        if not self._came.wait(TIMEOUT):
            raise TimeoutError(f"{self.stack}: {len(payload)} bytes did not come back")
        took = time.perf_counter() - start
        if self._got != payload:
            raise ValueError(f"{self.stack}: something else came back")
        return took

    def flood(self, seconds: float) -> float:
        """Messages of 1000 bytes a second that arrive, one way; every one must, in order and unchanged."""
        self._tell("sink")
        filling = bytes(range(256)) * 3 + bytes(224)
        until, sent, send = time.perf_counter() + seconds, 0, self.link.send
        while time.perf_counter() < until:
            for _ in range(50):
                send(sent.to_bytes(8, "big") + filling)
                sent += 1
        self.link.flush()
        end = time.monotonic() + TIMEOUT
        while (report := self._tell("report"))["count"] < sent and time.monotonic() < end:
            time.sleep(0.05)
        self._tell("echo")
        if report["count"] != sent or report["wrong"]:
            raise ValueError(f"{self.stack}: {sent} sent, {report['count']} came, {report['wrong']} of them wrong")
        return float(sent / report["seconds"])

    def close(self) -> None:
        """Both ends."""
        assert self._far.stdin
        self._far.stdin.close()
        self.link.close()
        try:
            self._far.wait(10)
        except subprocess.TimeoutExpired:
            self._far.kill()

    def _tell(self, command: str) -> dict[str, Any]:
        assert self._far.stdin
        self._far.stdin.write(command + "\n")
        self._far.stdin.flush()
        return self._hear()

    def _hear(self) -> dict[str, Any]:
        assert self._far.stdout
        line = self._far.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.stack}: the other process ended")
        answer: dict[str, Any] = json.loads(line)
        return answer


@contextmanager
def pairs(stacks: tuple[str, ...]) -> Iterator[dict[str, Pair]]:
    """All stacks, with the routers that they need."""
    with ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        setup = stack.enter_context(prepare(Path(folder)))
        made: dict[str, Pair] = {}
        for name in stacks:
            made[name] = Pair(name, setup)
            stack.callback(made[name].close)
        yield made


def run(quick: bool = False, stacks: tuple[str, ...] = STACKS) -> dict[str, Any]:
    """Round trips and floods; prints the tables."""
    rounds, flood = (2, 0.5) if quick else (7, 2.0)
    trips = {"64 B": 100, "8 KB": 60, "256 KB": 20, "14 MB": 3}
    times: dict[str, dict[str, list[list[float]]]] = {}
    rates: dict[str, list[float]] = {name: [] for name in stacks}
    with pairs(stacks) as made:
        for turn in range(rounds):
            order = [*stacks[turn % len(stacks) :], *stacks[: turn % len(stacks)]]
            for size, length in SIZES.items():
                for name in order:
                    taken = [made[name].round_trip(os.urandom(length)) for _ in range(trips[size])]
                    times.setdefault(name, {}).setdefault(size, []).append(taken)
            for name in order:
                rates[name].append(made[name].flood(flood))
    return report(stacks, times, rates)


def report(
    stacks: tuple[str, ...], times: dict[str, dict[str, list[list[float]]]], rates: dict[str, list[float]]
) -> dict[str, Any]:
    """Medians, and ratios of a round's medians to Zenoh's with mutual TLS (round trips) and to Cyclone's (rates)."""
    from benchmarks.timing import table  # loads torch, which the other processes of this benchmark do not need

    middle = {n: {s: [statistics.median(taken) for taken in turns] for s, turns in of.items()} for n, of in times.items()}
    rows = []
    for name in stacks:
        row: dict[str, Any] = {"stack": name}
        row |= {f"{size} ms": 1e3 * statistics.median(middle[name][size]) for size in SIZES}
        row["messages/s"] = statistics.median(rates[name])
        rows.append(row)
    print("\nround trip, median; 1000-byte messages a second that arrived, one way\n")
    print(table(list(rows[0]), [list(row.values()) for row in rows]))
    ratios = []
    for name in stacks:
        ratio: dict[str, Any] = {"stack": name}
        for size in SIZES:
            pairs_ = zip(middle[name][size], middle["zenoh mtls"][size], strict=True)
            ratio[f"{size} / zenoh mtls"] = statistics.median(ours / theirs for ours, theirs in pairs_)
        for other in ("cyclone", "rosbridge"):
            ratio[f"rate / {other}"] = statistics.median(a / b for a, b in zip(rates[name], rates[other], strict=True))
        ratios.append(ratio)
    print("\nratios, medians over rounds\n")
    print(table(list(ratios[0]), [list(row.values()) for row in ratios]))
    return {"round_trips_and_rates": rows, "ratios": ratios, "rounds": len(next(iter(rates.values())))}
