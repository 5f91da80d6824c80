"""Figure A.1: how sensitive LazyDAgger is to beta_H and beta_R, on the runs of figure 2.3 (appendix A.1).

Nine settings a task, each run once, as published. The figure states one value of beta_H (5e-4) in the text and gives the
others on axes that its text version does not have; ours are a decade apart around the published default.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tutelage.errors import ConfigError, MissingExtraError
from tutelage.experiments import figure_2_3, plots
from tutelage.experiments.jobs import Job, run_jobs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BETA_H = (5e-4, 5e-3, 5e-2)
BETA_R = (0.1, 0.5, 0.9)
"""As fractions of beta_H."""
COLUMNS = {
    "return_mean": "Return / expert's", "supervisor_actions": "Supervisor actions", "context_switches": "Context switches"
}  # fmt: skip


@dataclass(frozen=True)
class FigureA1Config:
    """What of figure A.1 to reproduce.

    Attributes:
        tasks: of HalfCheetah, Walker2d, Ant.
        seeds: root seeds; several are averaged.
        full: the published scale; default: the small scale of figure 2.3.
        workers: runs side by side, one core each.
        out: folder of the run folders.
        results: folder of the small result files and the figure.
    """

    tasks: tuple[str, ...] = tuple(figure_2_3.SETTINGS)
    seeds: tuple[int, ...] = (0,)
    full: bool = False
    workers: int = 4
    out: Path = Path("runs/figure-A.1")
    results: Path = Path("results/single/figure-A.1")

    def __post_init__(self) -> None:
        unknown = [task for task in self.tasks if task not in figure_2_3.SETTINGS]
        if self.workers < 1 or unknown or not self.tasks or not self.seeds:
            raise ConfigError(
                f"figure A.1 has the tasks {', '.join(figure_2_3.SETTINGS)} and needs seeds and workers; got "
                f"{', '.join(unknown) or 'nothing to do'}"
            )


def reproduce(config: FigureA1Config) -> str:
    """Run what is missing and draw the figure; returns the numbers as Markdown.

    Raises:
        TutelageError: a run failed.
    """
    jobs = [
        _job(config, task, beta_h, beta_r, seed)
        for task in config.tasks for beta_h in BETA_H for beta_r in BETA_R for seed in config.seeds
    ]  # fmt: skip
    results = run_jobs(jobs, config.workers)
    try:
        plots.save(figure(results), config.results / "figure.png")
    except MissingExtraError as error:
        print(f"no figure: {error}")
    return table(results)


def _job(config: FigureA1Config, task: str, beta_h: float, beta_r: float, seed: int) -> Job:
    base = figure_2_3.configuration(task, figure_2_3.LAZY, config.full)
    folder, name = config.out / ("full" if config.full else "small") / task, f"h{beta_h:g}-r{beta_r:g}-s{seed}"
    gate = dataclasses.replace(base.gate, beta_h=beta_h, beta_r=beta_r)
    run = dataclasses.replace(base, gate=gate, seed=seed, out=folder / name)
    title = f"{task} beta_H {beta_h:g} beta_R {beta_r:g} beta_H seed {seed}"
    return Job(title, figure_2_3.one, (run,), config.results / task / f"{name}.json", figure_2_3.summary)


def grid(results: list[dict[str, Any]], task: str, name: str) -> Any:
    """Means over seeds after the last epoch, (beta_R, beta_H), NaN where nothing was run; returns over the expert's."""
    values = np.full((len(BETA_R), len(BETA_H)), np.nan)
    for i, beta_r in enumerate(BETA_R):
        for j, beta_h in enumerate(BETA_H):
            mine = [r for r in results if (_gate(r)["beta_h"], _gate(r)["beta_r"]) == (beta_h, beta_r)]
            if len(found := figure_2_3.last(mine, task, figure_2_3.LAZY, name)):
                values[i, j] = found.mean()
    return values


def table(results: list[dict[str, Any]]) -> str:
    """All settings as Markdown: a row for each."""
    lines = [
        f"Figure A.1, {figure_2_3.scale(results)}, seeds {', '.join(map(str, sorted({r['seed'] for r in results})))}.",
        "",
        f"| Task | beta_H | beta_R / beta_H | {' | '.join(COLUMNS.values())} |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for task in figure_2_3.present(results):
        values = {name: grid(results, task, name) for name in COLUMNS}
        for j, beta_h in enumerate(BETA_H):
            for i, beta_r in enumerate(BETA_R):
                cells = [f"{values[name][i, j]:,.{2 if name == 'return_mean' else 0}f}" for name in COLUMNS]
                lines.append(f"| {task} | {beta_h:g} | {beta_r:g} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def figure(results: list[dict[str, Any]]) -> Figure:
    """A row of heat maps for each task: return, supervisor actions, context switches.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("matplotlib", "report") from None
    tasks, theme = figure_2_3.present(results), plots.LIGHT
    with rc_context({"font.family": "sans-serif", "font.size": 9}):
        picture = Figure(figsize=(9.5, 2.6 * len(tasks) + 0.3), layout="constrained", facecolor=theme.background)
        for row, task in zip(picture.subplots(len(tasks), 3, squeeze=False), tasks, strict=True):
            for axis, (name, title) in zip(row, COLUMNS.items(), strict=True):
                values = grid(results, task, name)
                image = axis.imshow(values, cmap="viridis", origin="lower", aspect="auto")
                low, high = image.get_clim()
                for (i, j), value in np.ndenumerate(values):
                    if np.isfinite(value):
                        dark = value < low + 0.6 * (high - low)
                        text = f"{value:.2f}" if name == "return_mean" else f"{value:,.0f}"
                        axis.text(j, i, text, ha="center", va="center", color="white" if dark else "black")
                axis.set_xticks(range(len(BETA_H)), [f"{v:g}" for v in BETA_H])
                axis.set_yticks(range(len(BETA_R)), [f"{v:g}" for v in BETA_R])
                axis.set_xlabel("$\\beta_H$", color=theme.muted)
                axis.set_ylabel("$\\beta_R / \\beta_H$", color=theme.muted)
                axis.set_title(f"{task}, {title}", loc="left", color=theme.text, fontsize=9)
    return picture


def _gate(result: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = result["config"]["gate"]
    return found
