"""All gates by name with a fleet: 100 robots, 10 humans, one table. What chapters 2 and 3 ask of one robot, asked of many.

A robot that falls waits for a hard reset, behind those that ask ("LazyDAgger" is "LazyDAgger.C."). ThriftyDAgger does
without its risk where a task has no goal.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tutelage.envs.tasks import TASKS
from tutelage.errors import ConfigError
from tutelage.experiments.config import RunConfig
from tutelage.experiments.jobs import Job, run_jobs, slug
from tutelage.experiments.plots import interval
from tutelage.experiments.study import one
from tutelage.fleet.gates import GATES, GateConfig
from tutelage.learning.imitation import LearnerConfig

THRIFTY_ALONE = "ThriftyDAgger (-Risk)"


@dataclass(frozen=True)
class GatesConfig:
    """The comparison of the gates.

    Attributes:
        task: name of a task without a goal.
        seeds: root seeds.
        steps: T.
        robots: N.
        humans: M.
        workers: runs side by side, one core each.
        out: folder of the run folders.
        results: folder of the small result files.
    """

    task: str = "Walker2d"
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    steps: int = 2000
    robots: int = 100
    humans: int = 10
    workers: int = 4
    out: Path = Path("runs/gates")
    results: Path = Path("results/single/gates")

    def __post_init__(self) -> None:
        if self.task not in TASKS or self.workers < 1 or not self.seeds:
            raise ConfigError(f"a comparison of gates needs a task of {', '.join(TASKS)}, seeds and workers")


def configurations(config: GatesConfig) -> dict[str, RunConfig]:
    """The first seed's configuration of each gate, and of the two ends: nobody teleoperates, and C.U.R."""
    base = RunConfig(
        config.task, "C.", robots=config.robots, humans=config.humans, steps=config.steps, threads=1, torch_threads=1,
        record="none", label="Behaviour cloning (C.)",
    )  # fmt: skip
    runs = {base.algorithm: dataclasses.replace(base, learner=LearnerConfig(schedule="never"))}
    for name in GATES:
        label = THRIFTY_ALONE if name == "ThriftyDAgger" else name
        gate = GateConfig(without="risk") if name == "ThriftyDAgger" else GateConfig()
        runs[label] = dataclasses.replace(base, priority=name, gate=gate, label=label)
    runs["C.U.R."] = dataclasses.replace(base, priority="C.U.R.", label="C.U.R.")
    return runs


def reproduce(config: GatesConfig) -> str:
    """Run what is missing; returns the table as Markdown.

    Raises:
        TutelageError: a run failed.
    """
    jobs = []
    for name, run in configurations(config).items():
        for seed in config.seeds:
            file = f"{slug(name)}-s{seed}"
            folder = config.out / f"{config.task}-{config.robots}x{config.humans}-{config.steps}" / file
            arguments = dataclasses.replace(run, seed=seed, out=folder), 0, False
            jobs.append(Job(f"{name} seed {seed}", one, arguments, config.results / config.task / f"{file}.json", _summary))
    return table(run_jobs(jobs, config.workers))


def table(results: list[dict[str, Any]]) -> str:
    """A row for each gate, mean and 95 % interval over seeds, as Markdown."""
    c = results[0]["config"]
    lines = [
        f"All gates with {c['robots']} robots and {c['humans']} humans on {c['task']}, {c['steps']:,} timesteps, "
        f"{len({r['seed'] for r in results})} seeds, mean ± 95 % interval over seeds. Switches: both ways, of all robots.",
        "",
        "| Gate | Successes ↑ | Hard resets ↓ | Human time ↓ | ROHE ↑ | Context switches ↓ |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name in configurations(GatesConfig(c["task"])):
        metrics = [r["metrics"] for r in results if r["algorithm"] == name]
        if not metrics:
            continue
        columns = {key: np.array([m[key] for m in metrics]) for key in ("successes", "hard_resets", "human_time", "rohe")}
        columns["switches"] = np.array([m["switches_to_human"] + m["switches_to_robot"] for m in metrics])
        cells = [interval(values, 3 if key == "rohe" else 0) for key, values in columns.items()]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _summary(result: dict[str, Any]) -> str:
    m = result["metrics"]
    switches = m["switches_to_human"] + m["switches_to_robot"]
    return f"{m['successes']:,.0f} successes, ROHE {m['rohe']:.3f}, {switches:,.0f} context switches"
