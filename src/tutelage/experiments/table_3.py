"""Tables 3.1 and 3.3: who should decide when a human steps in? One robot and one human (section 3.5, appendix B.2).

Table 3.1 is peg insertion: 30 demonstrations (behaviour cloning gets 45), then 10,000 timesteps in which control goes back
and forth; the policies are trained anew every 2,000 timesteps. Then 100 episodes without help, and 20 with help but without
learning. Table 3.3 is cable routing from images: 25 demonstrations, 1,500 timesteps, new policies every 500.

The tasks are our own models of the dissertation's, at their own level of disturbance; demonstrations are given in calm.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tutelage.envs.rollout import rollout
from tutelage.envs.tasks import TASKS
from tutelage.errors import ConfigError
from tutelage.experiments import plots
from tutelage.experiments.assemble import fleet_of
from tutelage.experiments.config import RunConfig
from tutelage.experiments.evaluate import evaluate_policy
from tutelage.experiments.jobs import Job, resolved, run_jobs, slug, start_or_resume
from tutelage.experiments.records import load_run
from tutelage.experiments.run import loop_state
from tutelage.fleet.attempts import Attempts, attempts, request_rate
from tutelage.fleet.events import Events
from tutelage.fleet.gates import GateConfig
from tutelage.fleet.loop import Loop
from tutelage.fleet.metrics import EventLog
from tutelage.fleet.modes import Event
from tutelage.fleet.step import Step
from tutelage.learning.critic import CriticConfig
from tutelage.learning.imitation import LearnerConfig
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.seeding import derive

BC, SAFE, LAZY, HG, THRIFTY = "Behaviour cloning", "SafeDAgger", "LazyDAgger", "HG-DAgger", "ThriftyDAgger"
NO_NOVELTY, NO_RISK = "ThriftyDAgger (-Novelty)", "ThriftyDAgger (-Risk)"
PUBLISHED_3_1 = {
    BC: "– | – | 108.0 ± 15.9 | 24/100 | – | – | – | –",  # noqa: RUF001 - en dashes
    SAFE: "3.89 ± 1.44 | 19.8 ± 9.9 | 88.8 ± 19.4 | 24/100 | 4.00 ± 1.37 | 19.5 ± 5.3 | 77.5 ± 11.7 | 17/20",
    LAZY: "1.46 ± 1.15 | 13.2 ± 12.4 | 102.1 ± 18.2 | 48/100 | 1.73 ± 1.29 | 12.6 ± 14.4 | 91.7 ± 24.0 | 11/20",
    HG: "1.49 ± 0.88 | 20.3 ± 15.6 | 97.1 ± 17.5 | 57/100 | 1.15 ± 0.73 | 17.1 ± 11.6 | 103.6 ± 14.0 | 20/20",
    NO_NOVELTY: "0.79 ± 0.81 | 35.1 ± 23.1 | 70.0 ± 35.8 | 49/100 | 0.33 ± 0.62 | 2.5 ± 5.0 | 114.0 ± 26.0 | 12/20",
    NO_RISK: "0.99 ± 0.96 | 7.8 ± 12.0 | 104.2 ± 19.2 | 49/100 | 1.39 ± 0.95 | 9.8 ± 12.0 | 109.1 ± 22.9 | 18/20",
    THRIFTY: "0.88 ± 1.01 | 43.6 ± 24.5 | 60.0 ± 32.8 | 73/100 | 1.35 ± 0.66 | 21.3 ± 15.0 | 84.8 ± 21.8 | 20/20",
}
PUBLISHED_3_3 = {
    BC: "– | – | – | 0/15 | – | – | – | –",  # noqa: RUF001
    HG: "1.55 ± 1.16 | 13.9 ± 10.9 | 55.5 ± 10.9 | 10/15 | 0.40 ± 0.49 | 2.7 ± 3.5 | 73.9 ± 7.9 | 15/15",
    THRIFTY: "1.42 ± 1.14 | 15.2 ± 12.4 | 45.5 ± 18.3 | 12/15 | 0.40 ± 0.71 | 1.5 ± 3.1 | 61.3 ± 6.5 | 15/15",
}


@dataclass(frozen=True)
class Setting:
    """A table, with the numbers of appendix B.2 and B.3.

    Attributes:
        task: name of ours. observation: what policies see of it. actions: A. steps: timesteps of a run.
        pairs, more_pairs: state-action pairs of the demonstrations, and those that behaviour cloning gets.
        first: episodes of the cloned policy alone, for the first thresholds and critic data.
        tests, aided: test episodes without and with help.
        learner: of all but behaviour cloning. critic: of ThriftyDAgger.
        small_learner, small_critic: those that take less than an hour on four cores; likewise seeds: 0 to so many.
        published: the rows as printed: interventions, human and robot actions of a training episode, successes without
            help, then interventions and actions of a successful test episode with help, and successes with it.
    """

    task: str
    observation: Literal["state", "images"]
    actions: int
    steps: int
    pairs: int
    more_pairs: int
    first: int
    tests: int
    aided: int
    learner: LearnerConfig
    critic: CriticConfig
    small_learner: LearnerConfig
    small_critic: CriticConfig
    seeds: int
    published: dict[str, str]


_PEG = (
    LearnerConfig("scratch", every=2000, gradient_steps=2500, batch=100, learning_rate=1e-3, pretrain=2500),
    CriticConfig(gamma=0.9999, learning_rate=1e-3, batch=50, positives=0.1, every=1),
)
_CABLE = (
    LearnerConfig("scratch", every=500, gradient_steps=1500, batch=64, learning_rate=2.5e-4, pretrain=1500),
    CriticConfig(gamma=0.9999, learning_rate=2.5e-4, batch=64, positives=0.1, every=1),
)
_CABLE_SMALL = (  # a gradient step of five networks that see takes 0.2 s of a core: updates go on with the weights there are
    LearnerConfig("step", every=500, gradient_steps=500, batch=64, learning_rate=2.5e-4, pretrain=1500),
    CriticConfig(gamma=0.9999, learning_rate=2.5e-4, batch=64, positives=0.1, every=2, pretrain=1000),
)
SETTINGS = {
    "table-3.1": Setting(
        "PegInsertion", "state", 5, 10_000, 2687, 4004, 10, 100, 20, *_PEG, *_PEG, 5, PUBLISHED_3_1
    ),
    "table-3.3": Setting(
        "CableRouting", "images", 2, 1500, 1381, 1381, 5, 100, 15, *_CABLE, *_CABLE_SMALL, 3, PUBLISHED_3_3
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Table3Config:
    """What of a table to reproduce. A run has the published scale.

    Attributes:
        table: "table-3.1" or "table-3.3".
        seeds: root seeds.
        full: the published scale, which table-3.1 has in any case. Else the networks of table-3.3 are trained on from the
            weights that they have, not anew.
        steps: timesteps of a run; default: the published number.
        workers: runs side by side, one core each.
        out: folder of the run folders.
        results: folder of the small result files.
    """

    table: str = "table-3.1"
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    full: bool = False
    steps: int | None = None
    workers: int = 4
    out: Path = Path("runs/table-3.1")
    results: Path = Path("results/single/table-3.1")

    def __post_init__(self) -> None:
        if self.table not in SETTINGS:
            raise ConfigError(f"unknown table {self.table!r}: use {', '.join(SETTINGS)}")
        if self.workers < 1 or not self.seeds or (self.steps is not None and self.steps < 1):
            raise ConfigError(f"{self.table} needs seeds, steps and workers; got {self.seeds}, {self.steps}, {self.workers}")


def configuration(setting: Setting, algorithm: str, full: bool = True, steps: int | None = None) -> RunConfig:
    """The run of an algorithm, without seed and folder."""
    largest = 4.0 * setting.actions  # thresholds of B.2 are squared distances, ours fractions of the largest one
    gate = {
        SAFE: GateConfig(),  # where 20 % of the offline data are unsafe: 0.008 in the dissertation
        LAZY: GateConfig(beta_h=0.015 / largest, beta_r=0.25, noise=0.02),
        HG: GateConfig(unsafe=0.003),  # a person steps in where the robot is clearly wrong: set on seed 100
        NO_NOVELTY: GateConfig(without="novelty"),
        NO_RISK: GateConfig(without="risk"),
    }.get(algorithm, GateConfig(alpha=0.01))
    learner, critic = (setting.learner, setting.critic) if full else (setting.small_learner, setting.small_critic)
    if algorithm == BC:
        learner = dataclasses.replace(learner, schedule="never")
    return RunConfig(
        setting.task, {BC: "C.", SAFE: SAFE, LAZY: LAZY, HG: HG}.get(algorithm, THRIFTY),
        robots=1, humans=1, steps=steps or setting.steps, t_teleop=1, t_reset=1,
        observation=setting.observation, offline_pairs=setting.more_pairs if algorithm == BC else setting.pairs,
        calibration_steps=setting.first * TASKS[setting.task].horizon, gate=gate, learner=learner, critic=critic,
        threads=1, torch_threads=1, checkpoint_every=min(1000, setting.learner.every), metrics_every=1000, record="none",
        label=algorithm,
    )  # fmt: skip


def one(config: RunConfig, tests: int, aided: int) -> dict[str, Any]:
    """Run or continue one configuration, then test it; returns the small result. Runs in a process of its own."""
    run = start_or_resume(config)
    metrics = run.run()
    log = load_run(run.folder).log
    policy = EnsemblePolicy.load(run.folder / "policy.safetensors")[0]
    fleet = fleet_of(run.config, tests, run.config.disturbance)
    alone = rollout(fleet, policy, derive(config.seed, "test episodes") % 2**32)
    fleet.close()
    result = {
        "algorithm": config.algorithm, "seed": config.seed, "metrics": metrics, "training": _episodes(attempts(log)),
        "request_rate": request_rate(log), "alone": float(alone.succeeded.mean()), "config": resolved(run),
    }  # fmt: skip
    if config.algorithm != BC:
        result |= _with_help(run.folder, run.config, policy, aided)
    return result


def _with_help(folder: Path, config: RunConfig, policy: EnsemblePolicy, episodes: int) -> dict[str, Any]:
    """The first episodes of the frozen policy with a human who helps as the algorithm says, and learns it nothing."""
    logbook = Logbook(config.robots, config.humans)
    helped = dataclasses.replace(config, steps=episodes * (TASKS[config.task].horizon + 1))  # enough, resets included
    evaluate_policy(helped, policy, config.priority, subscribers=[logbook], learned=loop_state(folder))
    tried = attempts(logbook.log)
    tried = tried.where(np.arange(len(tried.robot)) < episodes)
    reached = tried.outcome == Event.SUCCESS
    # Successful episodes only, "in order not to bias the metrics by the maximum episode horizon length" (section 3.5).
    return {"aided": float(reached.mean()), "execution": _episodes(tried.where(reached))}


class Logbook:
    """A subscriber that keeps all events."""

    def __init__(self, num_robots: int, num_humans: int) -> None:
        self.num_robots, self.num_humans, self.steps = num_robots, num_humans, 0
        self.parts: list[Events] = []

    def on_start(self, loop: Loop) -> None:
        """Nothing to do."""

    def on_step(self, loop: Loop, step: Step) -> None:
        """Keep the events of the step."""
        self.parts.append(step.events)
        self.steps = step.t + 1

    def on_end(self, loop: Loop) -> None:
        """Nothing to do."""

    @property
    def log(self) -> EventLog:
        """All events so far."""
        return EventLog(Events.concatenate(self.parts), self.num_robots, self.num_humans, self.steps)


def _episodes(tried: Attempts) -> dict[str, Any]:
    """Mean and standard deviation over episodes, and how many there were."""
    columns = {"interventions": tried.interventions, "human": tried.human_actions, "robot": tried.robot_actions}
    spread = {name: [float(v.mean()), float(v.std())] if len(v) else None for name, v in columns.items()}
    return {"episodes": len(tried.robot), "successes": int((tried.outcome == Event.SUCCESS).sum()), **spread}


def reproduce(config: Table3Config) -> str:
    """Run what is missing; returns the table as Markdown.

    Raises:
        TutelageError: a run failed.
    """
    setting, jobs = SETTINGS[config.table], []
    place = config.out / "full" if config.full else config.out
    for algorithm in reversed(setting.published):
        for seed in config.seeds:
            name = f"{slug(algorithm)}-s{seed}"
            run = dataclasses.replace(
                configuration(setting, algorithm, config.full, config.steps), seed=seed, out=place / name
            )
            arguments = run, setting.tests, setting.aided
            jobs.append(Job(f"{algorithm} seed {seed}", one, arguments, config.results / f"{name}.json", _summary))
    return table(config.table, run_jobs(jobs, config.workers))


def _summary(result: dict[str, Any]) -> str:
    text = f"{result['alone']:.0%} alone, {result['metrics']['teleoperation']:,.0f} human actions"
    return text if result["algorithm"] == BC else f"{text}, {result['aided']:.0%} with help"


def table(name: str, results: list[dict[str, Any]]) -> str:
    """Published and ours side by side, as Markdown."""
    count = {algorithm: sum(r["algorithm"] == algorithm for r in results) for algorithm in SETTINGS[name].published}
    counts = sorted(set(count.values()))
    seeds = f"{counts[0]} seeds" if len(counts) == 1 else f"seeds: {', '.join(f'{a} {n}' for a, n in count.items())}"
    steps = int(results[0]["metrics"]["t"])
    lines = [
        f"{name.replace('t', 'T', 1).replace('-', ' ')}, {_scale(name, results)}: {steps:,} timesteps, {seeds}. "
        "Mean ± standard deviation over episodes; our successes are the mean over seeds ± 95 % interval.",
        "",
        "| Algorithm | | Ints | Acts (H) | Acts (R) | Alone ↑ | Ints, execution | Acts (H) | Acts (R) | With help ↑ |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for algorithm, published in SETTINGS[name].published.items():
        if mine := [r for r in results if r["algorithm"] == algorithm]:
            cells = [*_pooled(mine, "training"), _rate(mine, "alone"), *_pooled(mine, "execution"), _rate(mine, "aided")]
            lines += [f"| {algorithm} | published | {published} |", f"| | ours | {' | '.join(cells)} |"]
    lines += ["", "| Algorithm | Requests per autonomous timestep (alpha_h = 0.01) |", "| --- | ---: |"]
    for name in (NO_NOVELTY, NO_RISK, THRIFTY):
        if rates := [r["request_rate"] for r in results if r["algorithm"] == name]:
            lines.append(f"| {name} | {np.mean(rates):.4f} |")
    return "\n".join(lines) + "\n"


def _scale(name: str, results: list[dict[str, Any]]) -> str:
    learner = next((r["config"]["learner"] for r in results if r["algorithm"] != BC), None)
    published = learner is None or learner["schedule"] == SETTINGS[name].learner.schedule
    return "published scale" if published else "small scale"


def _rate(results: list[dict[str, Any]], name: str) -> str:
    values = np.array([100 * r[name] for r in results if name in r])
    return f"{plots.interval(values)} %" if len(values) else "–"  # noqa: RUF001


def _pooled(results: list[dict[str, Any]], part: str) -> list[str]:
    """Mean and standard deviation over the episodes of all seeds, for the three counts."""
    cells = []
    for column, digits in (("interventions", 2), ("human", 1), ("robot", 1)):
        found = [(r[part]["episodes"], *r[part][column]) for r in results if part in r and r[part][column]]
        if not found:
            cells.append("–")  # noqa: RUF001
            continue
        n, mean, sd = np.array(found).T
        middle = float(np.average(mean, weights=n))
        spread = math.sqrt(float(np.average(np.square(sd) + np.square(mean - middle), weights=n)))
        cells.append(f"{middle:.{digits}f} ± {spread:.{digits}f}")
    return cells
