"""What a gate costs next to the rest of a timestep, for one robot and for a fleet."""

from __future__ import annotations

from typing import Any

from benchmarks.timing import Phases, table
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import RunConfig
from tutelage.experiments.prepare import prepare
from tutelage.fleet.gates import GATES, GateConfig
from tutelage.learning.critic import CriticConfig
from tutelage.learning.imitation import LearnerConfig

SIZES = ((1, 1), (100, 10))


def run(quick: bool = False) -> dict[str, Any]:
    """Each gate on Walker2d: milliseconds of a timestep, of its rules, and of the signals that it looks at."""
    rows = [measure(name, robots, humans, 50 if quick else 300) for robots, humans in SIZES for name in GATES]
    head = ["gate", "robots", "ms a timestep", "rules", "signals", "rules / timestep"]
    print(table(head, [[r[name] for name in head] for r in rows]))
    return {"gates": rows}


def measure(name: str, robots: int, humans: int, steps: int) -> dict[str, Any]:
    """One gate: the mean over some timesteps of a run, after a warm-up."""
    config = RunConfig(
        "Walker2d", name, robots=robots, humans=humans, t_teleop=1, offline_pairs=1000, calibration_steps=30,
        gate=GateConfig(without="risk"), learner=LearnerConfig(pretrain=100), critic=CriticConfig(pretrain=100),
    )  # fmt: skip
    loop = prepare(assemble(config)).loop()
    loop.run(50)
    phases = Phases()
    loop.signals = {key: phases.timed(signal, "signals") for key, signal in loop.signals.items()}
    loop.priority = phases.timed(loop.priority, "rules")  # type: ignore[assignment]
    phases.watch(loop, "step", "rest")
    loop.run(50 + steps)
    loop.fleet.close()
    ms = {phase: 1e3 * seconds / steps for phase, seconds in phases.seconds.items()}
    total = sum(ms.values())
    return {
        "gate": name, "robots": robots, "ms a timestep": total, "rules": ms["rules"], "signals": ms.get("signals", 0.0),
        "rules / timestep": ms["rules"] / total,
    }  # fmt: skip
