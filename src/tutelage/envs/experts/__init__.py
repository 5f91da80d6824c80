"""The shipped controllers that act as algorithmic supervisors, and what each scored.

A controller is a file of trained weights, or a program that the task names (its attribute `expert`). One with weights is
called an expert only if its mean return reaches the published expert's (see `PUBLISHED`). The scores of a program are
measured by

    python -m tutelage.envs.experts.score PegInsertion
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tutelage.envs.registry import ON_EXTRAS, find_task, make_fleet
from tutelage.envs.rollout import rollout
from tutelage.envs.task_fleet import TaskFleet
from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.policy import Policy
from tutelage.objects import make_object
from tutelage.policies.expert import GaussianActor
from tutelage.seeding import derive

PUBLISHED = {"HalfCheetah": 5331.0, "Walker2d": 3492.0, "Ant": 4493.0, "Humanoid": 6000.0}
"""Return of the dissertation's experts (table A.1; the success threshold of chapter 5 for Humanoid)."""

SUCCESS_FRACTION = 0.95
"""An episode is a success when its return reaches this fraction of the expert's (section 5.6)."""


@dataclass(frozen=True)
class Score:
    """What a controller does in 100 episodes at one level of disturbance.

    Attributes:
        level: name of the disturbance.
        mean, sd: of the return over episodes; a fall ends an episode.
        survived: fraction of episodes without violation.
        success: fraction that also reach `SUCCESS_FRACTION` of the mean, or the goal of a task that has one.
        episodes: how many.
        seed: root seed of the evaluation.
    """

    level: str
    mean: float
    sd: float
    survived: float
    success: float
    episodes: int
    seed: int


def path_of(task: str) -> Path:
    """The file of the shipped controller of a task: weights, or the scores of a program."""
    return Path(__file__).parent / f"{task}.{'json' if program_of(task) else 'safetensors'}"


def program_of(task: str) -> str | None:
    """The program ("module:callable") that is the task's expert, if it has one.

    Raises:
        ConfigError: an unknown task.
    """
    program: str | None = getattr(find_task(task), "expert", None)
    return program


def load(task: str, path: Path | None = None) -> tuple[Policy, dict[str, Any]]:
    """The controller of a task, and its card (without scores where nobody measured them).

    Raises:
        ConfigError: none is shipped for the task.
        ContractError: the file at `path` is for another task.
    """
    program = program_of(task)
    if path is None and program:
        scores = path_of(task)
        card = json.loads(scores.read_text()) if scores.exists() else {"task": task, "scores": {}}
        return run_program(program), card
    if path is None and ":" in task:
        raise ConfigError(
            f"{task} has no expert: give what makes it an attribute `expert`, or name one: "
            "tutelage run --expert module:callable"
        )
    path = path or path_of(task)
    if not path.exists():
        raise ConfigError(f"no expert at {path}; train one with: tutelage train-expert {task}")
    actor, card = GaussianActor.load(path)
    if card.get("task") != task:
        raise ContractError(f"{path} is a controller for {card.get('task')}, not for {task}")
    return actor, card


def run_program(name: str) -> Policy:
    """The policy that "module:callable" makes.

    Raises:
        ConfigError: no such callable.
        ContractError: it does not make a policy.
    """
    policy = make_object(name, "expert")
    if not isinstance(policy, Policy):
        raise ContractError(f"expert {name!r} must return a policy with act(obs), got {type(policy).__name__}")
    return policy


def is_expert(card: dict[str, Any]) -> bool:
    """Whether the controller reaches the published expert's return, undisturbed."""
    return float(card["scores"]["none"]["mean"]) >= PUBLISHED.get(card["task"], np.inf)


def evaluate(
    actor: Policy, task: str, level: str, episodes: int = 100, seed: int = 1_000_000, threads: int | None = None
) -> Score:
    """Run a controller for one episode on each of `episodes` robots. The seed is one that no training uses.

    Raises:
        ConfigError: a level that the task does not know; one on an extra knows "none".
    """
    has_levels = not (level == "none" and task in ON_EXTRAS)
    fleet = make_fleet(task, episodes, disturbance=level if has_levels else None, threads=threads)
    if has_levels and not isinstance(fleet, TaskFleet):
        raise ConfigError(f"{task} has no levels of disturbance to score an expert at")
    episodes_of = rollout(fleet, actor, derive(seed, f"evaluate expert/{level}") % 2**32)
    fleet.close()
    total, survived = episodes_of.returns, episodes_of.survived
    mean = float(total.mean())
    success = episodes_of.succeeded if fleet.goal_conditioned else survived & (total >= SUCCESS_FRACTION * mean)
    return Score(level, mean, float(total.std()), float(survived.mean()), float(success.mean()), episodes, seed)


def success_return(task: str, level: str, path: Path | None = None, threads: int | None = None) -> float:
    """The return that makes an episode a success: from the card, or measured now for a level that is not on it."""
    actor, card = load(task, path)
    known = card.get("scores", {}).get(level)
    mean = known["mean"] if known else evaluate(actor, task, level, threads=threads).mean
    return SUCCESS_FRACTION * float(mean)
