"""A program of the network tests: `publish` counts on a topic, `listen` prints what it hears, `route` is a router.

python beacon.py publish HOME ALIAS PERIOD      a number every PERIOD seconds, on reliable delivery
python beacon.py listen HOME ALIAS              "NUMBER SECONDS LOST" a message, by the monotonic clock of the machine
python beacon.py route HOME LISTEN... [-- MESH...]
"""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path


def publish(home: str, alias: str, period: str) -> None:
    """Count."""
    from tutelage.sgc.node import Node

    with Node.open(Path(home)) as node:
        publisher = node.publisher(alias)
        print("up", flush=True)
        start = time.monotonic()
        for number in range(1 << 40):
            publisher.send(b"%d" % number, wait=5.0)
            time.sleep(max(0.0, start + (number + 1) * float(period) - time.monotonic()))


def listen(home: str, alias: str) -> None:
    """Print what comes."""
    from tutelage.sgc.node import Node

    with Node.open(Path(home)) as node:
        subscription = node.subscribe(alias)
        print("up", flush=True)
        for message in subscription:
            print(int(message.payload), f"{time.monotonic():.4f}", subscription.lost, flush=True)


def route(home: str, *addresses: str) -> None:
    """Run a router."""
    from tutelage.sgc.home import Home
    from tutelage.sgc.router import Router, RouterConfig

    cut = addresses.index("--") if "--" in addresses else len(addresses)
    with Router(Home.open(Path(home)), RouterConfig.of(addresses[:cut], addresses[cut + 1 :])):
        print("up", flush=True)
        signal.pause()


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    {"publish": publish, "listen": listen, "route": route}[sys.argv[1]](*sys.argv[2:])
