"""Measure what a program scores over 100 episodes, in calm and at the task's level, and write it beside the weights.

python -m tutelage.envs.experts.score PegInsertion
"""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import tyro
from tyro.conf import Positional

from tutelage.envs import experts
from tutelage.envs.registry import ON_EXTRAS
from tutelage.envs.tasks import TASKS
from tutelage.errors import ConfigError
from tutelage.store import write_atomic


def measure(task: Positional[str], episodes: int = 100, threads: int | None = None) -> None:
    """Score the program that is the expert of a task of ours.

    Args:
        task: its name.
        episodes: how many at each level.
        threads: physics threads; default: all cores.
    """
    if task not in {*TASKS, *ON_EXTRAS} or not experts.program_of(task):
        raise ConfigError(f"no program is the expert of {task}; weights carry their scores themselves")
    actor, _ = experts.load(task)
    scores: dict[str, Any] = {}
    for level in dict.fromkeys(["none", TASKS[task].disturbance if task in TASKS else "none"]):
        scores[level] = dataclasses.asdict(experts.evaluate(actor, task, level, episodes, threads=threads))
        print(f"{task} at {level}: success {scores[level]['success']:.0%} of {episodes} episodes", flush=True)
    write_atomic(experts.path_of(task), (json.dumps({"task": task, "scores": scores}, indent=1) + "\n").encode())


if __name__ == "__main__":
    tyro.cli(measure)
