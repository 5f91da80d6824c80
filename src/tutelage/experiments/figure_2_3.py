"""Figure 2.3: LazyDAgger, its ablations and its rivals on three locomotion tasks (section 2.6, appendix A.1).

One robot and one human, epochs of T timesteps, after each a round of training and ten test rollouts without help. Behaviour
cloning gets as many more offline pairs as LazyDAgger had supervisor actions.

The tasks have their own level of disturbance, and demonstrations are given in calm. The dissertation has no disturbances.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tutelage.envs import experts
from tutelage.errors import ConfigError, MissingExtraError
from tutelage.experiments import plots
from tutelage.experiments.config import RunConfig
from tutelage.experiments.jobs import Job, resolved, run_jobs, slug, start_or_resume
from tutelage.experiments.rollouts import TestRollouts
from tutelage.fleet.gates import GateConfig
from tutelage.learning.imitation import LearnerConfig

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BC, LAZY, SAFE = "Behaviour cloning", "LazyDAgger", "SafeDAgger"
ALGORITHMS = (LAZY, SAFE, "DAgger", BC, "LazyDAgger (-Switch to Auto)", "LazyDAgger (-Noise)")


@dataclass(frozen=True)
class Setting:
    """A row of table A.1, and what section 2.6 says of the task.

    Attributes:
        epochs: N. beta_r: beta_R / beta_H. noise: sigma^2.
        switches: published change of context switches against SafeDAgger.
        cutoff: published L*.
    """

    epochs: int
    beta_r: float
    noise: float
    switches: float
    cutoff: float


SETTINGS = {
    "HalfCheetah": Setting(10, 0.1, 0.30, -0.79, 0.0),
    "Walker2d": Setting(15, 0.1, 0.10, -0.56, 4.3),
    "Ant": Setting(15, 0.5, 0.05, -0.46, 7.6),
}
BETA_H = 5e-3


@dataclass(frozen=True)
class Figure23Config:
    """What of figure 2.3 to reproduce.

    Attributes:
        tasks: of HalfCheetah, Walker2d, Ant.
        seeds: root seeds.
        full: the published scale (10 or 15 epochs of 5,000 timesteps, 2,000 gradient steps after each); default: 5 epochs of
            2,000 timesteps and 1,000 gradient steps.
        workers: runs side by side, one core each.
        out: folder of the run folders.
        results: folder of the small result files and the figure.
    """

    tasks: tuple[str, ...] = tuple(SETTINGS)
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    full: bool = False
    workers: int = 4
    out: Path = Path("runs/figure-2.3")
    results: Path = Path("results/single/figure-2.3")

    def __post_init__(self) -> None:
        unknown = [task for task in self.tasks if task not in SETTINGS]
        if self.workers < 1:
            raise ConfigError(f"workers must be at least 1, got {self.workers}")
        if unknown or not self.tasks or not self.seeds:
            raise ConfigError(f"figure 2.3 has the tasks {', '.join(SETTINGS)}; got {', '.join(unknown) or 'nothing to do'}")


def configuration(task: str, algorithm: str, full: bool, more_pairs: int = 0) -> RunConfig:
    """The run of an algorithm, without seed and folder. more_pairs: offline pairs on top of the 4,000 that all have."""
    setting = SETTINGS[task]
    epochs, every, steps = (setting.epochs, 5000, 2000) if full else (5, 2000, 1000)
    learner = LearnerConfig(
        schedule="never" if algorithm == BC else "step",
        every=every,
        gradient_steps=steps,
        batch=256,
        learning_rate=1e-3,
        pretrain=5 * steps,
    )
    gate = GateConfig(
        beta_h=None if algorithm == SAFE else BETA_H,  # SafeDAgger: where 20 % of the offline data are unsafe
        beta_r=setting.beta_r,
        noise=0.0 if algorithm.endswith("(-Noise)") else setting.noise,
        ask_again=algorithm.endswith("(-Switch to Auto)"),
        beta=0.0,
        epoch=every,
    )
    priority = {BC: "C.", SAFE: "SafeDAgger", "DAgger": "DAgger"}.get(algorithm, LAZY)
    return RunConfig(
        task, priority, robots=1, humans=1, steps=epochs * every, t_teleop=1, t_reset=1,
        offline_pairs=4000 + more_pairs, calibration_steps=1, gate=gate, learner=learner, members=1, bootstrap=False,
        threads=1, torch_threads=1, checkpoint_every=every, metrics_every=every, record="none", label=algorithm,
    )  # fmt: skip


def one(config: RunConfig) -> dict[str, Any]:
    """Run or continue one configuration; returns the small result. Runs in a process of its own."""
    from tutelage.experiments.records import load_run

    run = start_or_resume(config)
    every = config.learner.every
    tests = TestRollouts(run.folder, run.config, every)
    metrics = run.run([tests])
    lines = load_run(run.folder).metrics
    epochs = [{"epoch": 0, **tests.scores["0"], "supervisor_actions": 0, "context_switches": 0}]
    for k, t in enumerate(lines["t"]):
        if t and t % every == 0:
            switches = lines["switches_to_human"][k] + lines["switches_to_robot"][k]
            counts = {"supervisor_actions": int(lines["teleoperation"][k]), "context_switches": int(switches)}
            epochs.append({"epoch": int(t // every), **tests.scores[str(int(t // every))], **counts})
    expert = experts.load(config.task)[1]["scores"][run.config.disturbance]["mean"]
    return {
        "task": config.task, "algorithm": config.algorithm, "seed": config.seed, "epochs": epochs, "metrics": metrics,
        "expert_return": expert, "config": resolved(run),
    }  # fmt: skip


def reproduce(config: Figure23Config) -> str:
    """Run what is missing and draw the figure; returns the table as Markdown.

    Raises:
        TutelageError: a run failed.
    """
    first = [name for name in ALGORITHMS if name != BC]
    results = run_jobs([_job(config, task, name, seed) for task in config.tasks for name in first for seed in config.seeds],
                       config.workers)  # fmt: skip
    more = {
        task: round(float(np.mean([_actions(r) for r in results if (r["task"], r["algorithm"]) == (task, LAZY)])))
        for task in config.tasks
    }
    cloning = [_job(config, task, BC, seed, more[task]) for task in config.tasks for seed in config.seeds]
    results += run_jobs(cloning, config.workers)
    text = table(results)
    try:
        plots.save(figure(results), config.results / "figure.png")
    except MissingExtraError as error:
        print(f"no figure: {error}")
    return text


def _job(config: Figure23Config, task: str, algorithm: str, seed: int, more_pairs: int = 0) -> Job:
    name = f"{slug(algorithm)}-s{seed}"
    place = config.out / ("full" if config.full else "small") / task
    folder = f"{slug(algorithm)}-{more_pairs}-s{seed}" if more_pairs else name  # with more seeds come other numbers of pairs
    run = dataclasses.replace(configuration(task, algorithm, config.full, more_pairs), seed=seed, out=place / folder)
    return Job(f"{task} {algorithm} seed {seed}", one, (run,), config.results / task / f"{name}.json", summary)


def summary(result: dict[str, Any]) -> str:
    """One line about the result of `one`."""
    last = result["epochs"][-1]
    return (
        f"return {last['return_mean'] / result['expert_return']:.2f} of the expert's, "
        f"{last['supervisor_actions']:,} supervisor actions, {last['context_switches']:,} context switches"
    )


def _actions(result: dict[str, Any]) -> float:
    return float(result["epochs"][-1]["supervisor_actions"])


def last(results: list[dict[str, Any]], task: str, algorithm: str, name: str) -> Any:
    """A number of the last epoch for each seed, (n,); return_mean as a fraction of the expert's return."""
    mine = [r for r in results if (r["task"], r["algorithm"]) == (task, algorithm)]
    return np.array([r["epochs"][-1][name] / (r["expert_return"] if name == "return_mean" else 1) for r in mine])


def present(results: list[dict[str, Any]]) -> list[str]:
    """The tasks that have results, in the order of the figure."""
    return [task for task in SETTINGS if any(r["task"] == task for r in results)]


def scale(results: list[dict[str, Any]]) -> str:
    """How large the runs were, in words."""
    every = results[0]["config"]["learner"]["every"]
    return (
        "published scale" if every == 5000 else f"small scale: {len(results[0]['epochs']) - 1} epochs of {every:,} timesteps"
    )


def table(results: list[dict[str, Any]]) -> str:
    """Published and ours side by side, as Markdown."""
    tasks = present(results)
    lines = [
        f"Figure 2.3, {scale(results)}, {len({r['seed'] for r in results})} seeds, mean ± 95 % interval over seeds. Return: "
        "of ten test rollouts after the last epoch, as a fraction of the expert's.",
        "",
        "| Task | Algorithm | Return ↑ | Supervisor actions ↓ | Context switches ↓ |",
        "| --- | --- | ---: | ---: | ---: |",
    ]
    for task in tasks:
        for name in ALGORITHMS:
            cells = [last(results, task, name, k) for k in ("return_mean", "supervisor_actions", "context_switches")]
            if len(cells[0]):
                shown = [plots.interval(values, digits) for values, digits in zip(cells, (2, 0, 0), strict=True)]
                lines.append(f"| {task} | {name} | {' | '.join(shown)} |")
    lines += [
        "",
        "| Task | LazyDAgger's context switches against SafeDAgger's: published | ours | L*: published | ours |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for task in tasks:
        (c_lazy, d_lazy), (c_safe, d_safe) = (
            [float(last(results, task, name, k).mean()) for k in ("context_switches", "supervisor_actions")]
            for name in (LAZY, SAFE)
        )
        change = c_lazy / c_safe - 1 if c_safe else math.nan
        cutoff = max(0.0, (d_lazy - d_safe) / (c_safe - c_lazy)) if c_safe > c_lazy else math.inf
        published = SETTINGS[task]
        lines.append(f"| {task} | {published.switches:+.0%} | {change:+.0%} | {published.cutoff:.1f} | {cutoff:.1f} |")
    return "\n".join(lines) + "\n"


def figure(results: list[dict[str, Any]]) -> Figure:
    """Columns (A) to (D) of figure 2.3, a row for each task: mean and 95 % band over seeds.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("matplotlib", "report") from None
    tasks = present(results)
    rivals, ablations = (LAZY, SAFE, "DAgger", BC), (LAZY, *ALGORITHMS[4:])
    columns = (
        ("A: return / expert's", "return_mean", rivals), ("B: return / expert's", "return_mean", ablations),
        ("C: supervisor actions", "supervisor_actions", rivals[:3]), ("D: context switches", "context_switches", rivals[:2]),
    )  # fmt: skip
    theme = plots.LIGHT
    colour = {name: theme.series[k] for k, name in enumerate(ALGORITHMS)}
    with rc_context({"font.family": "sans-serif", "font.size": 9}):
        picture = Figure(figsize=(13, 3.1 * len(tasks) + 0.6), layout="constrained", facecolor=theme.background)
        axes = picture.subplots(len(tasks), 4, squeeze=False)
        for row, task in zip(axes, tasks, strict=True):
            for axis, (title, metric, names) in zip(row, columns, strict=True):
                for name in reversed(names):
                    mine = [r for r in results if (r["task"], r["algorithm"]) == (task, name)]
                    if not mine:
                        continue
                    scale = [r["expert_return"] if metric == "return_mean" else 1.0 for r in mine]
                    values = np.array([[e[metric] / s for e in r["epochs"]] for r, s in zip(mine, scale, strict=True)])
                    mean, half = plots.mean_ci(values)
                    epochs = np.arange(values.shape[1])
                    axis.plot(epochs, mean, color=colour[name], linewidth=2, label=name)
                    axis.fill_between(epochs, mean - half, mean + half, color=colour[name], alpha=0.15, linewidth=0)
                if metric == "supervisor_actions":
                    axis.set_yscale("symlog", linthresh=100)
                if metric != "return_mean":
                    axis.set_ylim(bottom=0)  # bands end where counts do
                    axis.yaxis.set_major_formatter(lambda value, position: f"{value:,.0f}")
                axis.set_title(f"{task}, {title}", loc="left", color=theme.text, fontsize=9)
                axis.set_xlabel("epoch", color=theme.muted)
                axis.grid(color=theme.grid)
                axis.spines[["top", "right"]].set_visible(False)
        found = {text: handle for axis in axes.flat for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)}
        shown = [name for name in ALGORITHMS if name in found]
        picture.legend(
            [found[n] for n in shown], shown, loc="outside lower left", ncols=len(shown), frameon=False, fontsize=9
        )
    return picture
