"""`tutelage train-expert`: an algorithmic supervisor by PPO on the batched engine, resumable, with an honest score."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from tutelage.cores import default_torch_threads
from tutelage.envs import experts
from tutelage.envs.mujoco_fleet import MujocoFleet
from tutelage.envs.tasks import TASKS
from tutelage.errors import ConfigError
from tutelage.experiments.config import ExpertConfig
from tutelage.experiments.recording import lock
from tutelage.learning.ppo import PPO
from tutelage.policies.expert import GaussianActor
from tutelage.store import load_tree


def train(config: ExpertConfig, say: Callable[[str], None] = print) -> Path:
    """Train, score and save a controller; returns the path of its weights."""
    torch.set_num_threads(config.torch_threads or default_torch_threads())
    out = config.out or Path("runs") / f"expert-{config.task}"
    program = TASKS[config.task].expert if config.task in TASKS else None
    if program:
        raise ConfigError(f"the expert of {config.task} is a program, {program}: nothing to train")
    fleet = MujocoFleet(config.task, config.robots, disturbance=config.disturbance, threads=config.threads)
    level = config.disturbance or fleet.task.disturbance
    ppo = PPO(fleet, fleet.task.expert_features or fleet.single_observation_space.shape[0], config.ppo, config.seed)  # type: ignore[index]
    with lock(out):  # refused before minutes of training
        checkpoint, best_path, best = out / "ppo.safetensors", out / "best.safetensors", float("-inf")
        if checkpoint.exists():
            ppo.load(checkpoint)
            best = float(load_tree(best_path)["card"]["selection"]) if best_path.exists() else best
            say(f"continuing at {ppo.steps:,} of {config.steps:,} steps")
        began, first, evaluated = time.monotonic(), ppo.steps, ppo.steps
        while ppo.steps < config.steps:
            progress = ppo.iterate()
            if ppo.steps - evaluated < config.evaluate_every and ppo.steps < config.steps:
                continue
            evaluated = ppo.steps
            # Chosen on its own seed: the final score must not be the luckiest of many looks at the same episodes.
            score = experts.evaluate(ppo.actor, config.task, level, episodes=50, seed=2_000_000, threads=config.threads)
            rate = (ppo.steps - first) / (time.monotonic() - began)
            eta = (config.steps - ppo.steps) / rate / 60
            say(
                f"{ppo.steps:>11,} steps  return {score.mean:7.0f} +- {score.sd:5.0f}  survived {score.survived:4.0%}  "
                f"kl {progress['kl']:.4f}  lr {progress['learning_rate']:.1e}  {rate:,.0f} steps/s  ETA {eta:.0f} min"
            )
            if score.mean > best:
                best = score.mean
                ppo.actor.save(best_path, {"task": config.task, "steps": ppo.steps, "selection": best})
            ppo.save(checkpoint)
        fleet.close()
        return finish(config, level, best_path, say)


def finish(config: ExpertConfig, level: str, best_path: Path, say: Callable[[str], None] = print) -> Path:
    """Score the best policy over 100 episodes on a seed that nothing was chosen on, and write its card."""
    actor, card = GaussianActor.load(best_path)
    scores = {
        name: dataclasses.asdict(experts.evaluate(actor, config.task, name, threads=config.threads))
        for name in dict.fromkeys(["none", level])
    }
    card = {
        "task": config.task,
        "command": " ".join(["tutelage", *sys.argv[1:]]),
        "seed": config.seed,
        "steps": card["steps"],
        "trained_at": level,
        "scores": scores,
    }
    path = best_path.with_name(f"{config.task}.safetensors")
    actor.save(path, card)
    for s in scores.values():
        say(
            f"{config.task} at {s['level']}: {s['mean']:.0f} +- {s['sd']:.0f}, survived {s['survived']:.0%}, "
            f"success {s['success']:.0%}, {s['episodes']} episodes"
        )
    published = experts.PUBLISHED.get(config.task)
    if published and not experts.is_expert(card):
        say(f"short of the published expert ({published:.0f}): train longer before you call it one")
    say(f"weights: {path}")
    return path
