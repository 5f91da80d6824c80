"""Peak memory of a run of 100 robots, at its largest: replay at capacity, all human data it can gather, a checkpoint."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.timing import table

STEPS = 10_000
"""Timesteps of the run that is imitated: 10 humans give at most 100,000 pairs in it."""


def run(quick: bool = False) -> dict[str, Any]:
    """Both tasks, each in a process of its own."""
    results = []
    for task in ("Walker2d", "Humanoid"):
        command = [sys.executable, "-W", "ignore", "-m", "benchmarks.memory", task]
        results.append(
            json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
        )
    columns = [name for name in results[0] if name != "task"]
    print(table(["peak resident memory, MiB", *columns], [[r["task"], *(r[c] for c in columns)] for r in results]))
    return {"memory": results}


def _peak() -> float:
    """The largest resident memory of this process so far, MiB."""
    import resource

    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss begins with what the process had that started this one
        return int(re.search(r"VmHWM:\s+(\d+) kB", status.read_text())[1]) / 2**10  # type: ignore[index]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def measure(task: str) -> dict[str, Any]:
    """Run a while, fill everything as a whole run would, run on, and save a checkpoint."""
    import numpy as np

    from benchmarks.fleets import HUMANS, ROBOTS, ready
    from tutelage.store import save_tree

    imported = _peak()
    assembly = ready(task)
    loop, learner, c = assembly.loop(), assembly.learner, assembly.config
    loop.run(50)
    running = _peak()
    rng = np.random.Generator(np.random.PCG64(0))
    width, actions = loop.obs.shape[1], len(loop.fleet.action_low)
    for critic in learner.critics.values():
        for _ in range(c.critic.capacity // (9 * ROBOTS // 10) + 1):  # a tenth of them are events
            obs, after = rng.standard_normal((2, ROBOTS, width))
            event = np.arange(ROBOTS) % 10 == 0
            critic.add(obs, np.zeros((ROBOTS, actions)), after, event, event)
    while len(learner.dataset) < STEPS * HUMANS:
        learner.dataset.add(rng.standard_normal((HUMANS, width)), np.zeros((HUMANS, actions)))
    loop.run(loop.t + 50)
    full = _peak()
    with tempfile.TemporaryDirectory() as folder:
        save_tree(Path(folder) / "state.safetensors", {"loop": loop.state_dict()})
    return {"task": task, "imports": imported, "running": running, "full": full, "with a checkpoint": _peak()}


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1])))
