"""`tutelage reproduce`: which figure or table is made by which experiment, at which scale."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tutelage.envs.tasks import TASKS
from tutelage.errors import ConfigError
from tutelage.experiments import figure_2_3, figure_5_5, figure_a_1, gates_table, sweeps, table_3, table_3_2, table_8_3
from tutelage.experiments.study import StudyConfig, run_study
from tutelage.experiments.tables import tables


def reproduce(
    what: str, tasks: tuple[str, ...], seeds: tuple[int, ...], full: bool, workers: int, out: Path, results: Path
) -> str:
    """Run what is missing of a figure; returns the tables, published and ours, as Markdown.

    Args:
        what: "figure-2.3", "figure-A.1", "table-3.1", "table-3.2", "table-3.3", "table-8.3", "gates", "figure-5.3",
            "figure-5.5", "figure-5.5-remote", "figure-C.1", or "figure-C.2" to "figure-C.4".
        tasks: which tasks; empty: those of the figure, or Walker2d for those of appendix C.
        seeds: root seeds; empty: the figure's own number of them.
        full: the published scale. Else figure-5.3 has 2,000 timesteps in place of 10,000 (Anymal and AllegroHand
            5,000: an episode, or the initial period of C.U.R., has 2,500), figure-5.5 sees states in place of images,
            figure-C.1 3,000, figures C.2 to C.4 2,000 and one seed in place of three; `gates`, which
            nobody published, 2,000 in place of 10,000; table-3.3 has 3 seeds and trains its networks on instead of anew;
            table-3.1 and table-3.2 have the published scale in any case.
        workers: runs side by side.
        out: folder of the run folders.
        results: folder of the small result files; the experiment has its own folder in it.

    Raises:
        ConfigError: a task that the figure does not have.
        TutelageError: a run failed.
    """
    chosen: dict[str, Any] = {"tasks": tasks, "seeds": seeds}
    given = {name: value for name, value in chosen.items() if value}
    given |= {"workers": workers, "out": out, "results": results / "single" / what}
    if what == "figure-2.3":
        return figure_2_3.reproduce(figure_2_3.Figure23Config(full=full, **given))
    if what == "figure-A.1":
        return figure_a_1.reproduce(figure_a_1.FigureA1Config(full=full, **given))
    if what == "gates":
        each = given.pop("tasks", (gates_table.GatesConfig.task,))
        steps = 10_000 if full else gates_table.GatesConfig.steps
        return "\n".join(gates_table.reproduce(gates_table.GatesConfig(task, steps=steps, **given)) for task in each)
    if what in ("table-3.2", "table-8.3", "figure-5.5-remote") and tasks:
        raise ConfigError(f"{what} is about one task; leave out --tasks")
    if what == "table-8.3":
        return table_8_3.reproduce(table_8_3.Table83Config(results=given["results"]))
    if what == "figure-5.5-remote":
        return figure_5_5.reproduce(figure_5_5.Figure55Config(seeds or (0, 1, 2), results=given["results"]))
    if what == "table-3.2":
        seeds = given.get("seeds", table_3_2.Table32Config.seeds)
        return table_3_2.reproduce(table_3_2.Table32Config(seeds, workers, results=given["results"]))
    if what in sweeps.SWEEPS:
        if full:
            given.setdefault("seeds", (0, 1, 2))
        given["out"] = out.parent / "figures-C.2-to-C.4"  # which have runs in common
        steps = 10_000 if full else sweeps.SweepConfig.steps
        return sweeps.reproduce(sweeps.SweepConfig(what, steps=steps, **given))
    if what in table_3.SETTINGS:
        if tasks not in ((), (table_3.SETTINGS[what].task,)):
            raise ConfigError(f"{what} is about {table_3.SETTINGS[what].task}; leave out --tasks")
        given.pop("tasks", None)
        if not full:
            given.setdefault("seeds", tuple(range(table_3.SETTINGS[what].seeds)))
        return table_3.reproduce(table_3.Table3Config(what, full=full, **given))
    if what == "figure-5.5":
        if tasks not in ((), ("BlockPushing",)):
            raise ConfigError("figure-5.5 is about BlockPushing; leave out --tasks")
        run_study(
            StudyConfig(
                "BlockPushing", seeds or (0, 1, 2), steps=250, robots=4, humans=2, t_teleop=3, evaluate=0,
                observation="images" if full else "state", workers=workers, out=out, results=results / "fleet",
            )
        )  # fmt: skip
        return tables(results / "fleet")
    ablations = what == "figure-C.1"
    for task in tasks or (("Walker2d",) if ablations else ("Walker2d", "Ant", "Humanoid", "Anymal")):
        # Two episodes, and twice the initial period of C.U.R.; a task that is unknown, the study refuses.
        horizon, initial = (TASKS[task].horizon, TASKS[task].initial_period) if task in TASKS else (1, 1)
        steps, evaluate = max(3000 if ablations else 2000, 2 * horizon, 2 * initial), 0 if ablations else max(1000, horizon)
        if full:
            steps, evaluate = 10_000, 0 if ablations else 10_000
        run_study(
            StudyConfig(
                task, seeds or (0, 1, 2), steps=steps, ablations=ablations, workers=workers, out=out, evaluate=evaluate,
                results=results / "fleet",
            )
        )  # fmt: skip
    return tables(results / "fleet")
