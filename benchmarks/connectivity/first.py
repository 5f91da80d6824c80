"""`python first.py HOME ALIAS`: prints when this program had started, was connected, and had its first message.

Seconds of the machine's monotonic clock, as JSON. It imports what a user's program would, and nothing else.
"""

import time

STARTED = time.monotonic()

import json  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402

from tutelage.sgc.node import Node  # noqa: E402


def main() -> None:
    """Entry point."""
    imported = time.monotonic()
    with Node.open(Path(sys.argv[1])) as node:
        opened = time.monotonic()
        subscription = node.subscribe(sys.argv[2])
        message = subscription.receive(20.0)
        heard = time.monotonic()
    times = {"started": STARTED, "imported": imported, "opened": opened, "heard": heard if message else float("inf")}
    print(json.dumps(times))


if __name__ == "__main__":
    main()
