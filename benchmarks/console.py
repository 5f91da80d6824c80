"""The supervision server under load: 100 robots at 10 Hz, 10 operators, 20 streams of 640 x 360 at 20 pictures a second.

Server (loop, web, video) and learner run in processes of their own, and so do the operators, who work through the same
sockets as the page. The robots are simulated; their cameras are drawn and encoded by the server itself, 20 times a second
each, which is more work than passing on the JPEG pictures of robots that have cameras.

The latency of a command is what handling takes, from its arrival at the socket to where the loop reads it, and a timestep,
which ends with the robots' step; the wait for the next timestep (0 to 100 ms) is not part of it.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

ROBOTS, OPERATORS, STREAMS, HZ, FPS = 100, 10, 20, 10.0, 20.0
WIDTH, HEIGHT = 640, 360
PASSWORD = "correct horse battery"


def filmed(num_envs: int, disturbance: str | None = None) -> Any:
    """Blocks that are pushed around an obstacle, each under a camera that takes 20 pictures a second."""
    from tutelage.envs.registry import make_fleet

    fleet: Any = make_fleet("ObstaclePushing", num_envs, disturbance=disturbance)

    def picture(robot: int, camera: int) -> tuple[float, Any]:
        return int(time.time() * FPS) / FPS, fleet.render_robot(robot, WIDTH, HEIGHT)

    fleet.picture = picture
    return fleet


def serve(folder: Path) -> None:
    """The server's process. Prints its port, and at the end its numbers."""
    from tutelage.console.accounts import Accounts, Role
    from tutelage.console.parts import EngineConfig
    from tutelage.console.passwords import Passwords
    from tutelage.console.serve import WebConfig
    from tutelage.console.serve import serve as run
    from tutelage.console.states import Metrics
    from tutelage.console.supervision import Supervision
    from tutelage.fleet.priority import PriorityConfig
    from tutelage.learning.critic import CriticConfig
    from tutelage.learning.imitation import LearnerConfig

    with_accounts = Accounts(folder, Passwords(time_cost=1, memory_cost=1024))
    for k in range(OPERATORS):
        with_accounts.add(f"operator{k}", Role.OPERATOR, PASSWORD)
    with_accounts.close()
    settings = {
        "expert": "tutelage.envs.experts.block_pushing:team", "offline_pairs": 336, "learner": LearnerConfig(pretrain=200),
        "calibration_steps": 50, "disturbance": "none",
        "thresholds": PriorityConfig(uncertainty=0.0), "critic": CriticConfig(pretrain=50),
    }  # fmt: skip
    config = EngineConfig(
        fleet="sim:benchmarks.console:filmed", robots=ROBOTS, humans=OPERATORS, priority="U.C.R.", hz=HZ, out=folder,
        run=settings,
    )  # fmt: skip
    rows: list[dict[str, Any]] = []
    kept: list[Supervision] = []

    def opened(audit: Any) -> Supervision:
        supervision = Supervision.open(config, audit)
        supervision.subscribe(lambda event: rows.append(event.row) if isinstance(event, Metrics) else None)
        kept.append(supervision)
        return supervision

    run(opened, folder, WebConfig(port=0), lambda line: print(line, flush=True))
    people = kept[0].operators()
    learner: Any = kept[0].engine.learner
    print(json.dumps({"rows": rows, "people": people, "swap_ms": 1000 * learner.swap_seconds, "version": learner.version}))


def operate(address: str, seconds: float, first: int, last: int) -> None:
    """A process of some operators. Prints what they saw."""
    from tutelage.console.scripted import ScriptedOperator, after

    each = STREAMS // OPERATORS
    people = [
        ScriptedOperator(
            address, f"operator{k}", PASSWORD, react=0.5, rule=after(30),
            streams=[{"robot": each * k + i, "width": WIDTH, "height": HEIGHT, "fps": FPS} for i in range(each)],
        )
        for k in range(first, last)
    ]  # fmt: skip

    async def work() -> list[Any]:
        return await asyncio.gather(*(person.run(seconds) for person in people))

    print(json.dumps([vars(tally) for tally in asyncio.run(work())]))


def cpu_seconds(pids: list[int]) -> float:
    """CPU time of processes so far."""
    total = 0.0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


def children(pid: int) -> list[int]:
    """The processes that a process started."""
    return [int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()]


def run(quick: bool = False) -> dict[str, Any]:
    """Measure, print, return."""
    seconds = 15.0 if quick else 60.0
    here = [sys.executable, "-m", "benchmarks.console"]
    with tempfile.TemporaryDirectory() as folder:
        server = subprocess.Popen([*here, "serve", folder], stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            address = next(line.split()[1] for line in server.stdout if line.startswith("console:"))
            time.sleep(8.0)  # until the learner's process has started
            half = OPERATORS // 2
            spans = [(0, half), (half, OPERATORS)]
            workers = [
                subprocess.Popen(
                    [*here, "operate", address, str(seconds + 4), str(a), str(b)], stdout=subprocess.PIPE, text=True
                )
                for a, b in spans
            ]
            time.sleep(3.0)
            family = _descendants(server.pid)
            began, used, learned = time.monotonic(), cpu_seconds([server.pid]), cpu_seconds(family)
            stalls = 1000 * stalled(seconds)
            wall = time.monotonic() - began
            used, learned = cpu_seconds([server.pid]) - used, cpu_seconds(family) - learned
            people = [tally for worker in workers for tally in json.loads(worker.communicate(timeout=120)[0])]
            server.send_signal(signal.SIGINT)
            told = json.loads(server.communicate(timeout=120)[0].splitlines()[-1])
        finally:
            server.kill()
    rows = told["rows"][8:]
    cores = len(os.sched_getaffinity(0))
    trips = 1000 * np.array([trip for tally in people for trip in tally["round_trips"]])
    delays = 1000 * np.array([delay for tally in people for delay in tally["delays"]])
    handled = [p99 for tally in people for p99 in tally["latency"]]
    cpu = np.array([row["tick_cpu_ms"] for row in rows])
    ticks, late = np.array([row["tick_ms"] for row in rows]), np.array([row["late_ms"] for row in rows])
    result = {
        "server_cpu_cores": used / wall,
        "server_cpu_percent_of_machine": 100 * used / wall / cores,
        "learner_cpu_cores": learned / wall,
        "idle_process_away_p99_ms": float(np.percentile(stalls, 99)),
        "idle_process_away_longest_ms": float(stalls.max()),
        "command_handling_p99_of_a_second_p50_ms": float(np.percentile(handled, 50)),
        "command_handling_p99_of_a_second_p90_ms": float(np.percentile(handled, 90)),
        "round_trip_p50_ms": float(np.percentile(trips, 50)),
        "round_trip_p99_ms": float(np.percentile(trips, 99)),
        "slowest_tick_of_a_second_p50_ms": float(np.percentile(ticks, 50)),
        "slowest_tick_of_a_second_p99_ms": float(np.percentile(ticks, 99)),
        "cpu_of_the_dearest_tick_of_a_second_p50_ms": float(np.percentile(cpu, 50)),
        "cpu_of_the_dearest_tick_of_a_second_p99_ms": float(np.percentile(cpu, 99)),
        "latest_tick_of_a_second_p50_ms": float(np.percentile(late, 50)),
        "latest_tick_of_a_second_p99_ms": float(np.percentile(late, 99)),
        "timesteps_per_second": (rows[-1]["t"] - rows[0]["t"]) / (rows[-1]["time"] - rows[0]["time"]),
        "pictures_per_second": sum(tally["pictures"] for tally in people) / (seconds + 4),
        "picture_delay_p50_ms": float(np.percentile(delays, 50)),
        "picture_delay_p99_ms": float(np.percentile(delays, 99)),
        "commands_per_second": sum(tally["commands"] for tally in people) / (seconds + 4),
        "interventions": sum(tally["interventions"] for tally in people),
        "refusals": sum(sum(tally["errors"].values()) for tally in people),
        "policy_version": told["version"],
        "weights_swap_ms": told["swap_ms"],
    }
    print("refusals", Counter(code for tally in people for code in tally["errors"]))
    for name, value in result.items():
        print(f"{name:<44} {value:10.2f}")
    return {"robots": ROBOTS, "operators": OPERATORS, "streams": STREAMS, "seconds": seconds, "measured": result}


def stalled(seconds: float) -> Any:
    """How much longer than a millisecond a process that only sleeps for one is away, each time, s: what the machine does to
    everybody, whatever they do."""
    found, end = [], time.monotonic() + seconds
    while (now := time.monotonic()) < end:
        time.sleep(0.001)
        found.append(time.monotonic() - now - 0.001)
    return np.array(found)


def _descendants(pid: int) -> list[int]:
    found = children(pid)
    return found + [later for child in found for later in _descendants(child)]


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(Path(sys.argv[2]))
    else:
        operate(sys.argv[2], float(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5]))
