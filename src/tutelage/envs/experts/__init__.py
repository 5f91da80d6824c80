"""The shipped controllers that act as algorithmic supervisors, and what each scored.

A controller is called an expert only if its mean return reaches the published expert's (see `PUBLISHED`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.errors import ConfigError, ContractError
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
        success: fraction that also reach `SUCCESS_FRACTION` of the mean.
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
    """The file of the shipped controller of a task."""
    return Path(__file__).parent / f"{task}.safetensors"


def load(task: str, path: Path | None = None) -> tuple[GaussianActor, dict[str, Any]]:
    """The controller of a task, and its card.

    Raises:
        ConfigError: none is shipped for the task.
        ContractError: the file at `path` is for another task.
    """
    path = path or path_of(task)
    if not path.exists():
        raise ConfigError(f"no expert at {path}; train one with: tutelage train-expert {task}")
    actor, card = GaussianActor.load(path)
    if card.get("task") != task:
        raise ContractError(f"{path} is a controller for {card.get('task')}, not for {task}")
    return actor, card


def is_expert(card: dict[str, Any]) -> bool:
    """Whether the controller reaches the published expert's return, undisturbed."""
    return float(card["scores"]["none"]["mean"]) >= PUBLISHED.get(card["task"], np.inf)


def evaluate(
    actor: GaussianActor, task: str, level: str, episodes: int = 100, seed: int = 1_000_000, threads: int | None = None
) -> Score:
    """Run a controller for one episode on each of `episodes` robots. The seed is one that no training uses."""
    fleet = MujocoFleet(task, episodes, disturbance=level, threads=threads)
    obs, info = fleet.reset(seed=derive(seed, f"evaluate expert/{level}") % 2**32)
    for _ in range(fleet.horizon):
        obs, _, _, _, info = fleet.step(actor.act(obs))
        if info["violation"].all():
            break
    fleet.close()
    total, survived = info["return"], ~info["violation"]
    mean = float(total.mean())
    success = survived & (total >= SUCCESS_FRACTION * mean)
    return Score(level, mean, float(total.std()), float(survived.mean()), float(success.mean()), episodes, seed)


def success_return(task: str, level: str, path: Path | None = None, threads: int | None = None) -> float:
    """The return that makes an episode a success: from the card, or measured now for a level that is not on it."""
    actor, card = load(task, path)
    known = card.get("scores", {}).get(level)
    mean = known["mean"] if known else evaluate(actor, task, level, threads=threads).mean
    return SUCCESS_FRACTION * float(mean)
