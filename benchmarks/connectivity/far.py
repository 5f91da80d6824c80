"""`python -m benchmarks.connectivity.far STACK SETUP`: the other process. Answers commands on standard input, a line each.

echo            from now on, send back what comes
digest          from now on, send back the SHA-256 of what comes
sink            from now on, count what comes and check it
report          print what was counted, as JSON
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from typing import Any

from benchmarks.connectivity.stacks import FAR, Link, open_link


class Sink:
    """Counts messages of a flood: 8 bytes of number, then the same filling in all."""

    def __init__(self, filling: bytes) -> None:
        self.filling = filling
        self.count = self.wrong = 0
        self.first = self.last = 0.0

    def take(self, payload: bytes) -> None:
        """One message."""
        self.last = time.perf_counter()
        self.first = self.first or self.last
        if int.from_bytes(payload[:8], "big") != self.count or payload[8:] != self.filling:
            self.wrong += 1
        self.count += 1


def main() -> None:
    """Entry point."""
    stack, setup = sys.argv[1], json.loads(sys.argv[2])
    sink = Sink(b"")
    mode = "echo"
    link: Link

    def on_bytes(payload: bytes) -> None:
        if mode == "sink":
            sink.take(payload)
        else:
            link.send(payload if mode == "echo" else hashlib.sha256(payload).digest())

    link = open_link(stack, FAR, setup, on_bytes)
    print(json.dumps({"up": True}), flush=True)
    for line in sys.stdin:
        command = line.strip()
        answer: dict[str, Any] = {}
        if command == "sink":
            sink = Sink(bytes(range(256)) * 3 + bytes(224))
        if command in ("sink", "echo", "digest"):
            mode = command
        else:
            answer = {
                "count": sink.count,
                "wrong": sink.wrong,
                "seconds": sink.last - sink.first,
                "counters": link.counters(),
            }
        print(json.dumps(answer), flush=True)
    link.close()


if __name__ == "__main__":
    main()
