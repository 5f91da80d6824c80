"""From starting a program to its first message, while a publisher sends every 2 ms; also with keys from an earlier start."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from tutelage.sgc.local import LocalFleet

PERIOD = 0.002
POLICY = """
version = 1
[topics.state]
node = "robot"
interface = "/state"
type = "std_msgs/msg/String"
owner = "robot"
publish = ["robot"]
subscribe = ["operator-*"]
"""


def measure(programs: int = 15) -> list[dict[str, Any]]:
    """Milliseconds, medians over programs: until Python runs, has imported, is connected, has its first message."""
    names = [f"operator-{k}" for k in range(programs + 1)]
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalFleet(Path(folder), POLICY, ("robot", *names)) as fleet,
        fleet.open("robot") as robot,
    ):
        stop = threading.Event()
        publisher = robot.publisher("state")

        def talk() -> None:
            while not stop.wait(PERIOD):
                publisher.send(b"state")

        talking = threading.Thread(target=talk)
        talking.start()
        try:
            homes = [fleet.homes[name].path for name in names]
            _start(homes.pop())  # compiles
            return [_row(which, [_start(home) for home in homes]) for which in ("first start", "later start")]
        finally:
            stop.set()
            talking.join()


def _start(home: Path) -> dict[str, float]:
    """Seconds since the program was started."""
    command = [sys.executable, str(Path(__file__).with_name("first.py")), str(home), "state"]
    # An installed package is compiled; where that was switched off, each start would measure the compiler.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    start = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60, env=environment)
    return {name: at - start for name, at in json.loads(done.stdout).items()}


def _row(which: str, times: list[dict[str, float]]) -> dict[str, Any]:
    middle = {f"{name} ms": 1e3 * statistics.median(each[name] for each in times) for name in times[0]}
    return {"program": which, **middle}
