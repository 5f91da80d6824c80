"""How hard is a level of disturbance? The rule by which each task's level was fixed, before any comparison.

    python -m tutelage.experiments.levels Walker2d

A level suits a comparison of interactive learners when help is possible and needed (`suits`). Of the levels that suit, a
task has the strongest. Measured on a seed that no comparison uses.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from tyro.conf import Positional

from tutelage.envs import experts
from tutelage.envs.rollout import rollout
from tutelage.envs.tasks import TASKS
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import RunConfig
from tutelage.experiments.prepare import prepare
from tutelage.experiments.table_3 import SETTINGS
from tutelage.learning.imitation import LearnerConfig
from tutelage.seeding import derive
from tutelage.store import write_atomic


@dataclass(frozen=True)
class LevelsConfig:
    """What to measure.

    Attributes:
        task: name of a task.
        levels: levels of disturbance; default: the task's own.
        offline_pairs: state-action pairs that are cloned; default: the task's own.
        observation: what is cloned from: "state" or "images", the latter as in table 3.3.
        episodes: robots, one episode each.
        seed: root seed; one that no comparison uses.
        threads: physics threads.
        results: file to which the measurements are added.
    """

    task: Positional[str]
    levels: tuple[str, ...] = ()
    offline_pairs: int | None = None
    observation: Literal["state", "images"] = "state"
    episodes: int = 100
    seed: int = 100
    threads: int | None = None
    results: Path = Path("results/levels.json")


def suits(expert_success: float, cloned_success: float) -> bool:
    """The rule: the expert succeeds in more than 90 % of the episodes, behaviour cloning in less than 20 %.

    Args:
        expert_success: fraction of episodes, 0 to 1: help is possible.
        cloned_success: likewise, of the policy with which a run begins: help is needed.
    """
    return expert_success > 0.9 and cloned_success < 0.2


def behaviour_cloning(config: LevelsConfig, level: str) -> dict[str, float]:
    """Success and survival of the policy with which a run begins, over one episode on each robot."""
    learner = SETTINGS["table-3.3"].learner if config.observation == "images" else LearnerConfig()
    run = RunConfig(
        config.task,
        priority="C.",
        observation=config.observation,
        learner=learner,
        disturbance=level,
        offline_pairs=config.offline_pairs,
        robots=config.episodes,
        humans=1,
        seed=config.seed,
        threads=config.threads,
        torch_threads=1,
    )
    assembly = prepare(assemble(run))
    fleet, policy = assembly.fleet, assembly.policy
    episodes = rollout(fleet, policy, derive(config.seed, "levels") % 2**32)
    fleet.close()
    return {"success": float(episodes.succeeded.mean()), "survived": float(episodes.survived.mean())}


def measure(config: LevelsConfig) -> list[dict[str, object]]:
    """Expert and behaviour cloning at each level."""
    actor, _ = experts.load(config.task)
    rows: list[dict[str, object]] = []
    own = TASKS[config.task]
    pairs = config.offline_pairs or own.offline_pairs
    for level in config.levels or (own.disturbance,):
        expert = experts.evaluate(actor, config.task, level, config.episodes, config.seed, config.threads)
        cloned = behaviour_cloning(config, level)
        fits = suits(expert.success, cloned["success"])
        rows.append(
            {
                "level": level,
                "chosen": (level, pairs) == (own.disturbance, own.offline_pairs),
                "expert_success": expert.success,
                "expert_return": round(expert.mean, 1),
                "bc_success": cloned["success"],
                "bc_survived": cloned["survived"],
                "offline_pairs": pairs,
                **({"observation": "images"} if config.observation == "images" else {}),
                "episodes": config.episodes,
                "seed": config.seed,
                "suits": fits,
            }
        )
        print(
            f"{config.task} at {level}: the expert succeeds in {expert.success:.0%}, behaviour cloning in "
            f"{cloned['success']:.0%} (survives {cloned['survived']:.0%}): "
            f"{'suits' if fits else 'does not suit'} a comparison",
            flush=True,
        )
    return rows


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of `python -m tutelage.experiments.levels`."""
    config = tyro.cli(LevelsConfig, args=args, description=__doc__)
    known = json.loads(config.results.read_text()) if config.results.exists() else {}
    new = measure(config)
    rows = {(row["level"], row["offline_pairs"], row.get("observation")): row for row in [*known.get(config.task, []), *new]}
    known[config.task] = list(rows.values())
    write_atomic(config.results, (json.dumps(known, indent=1, sort_keys=True) + "\n").encode())


if __name__ == "__main__":
    main()
