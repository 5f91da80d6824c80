"""Table 3.2: one person, three robots, four ways to ask for help, and a game between requests (section 3.5, appendix B.4).

Here the people are simulated: they teleoperate as the algorithmic human does, take a moment to come, and play Concentration
with the memory and the pace of `PlayerConfig`. What a person finds hard cannot be simulated: the NASA-TLX is for real ones.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import RunConfig, to_json
from tutelage.experiments.jobs import Job, run_jobs, slug
from tutelage.experiments.prepare import prepare
from tutelage.experiments.table_3 import HG, LAZY, SAFE, SETTINGS, THRIFTY, configuration
from tutelage.experiments.user_study.concentration import CARDS, Table
from tutelage.experiments.user_study.player import Player, PlayerConfig
from tutelage.experiments.user_study.protocol import HUMAN_GATED, ROBOTS, STEPS, Counting, order
from tutelage.experiments.user_study.robots import QuickPegInsertion
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step
from tutelage.seeding import stream

TASK = f"{QuickPegInsertion.__module__}:{QuickPegInsertion.__name__}"
COLUMNS = {
    "interventions": "Interventions ↓", "human_actions": "Human actions ↓", "robot_actions": "Robot actions",
    "pairs": "Concentration pairs ↑", "throughput": "Throughput ↑", "idle_time": "Mean idle time ↓",
}  # fmt: skip
PUBLISHED = {
    HG: "10.6 ± 2.5 | 198.0 ± 32.1 | 834.4 ± 38.1 | – | 5.1 ± 1.9 | –",  # noqa: RUF001 - en dashes
    SAFE: "22.1 ± 4.8 | 234.1 ± 31.8 | 700.7 ± 70.4 | 17.7 ± 8.2 | 3.0 ± 2.4 | 38.4 ± 14.1",
    LAZY: "10.0 ± 2.1 | 219.5 ± 43.3 | 719.2 ± 89.7 | 20.9 ± 7.9 | 5.1 ± 1.7 | 37.1 ± 20.5",
    THRIFTY: "7.9 ± 2.1 | 179.4 ± 34.9 | 793.2 ± 86.6 | 33.0 ± 8.5 | 9.2 ± 2.0 | 25.8 ± 19.3",
}


@dataclass(frozen=True)
class Table32Config:
    """What of the study to reproduce.

    Attributes:
        seeds: participants; each has base policies, robots and a game of their own.
        workers: conditions side by side, one core each.
        latency: timesteps that a person takes to come when called.
        player: how they play.
        results: folder of the small result files.
    """

    seeds: tuple[int, ...] = tuple(range(10))
    workers: int = 4
    latency: int = 2
    player: PlayerConfig = dataclasses.field(default_factory=PlayerConfig)
    results: Path = Path("results/single/table-3.2")

    def __post_init__(self) -> None:
        if self.workers < 1 or not self.seeds or self.latency < 0:
            raise ConfigError("table-3.2 needs participants, workers >= 1 and latency >= 0")


def condition(algorithm: str, seed: int, latency: int) -> RunConfig:
    """The run of a participant's condition: initialised as for table 3.1, three robots, a queue, 350 timesteps.

    No update of the policy falls into so few timesteps, as policies are trained anew every 2,000.
    """
    alone = configuration(SETTINGS["table-3.1"], algorithm)
    gated = algorithm != HUMAN_GATED
    # Nobody keeps three robots in view at once.
    gate = alone.gate if gated else dataclasses.replace(alone.gate, span=1)
    return dataclasses.replace(
        alone, task=TASK, robots=ROBOTS, steps=STEPS, seed=seed, latency=latency,
        offline_pairs=QuickPegInsertion.offline_pairs,
        gate=gate, learner=dataclasses.replace(alone.learner, schedule="never"),
        queue="fifo" if gated else "priority", wait=gated, expert=QuickPegInsertion.expert,
    )  # fmt: skip


class Participant:
    """A subscriber: the simulated person, who plays while nobody calls."""

    def __init__(self, counting: Counting, config: PlayerConfig, seed: int) -> None:
        self.counting = counting
        self.table = Table(CARDS, stream(seed, "cards"))
        self.player = Player(self.table, config, stream(seed, "player"))

    def on_start(self, loop: Loop) -> None:
        """Nothing to do."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """Play, or come."""
        if self.counting.called:
            self.player.called()
        else:
            self.player.free()

    def on_end(self, loop: Loop) -> None:
        """Note what was found."""
        self.counting.counts.pairs = self.table.pairs


def one(config: RunConfig, player: PlayerConfig) -> dict[str, Any]:
    """A condition of a participant; returns the small result. Runs in a process of its own."""
    assembly = prepare(assemble(config))
    loop, counting = assembly.loop(), Counting()
    loop.subscribers = [counting]
    if config.algorithm != HUMAN_GATED:
        loop.subscribers.append(Participant(counting, player, config.seed))
    else:
        counting.counts.idle_time = None
    loop.run(config.steps)
    assembly.fleet.close()
    return {
        "algorithm": config.algorithm, "seed": config.seed, "counts": counting.counts.to_json(),
        "order": order(config.seed).index(config.algorithm), "player": dataclasses.asdict(player),
        "config": to_json(assembly.config),
    }  # fmt: skip


def reproduce(config: Table32Config) -> str:
    """Run what is missing; returns the table as Markdown.

    Raises:
        TutelageError: a condition failed.
    """
    jobs = []
    for seed in config.seeds:
        for algorithm in order(seed):
            arguments = condition(algorithm, seed, config.latency), config.player
            file = config.results / f"{slug(algorithm)}-s{seed}.json"
            jobs.append(Job(f"participant {seed}: {algorithm}", one, arguments, file, _summary))
    return table(run_jobs(jobs, config.workers))


def _summary(result: dict[str, Any]) -> str:
    c = result["counts"]
    return f"{c['throughput']} tasks, {c['interventions']} interventions, {c['human_actions']} human actions"


def table(results: list[dict[str, Any]], who: str = "simulated participants") -> str:
    """Published and ours side by side, as Markdown; of participants who lack a condition, nothing."""
    conditions = {seed: {r["algorithm"] for r in results if r["seed"] == seed} for seed in {r["seed"] for r in results}}
    results = [r for r in results if conditions[r["seed"]] >= set(PUBLISHED)]
    people = len({r["seed"] for r in results})
    lines = [
        f"Table 3.2, {people} {who} with 3 robots, {STEPS} timesteps a condition. Mean ± standard "
        "deviation over participants.",
        "",
        f"| Algorithm | | {' | '.join(COLUMNS.values())} |",
        "| --- | --- |" + " ---: |" * len(COLUMNS),
    ]
    found = {a: sorted((r for r in results if r["algorithm"] == a), key=lambda r: int(r["seed"])) for a in PUBLISHED}
    for algorithm, published in PUBLISHED.items():
        cells = [_cell([r["counts"][name] for r in found[algorithm]]) for name in COLUMNS]
        lines += [f"| {algorithm} | published | {published} |", f"| | ours | {' | '.join(cells)} |"]
    lines += ["", f"| {THRIFTY} against | {' | '.join(COLUMNS.values())} |", "| --- |" + " ---: |" * len(COLUMNS)]
    for other in (HG, SAFE, LAZY):
        cells = []
        for name in COLUMNS:
            if not found[other]:
                cells.append("–")  # noqa: RUF001
                continue
            pairs = [(a["counts"][name], b["counts"][name]) for a, b in zip(found[THRIFTY], found[other], strict=True)]
            cells.append("–" if pairs[0][1] is None else f"{_difference(pairs):+.1f} (p = {_p(pairs):.3f})")  # noqa: RUF001
        lines.append(f"| {other} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _cell(values: list[Any]) -> str:
    if not values or None in values:
        return "–"  # noqa: RUF001
    return f"{np.mean(values):.1f} ± {np.std(values, ddof=1) if len(values) > 1 else 0:.1f}"


def _difference(pairs: list[tuple[Any, Any]]) -> float:
    return float(np.mean([a - b for a, b in pairs]))


def _p(pairs: list[tuple[Any, Any]]) -> float:
    return sign_flip_test(np.array([a - b for a, b in pairs], dtype=np.float64))


def sign_flip_test(differences: NDArray[np.float64]) -> float:
    """Two-sided p value of paired differences (n,) with mean zero, by all 2^n changes of their signs (n <= 20)."""
    if len(differences) > 20:
        raise ConfigError("this exact test is for at most 20 participants")
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=len(differences))))
    sums = np.abs(signs @ differences)
    return float(np.mean(sums >= abs(differences.sum()) - 1e-9))
