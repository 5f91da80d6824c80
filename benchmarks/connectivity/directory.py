"""A directory of 10,000 names: how soon a published name is known elsewhere, and a subscriber knows who is there."""

from __future__ import annotations

import statistics
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from tutelage.sgc.directory import Directory
from tutelage.sgc.local import LocalFleet
from tutelage.sgc.names import Name
from tutelage.sgc.transport.config import Identity, NetworkConfig
from tutelage.sgc.transport.zenoh import ZenohTransport

NEAR, FAR = "near", "far"


def policy(names: int) -> str:
    """So many topics of two nodes."""
    tables = (
        f'[topics.t{k}]\nnode = "{NEAR}"\ninterface = "/t{k}"\ntype = "std_msgs/msg/String"\nowner = "{NEAR}"\n'
        f'publish = ["{NEAR}"]\nsubscribe = ["{FAR}"]\n'
        for k in range(names)
    )
    return "version = 1\n" + "\n".join(tables)


def measure(names: int = 10_000, fresh: int = 200) -> dict[str, Any]:
    """Milliseconds, with `names` names in the directory and access control for all of them; medians over `fresh` more."""
    with tempfile.TemporaryDirectory() as folder, LocalFleet(Path(folder), policy(names + fresh), (NEAR, FAR)) as fleet:
        known = [entry.name for entry in fleet.homes[NEAR].access.topics.values()]
        settled, late = known[:names], known[names:]
        with _transport(fleet, NEAR) as near, _transport(fleet, FAR) as far:
            one, other = Directory(near), Directory(far)
            start = time.perf_counter()
            for name in settled:
                one.publish(name, fleet.homes[NEAR].pseudonym)
            other.subscribe(settled[-1])
            until = time.monotonic() + 120
            while not other.present(settled[-1]):
                if time.monotonic() > until:
                    raise TimeoutError("the directory was not filled in two minutes")
                time.sleep(0.05)
            filled = time.perf_counter() - start
            published = [_publish(one, other, name, fleet.homes[NEAR].pseudonym) for name in late]
            with _transport(fleet, FAR) as again:
                newcomer = Directory(again)
                subscribed = [_subscribe(newcomer, name) for name in settled[:: names // fresh]]
    return {
        "names": names,
        "filled in s": filled,
        "publish ms": 1e3 * statistics.median(published),
        "subscribe ms": 1e3 * statistics.median(subscribed),
    }


def _transport(fleet: LocalFleet, name: str) -> ZenohTransport:
    home = fleet.homes[name]
    return ZenohTransport(NetworkConfig.load(home.path), Identity(home.root_file, home.leaf_file, home.key_file))


def _publish(one: Directory, other: Directory, name: Name, who: str) -> float:
    seen = threading.Event()
    other.subscribe(name, lambda arrived: seen.set())
    time.sleep(0.002)
    start = time.perf_counter()
    one.publish(name, who)
    if not seen.wait(10):
        raise TimeoutError("a published name was not seen")
    return time.perf_counter() - start


def _subscribe(directory: Directory, name: Name) -> float:
    seen = threading.Event()
    start = time.perf_counter()
    directory.subscribe(name, lambda arrived: seen.set())
    if not seen.wait(10):
        raise TimeoutError("nobody was found under a name")
    return time.perf_counter() - start
