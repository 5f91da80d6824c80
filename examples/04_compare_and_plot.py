"""Two algorithms, two seeds each: one table, one figure, one page."""

from pathlib import Path

from tutelage.experiments import plots
from tutelage.experiments.config import RunConfig
from tutelage.experiments.records import load_runs
from tutelage.experiments.report import summary_table, write_report
from tutelage.experiments.run import Run
from tutelage.learning.imitation import LearnerConfig

FOLDER = Path("runs/compare")
folders = []
for priority in ("C.", "U.C."):
    for seed in (0, 1):
        folder = FOLDER / f"{priority.replace('.', '').lower()}-s{seed}"
        config = RunConfig(
            "Walker2d", priority=priority, robots=10, humans=2, steps=200, seed=seed, out=folder,
            threads=1, torch_threads=1, offline_pairs=2000, calibration_steps=50, learner=LearnerConfig(pretrain=200),
        )  # fmt: skip
        # A run that was interrupted goes on where it stopped.
        run = Run.resume(folder) if (folder / "config.json").exists() else Run.start(config)
        run.run()
        folders.append(folder)

runs = load_runs(folders)
print(summary_table(runs))
print("figure:", plots.save(plots.curves(runs), FOLDER / "curves.svg"))
print("report:", write_report(folders, FOLDER))
