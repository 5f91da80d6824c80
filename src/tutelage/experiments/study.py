"""The comparison of section 5.6 and appendix C: all algorithms and seeds, in parallel, resumable.

    python -m tutelage.experiments.study Walker2d --seeds 0 1 2 3 4
    python -m tutelage.experiments.study Walker2d --ablations --seeds 0 1 2 --evaluate 0

C.U.R. runs first. Its mean human time T_h sets the others: the Constraint baseline gets T_h more offline pairs and as many
gradient steps in all, Random a threshold at which it solicits T_h in expectation. Every policy is then evaluated frozen,
with hard resets only, and so is the expert (table C.2). Small result files go to results/.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from tyro.conf import Positional

from tutelage.envs.tasks import TASKS
from tutelage.errors import ConfigError, TutelageError
from tutelage.experiments.config import RunConfig
from tutelage.experiments.jobs import Job, resolved, run_jobs, slug, start_or_resume
from tutelage.experiments.table_3 import SETTINGS
from tutelage.fleet.allocation import NOBODY, FleetDAgger
from tutelage.fleet.modes import Mode
from tutelage.fleet.priority import PriorityConfig
from tutelage.learning.imitation import LearnerConfig
from tutelage.seeding import stream

BEHAVIOUR_CLONING = "C. (BC)"
ABLATIONS = ("C.U.R.(-i)", "C.U.", "C.R.", "U.R.", "U.", "R.")
"""The subsets of figure C.1, none with an initial period."""


@dataclass(frozen=True)
class StudyConfig:
    """A comparison of allocation algorithms on one task.

    Attributes:
        task: name of a task.
        seeds: root seeds; never those used for tuning (100 and above).
        steps: T.
        robots: N.
        humans: M.
        t_teleop: t_T.
        observation: what the policies see, "state" or "images"; the latter with the learner of table 3.3.
        evaluate: timesteps of the evaluation of the frozen policies; 0: none.
        ablations: run C.U.R. and its ablations (figure C.1) instead of the baselines.
        workers: runs side by side, one core each.
        out: folder of the run folders.
        results: folder of the small result files.
    """

    task: Positional[str]
    seeds: tuple[int, ...] = (0, 1, 2)
    steps: int = 10_000
    robots: int = 100
    humans: int = 10
    t_teleop: int = 5
    observation: Literal["state", "images"] = "state"
    evaluate: int = 10_000
    ablations: bool = False
    workers: int = 4
    out: Path = Path("runs/study")
    results: Path = Path("results/fleet")

    def __post_init__(self) -> None:
        if self.task not in TASKS:
            raise ConfigError(f"unknown task {self.task!r}; known tasks: {', '.join(TASKS)}")
        if not self.seeds or self.workers < 1 or self.evaluate < 0:
            raise ConfigError("a study needs at least one seed and one worker, and evaluate >= 0")


def random_threshold(budget: float, steps: int, robots: int, humans: int, t_teleop: int, t_reset: int) -> float:
    """The threshold at which Random solicits `budget` human timesteps in expectation, over `steps`.

    Found by bisection on simulated allocation alone (no robot falls, so the budget is met by teleoperation).
    """
    allocator, horizon = FleetDAgger(t_teleop, t_reset), min(steps, 500)

    def busy(threshold: float) -> float:
        rng = stream(0, "random threshold")
        robot_of = np.full(humans, NOBODY)
        mode, age = np.full(robots, Mode.AUTONOMOUS, dtype=np.int8), np.zeros(robots, dtype=np.int64)
        total = 0
        for _ in range(horizon):
            score = rng.random((robots, 1))
            after = allocator(np.where(score > threshold, score, 0.0), robot_of, mode, age, rng)
            age[after[(after != robot_of) & (after != NOBODY)]] = 0
            robot_of = after
            mode[:] = Mode.AUTONOMOUS
            mode[robot_of[robot_of != NOBODY]] = Mode.TELEOPERATED
            age += 1
            total += int((robot_of != NOBODY).sum())
        return total / horizon

    low, high, wanted = 0.0, 1.0, budget / steps
    for _ in range(20):
        middle = (low + high) / 2
        low, high = (middle, high) if busy(middle) > wanted else (low, middle)
    return (low + high) / 2


def configurations(study: StudyConfig, human_time: float | None) -> dict[str, RunConfig]:
    """The first seed's configuration of each algorithm; human_time: T_h of C.U.R., None while it is not known."""
    learner = SETTINGS["table-3.3"].learner if study.observation == "images" else LearnerConfig()
    base = RunConfig(
        study.task, steps=study.steps, robots=study.robots, humans=study.humans, threads=1, torch_threads=1,
        record="none", label="C.U.R.", t_teleop=study.t_teleop, observation=study.observation, learner=learner,
    )  # fmt: skip
    if human_time is None:
        return {"C.U.R.": base}
    with_ = dataclasses.replace
    if study.ablations:
        return {
            name: with_(
                base, priority=name.replace("(-i)", ""), label=name, thresholds=PriorityConfig(initial=0)
            )
            for name in ABLATIONS
        }  # fmt: skip
    threshold = random_threshold(human_time, study.steps, study.robots, study.humans, base.t_teleop, base.t_reset)
    cloning = with_(learner, schedule="never", pretrain=learner.pretrain + study.steps)
    return {
        BEHAVIOUR_CLONING: with_(
            base,
            priority="C.",
            label=BEHAVIOUR_CLONING,
            learner=cloning,
            offline_pairs=TASKS[study.task].offline_pairs + round(human_time),
        ),
        "Random": with_(base, priority="Random.", label="Random", thresholds=PriorityConfig(random=threshold)),
        "U.C.": with_(base, priority="U.C.", label="U.C."),
        # Fleet-ThriftyDAgger needs a goal (section 5.6).
        **({"U.G.C.": with_(base, priority="U.G.C.", label="U.G.C.")} if TASKS[study.task].goal else {}),
    }


def one(config: RunConfig, evaluate: int, expert: bool) -> dict[str, Any]:
    """Run or continue one configuration, evaluate it, and return the small result. Runs in a process of its own."""
    from tutelage.experiments.records import load_run

    run = start_or_resume(config)
    metrics, folder = run.run(), run.folder
    result: dict[str, Any] = {"algorithm": config.algorithm, "seed": config.seed, "metrics": metrics}
    if evaluate:
        result["evaluation"] = _evaluation(folder, evaluate, expert=False)
    if evaluate and expert:
        result["expert"] = _evaluation(folder, evaluate, expert=True)
    lines = load_run(folder).metrics
    pick = np.unique(np.linspace(0, len(lines["t"]) - 1, 50).round().astype(int))
    names = ("t", "successes", "hard_resets", "idle_time", "human_time", "rohe")
    result["curves"] = {name: [round(float(v), 4) for v in lines[name][pick]] for name in names}
    return {**result, "config": resolved(run)}


def _evaluation(folder: Path, steps: int, expert: bool) -> dict[str, Any]:
    """The evaluation of a run over so many timesteps: the one that is there, or a new one."""
    from tutelage.experiments.evaluate import evaluate_run, evaluation_path

    path = evaluation_path(folder, expert)
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    return found if found.get("steps") == steps else evaluate_run(folder, steps, expert=expert)


def run_study(study: StudyConfig) -> list[dict[str, Any]]:
    """Run what is missing; returns the small results of all runs, also written one file each.

    Raises:
        TutelageError: a run failed. It was printed with its traceback, and the others were still run and written.
    """
    reference = run_jobs(_jobs(study, configurations(study, None)), study.workers)
    human_time = float(np.mean([r["metrics"]["human_time"] for r in reference]))
    print(f"C.U.R. solicited {human_time:,.0f} human timesteps on average", flush=True)
    return reference + run_jobs(_jobs(study, configurations(study, human_time), round(human_time)), study.workers)


def _jobs(study: StudyConfig, configs: dict[str, RunConfig], human_time: int = 0) -> list[Job]:
    """human_time: T_h, if the configurations depend on it; with more seeds comes another one, and other runs."""
    jobs = []
    kind = "ablations" if study.ablations else "comparison"
    for seed in study.seeds:
        for name, config in configs.items():
            # C.U.R. is the same run in the comparison and among the ablations of equal length.
            seen = "-images" if study.observation == "images" else ""
            place = study.out / f"{study.task}{seen}-{study.robots}x{study.humans}-{study.steps}"
            budget = f"-{human_time}" if name in (BEHAVIOUR_CLONING, "Random") else ""
            config = dataclasses.replace(config, seed=seed, out=place / f"{slug(name)}{budget}-s{seed}")
            file = study.results / kind / study.task / f"{slug(name)}-s{seed}.json"
            expert = name == "C.U.R." and not study.ablations
            jobs.append(Job(f"{study.task} {name} seed {seed}", one, (config, study.evaluate, expert), file, _summary))
    return jobs


def _summary(result: dict[str, Any]) -> str:
    m, frozen = result["metrics"], result.get("evaluation", {}).get("successes", float("nan"))
    return (
        f"successes {m['successes']:.0f}, hard resets {m['hard_resets']:.0f}, human time {m['human_time']:.0f}, "
        f"ROHE {m['rohe']:.3f}; frozen: successes {frozen:.0f}"
    )


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of `python -m tutelage.experiments.study`."""
    try:
        run_study(tyro.cli(StudyConfig, args=args, description=__doc__))
    except TutelageError as error:
        print(f"study: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
