"""Two ends of a stack in two processes: round trips and floods between them."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.connectivity.setup import prepare
from benchmarks.connectivity.stacks import NEAR, Cyclone, Link, alias, open_link

TIMEOUT = 30.0
HELLO = b"are you there?"


class Pair:
    """One stack: our end, and the process with the other end."""

    def __init__(self, stack: str, setup: dict[str, Any]) -> None:
        self.stack = stack
        command = [*setup["inside"], sys.executable, "-m", "benchmarks.connectivity.far", stack, json.dumps(setup)]
        self._far = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._hear()
        self._came = threading.Event()
        self._got, self._digest, self._length, self._short = b"", b"", len(HELLO), False
        self.link: Link = open_link(stack, NEAR, setup, self._on_bytes)
        if isinstance(self.link, Cyclone):
            self.link.wait()
        self._meet()

    def _on_bytes(self, payload: bytes) -> None:
        if len(payload) == self._length and (not self._short or payload == self._digest):  # else a late answer to another
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

    def answer_with(self, what: str) -> None:
        """What the other end answers from now on: "echo", the payload itself, or "digest", its SHA-256."""
        self._tell(what)
        self._short = what == "digest"

    def round_trip(self, payload: bytes) -> float:
        """Seconds there and back."""
        expected = self._digest = hashlib.sha256(payload).digest() if self._short else payload
        self._came.clear()
        self._length = len(expected)
        start = time.perf_counter()
        self.link.send(payload)
        if not self._came.wait(TIMEOUT):
            raise TimeoutError(f"{self.stack}: {len(payload)} bytes did not come back")
        took = time.perf_counter() - start
        if self._got != expected:
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
            told = json.dumps(report["counters"].get("topics", {}).get(f"{alias(self.stack)}-there", {}))
            raise ValueError(f"{self.stack}: {sent} sent, {report['count']} came, {report['wrong']} of them wrong; {told}")
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
def pairs(stacks: Sequence[str], setup: dict[str, Any] | None = None) -> Iterator[dict[str, Pair]]:
    """All stacks, with the routers that they need; setup: of routers that run already."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        setup = setup or stack.enter_context(prepare(Path(folder)))
        made: dict[str, Pair] = {}
        for name in stacks:
            made[name] = Pair(name, setup)
            stack.callback(made[name].close)
        yield made
