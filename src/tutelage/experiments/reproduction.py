"""`tutelage reproduce`: which figure is made by which experiment, at which scale."""

from __future__ import annotations

from pathlib import Path

from tutelage.experiments import figure_2_3
from tutelage.experiments.study import StudyConfig, run_study
from tutelage.experiments.tables import tables


def reproduce(
    what: str, tasks: tuple[str, ...], seeds: tuple[int, ...], full: bool, workers: int, out: Path, results: Path
) -> str:
    """Run what is missing of a figure; returns the tables, published and ours, as Markdown.

    Args:
        what: "figure-2.3", "figure-5.3" or "figure-C.1".
        tasks: which tasks; empty: those of the figure.
        seeds: root seeds; empty: the figure's own number of them.
        full: the published scale. Else figure-5.3 has 2,000 timesteps in place of 10,000, figure-C.1 3,000.
        workers: runs side by side.
        out: folder of the run folders.
        results: folder of the small result files; the experiment has its own folder in it.
    """
    if what == "figure-2.3":
        chosen = {"tasks": tasks, "seeds": seeds}
        given = {name: value for name, value in chosen.items() if value}
        config = figure_2_3.Figure23Config(
            **given, full=full, workers=workers, out=out, results=results / "single" / what  # type: ignore[arg-type]
        )  # fmt: skip
        return figure_2_3.reproduce(config)
    ablations = what == "figure-C.1"
    small, evaluate = (3000, 0) if ablations else (2000, 1000)
    for task in tasks or (("Walker2d",) if ablations else ("Walker2d", "Ant", "Humanoid")):
        run_study(
            StudyConfig(
                task, seeds or (0, 1, 2), steps=10_000 if full else small, ablations=ablations, workers=workers, out=out,
                evaluate=(0 if ablations else 10_000) if full else evaluate, results=results / "fleet",
            )
        )  # fmt: skip
    return tables(results / "fleet")
