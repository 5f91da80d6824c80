"""C.U.R. with more and fewer humans, longer and shorter interventions and resets: figures C.2, C.3 and C.4.

The dissertation printed curves and described them in words; the words stand
beside our numbers, each with what our numbers say about it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tutelage.envs.tasks import TASKS
from tutelage.errors import ConfigError
from tutelage.experiments.config import RunConfig
from tutelage.experiments.jobs import Job, run_jobs
from tutelage.experiments.relations import Relation
from tutelage.experiments.results import ONLINE, Column
from tutelage.experiments.study import one

Means = dict[int, float]
"""The mean of a metric over seeds, by value of the parameter."""


@dataclass(frozen=True)
class Sweep:
    """A figure: C.U.R. with default parameters but one.

    Attributes:
        parameter: attribute of `RunConfig`.
        symbol: the dissertation's.
        values: what it is, in the order of the rows.
        default: what it is elsewhere.
    """

    parameter: str
    symbol: str
    values: tuple[int, ...]
    default: int


TIMES = (1, 5, 20, 50, 100, 500)
SWEEPS = {
    "figure-C.2": Sweep("humans", "M", (1, 5, 10, 25, 50), 10),
    "figure-C.3": Sweep("t_teleop", "t_T", TIMES, 5),
    "figure-C.4": Sweep("t_reset", "t_R", TIMES, 5),
}


@dataclass(frozen=True)
class SweepConfig:
    """What to run of a figure.

    Attributes:
        what: which figure.
        tasks: names of tasks.
        seeds: root seeds.
        steps: T.
        robots: N.
        workers: runs side by side, one core each.
        out: folder of the run folders.
        results: folder of the small result files.
    """

    what: str = "figure-C.2"
    tasks: tuple[str, ...] = ("Walker2d",)
    seeds: tuple[int, ...] = (0,)
    steps: int = 2000
    robots: int = 100
    workers: int = 4
    out: Path = Path("runs/sweeps")
    results: Path = Path("results/single/figure-C.2")

    def __post_init__(self) -> None:
        if self.what not in SWEEPS or not self.seeds or self.workers < 1:
            raise ConfigError(f"a sweep is one of {', '.join(SWEEPS)}, with at least one seed and one worker")
        unknown = set(self.tasks) - set(TASKS)
        if unknown:
            raise ConfigError(f"unknown task {', '.join(sorted(unknown))}; known tasks: {', '.join(TASKS)}")


def reproduce(config: SweepConfig) -> str:
    """Run what is missing; returns the tables as Markdown.

    Raises:
        TutelageError: a run failed.
    """
    sweep, jobs = SWEEPS[config.what], []
    for task in config.tasks:
        base = RunConfig(
            task, robots=config.robots, steps=config.steps, threads=1, torch_threads=1, record="none", label="C.U.R."
        )  # fmt: skip
        for seed in config.seeds:
            for value in sweep.values:
                # The run with the default is the same in all three figures.
                name = "default" if value == sweep.default else f"{sweep.parameter}{value}"
                folder = config.out / f"{task}-{config.robots}-{config.steps}" / f"{name}-s{seed}"
                changes: dict[str, Any] = {sweep.parameter: value, "seed": seed, "out": folder}
                file = config.results / task / f"{sweep.parameter.replace('_', '-')}{value}-s{seed}.json"
                title = f"{task} {sweep.symbol} = {value} seed {seed}"
                jobs.append(Job(title, one, (dataclasses.replace(base, **changes), 0, False), file, _summary))
    return table(config.what, run_jobs(jobs, config.workers))


def table(what: str, results: list[dict[str, Any]]) -> str:
    """For each task a row for each value, and what the dissertation says about the figure, as Markdown."""
    return "\n".join(_of_task(SWEEPS[what], what, group) for group in _by_task(results))


def _by_task(results: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    names = dict.fromkeys(r["config"]["task"] for r in results)
    return [[r for r in results if r["config"]["task"] == name] for name in names]


def _of_task(sweep: Sweep, what: str, results: list[dict[str, Any]]) -> str:
    c = results[0]["config"]
    found = {
        column.metric: {
            value: np.array([r["metrics"][column.metric] for r in results if r["config"][sweep.parameter] == value])
            for value in sweep.values
        }
        for column in ONLINE
    }
    values = [value for value in sweep.values if len(found["successes"][value])]
    others = [f"{s.symbol} = {s.default}" for s in SWEEPS.values() if s is not sweep]
    seeds = len({r["seed"] for r in results})
    lines = [
        f"{c['task']}: C.U.R. with {c['robots']} robots, {c['steps']:,} timesteps, {', '.join(others)}, "
        f"{seeds} seed{'s' if seeds > 1 else ''}.",
        "",
        f"| {sweep.symbol} | " + " | ".join(column.title for column in ONLINE) + " |",
        "| ---: |" + " ---: |" * len(ONLINE),
    ]
    for value in values:
        cells = [_text(found[column.metric][value], column) for column in ONLINE]
        lines.append(f"| {value} | {' | '.join(cells)} |")
    lines.append("")
    if values == list(sweep.values):
        means = {metric: {value: float(x.mean()) for value, x in of.items()} for metric, of in found.items()}
        lines += [f"- {r.statement}: **{r.verdict}** ({r.numbers})" for r in RELATIONS[what](means)]
    return "\n".join(lines) + "\n"


def _text(values: np.ndarray[Any, Any], column: Column) -> str:
    mean = f"{values.mean():,.{column.digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {values.std():,.{column.digits}f}"


def _summary(result: dict[str, Any]) -> str:
    m = result["metrics"]
    return f"{m['successes']:,.0f} successes, {m['hard_resets']:,.0f} hard resets, ROHE {m['rohe']:.3f}"


# -- what the dissertation says (appendix C.4) ------------------------------------------------------------------------------


def humans(means: Mapping[str, Means]) -> list[Relation]:
    """Figure C.2."""
    done, idle, fell = means["successes"], means["idle_time"], means["hard_resets"]
    return [
        _monotonic("cumulative successes increase with the number of humans", done, +1),
        Relation(
            "25 and 50 humans have very similar successes (within 10%)", _near(done[25], done[50]), _said(done, 25, 50)
        ),
        _greatest("10 humans achieve the highest ROHE", means["rohe"], 10, 3),
        _greatest("with 1 human idle time is the largest", idle, 1),
        _greatest("with 1 human hard resets are the most", fell, 1),
    ]


def teleoperation(means: Mapping[str, Means]) -> list[Relation]:
    """Figure C.3."""
    rohe, done, idle, fell = means["rohe"], means["successes"], means["idle_time"], means["hard_resets"]
    return [
        Relation("a shorter t_T than 5 has a lower ROHE", rohe[1] < rohe[5], _said(rohe, 1, 5, digits=3)),
        Relation(
            "a longer t_T than 5 has a lower ROHE",
            all(rohe[k] < rohe[5] for k in TIMES[2:]),
            _said(rohe, *TIMES[1:], digits=3),
        ),
        Relation("idle time is high for t_T = 500", idle[500] > idle[5], _said(idle, 5, 500)),
        Relation("hard resets are few for t_T = 500", fell[500] < fell[5], _said(fell, 5, 500)),
        Relation("cumulative successes fall for t_T = 500", done[500] < done[5], _said(done, 5, 500)),
    ]


def resets(means: Mapping[str, Means]) -> list[Relation]:
    """Figure C.4."""
    return [
        _monotonic("ROHE decreases as t_R increases", means["rohe"], -1, 3),
        _monotonic("cumulative successes decrease", means["successes"], -1),
        _monotonic("hard resets decrease", means["hard_resets"], -1),
        _monotonic("idle time increases", means["idle_time"], +1),
    ]


RELATIONS: dict[str, Callable[[Mapping[str, Means]], list[Relation]]] = {
    "figure-C.2": humans,
    "figure-C.3": teleoperation,
    "figure-C.4": resets,
}


def _monotonic(statement: str, means: Means, direction: int, digits: int = 0) -> Relation:
    """Does the metric go one way from each value to the next, or at least stay?"""
    change = direction * np.diff(list(means.values()))
    return Relation(statement, bool((change >= 0).all() and change.any()), _said(means, *means, digits=digits))


def _greatest(statement: str, means: Means, value: int, digits: int = 0) -> Relation:
    return Relation(statement, max(means, key=lambda v: means[v]) == value, _said(means, *means, digits=digits))


def _near(one: float, other: float) -> bool:
    return abs(one - other) <= 0.1 * max(one, other)


def _said(means: Means, *values: int, digits: int = 0) -> str:
    return ", ".join(f"{value}: {means[value]:,.{digits}f}" for value in values)
