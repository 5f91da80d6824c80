"""Test rollouts between epochs: the policy as it is, without interventions and without learning (section 2.6)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from tutelage.envs.registry import make_fleet
from tutelage.experiments.config import RunConfig
from tutelage.fleet.loop import Loop
from tutelage.fleet.policy import Policy
from tutelage.fleet.step import Step
from tutelage.seeding import derive
from tutelage.store import write_atomic


def rollout(config: RunConfig, policy: Policy, episodes: int, name: str) -> dict[str, Any]:
    """One episode of the policy on each of some robots of the run's task; a fall ends an episode.

    Args:
        config: task, disturbance and seed are taken from it.
        policy: acts for all robots.
        episodes: how many, side by side.
        name: of the random stream.

    Returns:
        return_mean, return_sd (over episodes), survived and succeeded (fractions).
    """
    fleet = make_fleet(config.task, episodes, disturbance=config.disturbance, threads=config.threads)
    obs, info = fleet.reset(seed=derive(config.seed, name) % 2**32)
    total, running = np.zeros(episodes), np.ones(episodes, dtype=bool)
    succeeded = np.zeros(episodes, dtype=bool)
    for _ in range(fleet.horizon):
        obs, reward, _, truncated, info = fleet.step(policy.act(obs))
        total += np.where(running, reward, 0.0)
        succeeded |= running & info["success"] & ~info["violation"]
        running &= ~(info["violation"] | info["success"] | truncated)
        if not running.any():
            break
    survived = float((~info["violation"]).mean())
    fleet.close()
    return {
        "return_mean": float(total.mean()), "return_sd": float(total.std()), "survived": survived,
        "succeeded": float(succeeded.mean()),
    }  # fmt: skip


class TestRollouts:
    """Rolls the policy out before the run and after each epoch; keeps the scores in `rollouts.json` of the run folder.

    Args:
        folder: the run folder.
        config: of the run.
        every: timesteps of an epoch.
        episodes: of a test.
    """

    __test__ = False  # pytest: this is no test

    def __init__(self, folder: Path, config: RunConfig, every: int, episodes: int = 10) -> None:
        self.path, self.config, self.every, self.episodes = folder / "rollouts.json", config, every, episodes
        self.scores: dict[str, dict[str, Any]] = json.loads(self.path.read_text()) if self.path.exists() else {}

    def on_start(self, loop: Loop) -> None:
        self._test(loop)

    def on_step(self, loop: Loop, step: Step) -> None:
        self._test(loop)

    def on_end(self, loop: Loop) -> None:
        pass

    def _test(self, loop: Loop) -> None:
        epoch, rest = divmod(loop.t, self.every)
        if rest == 0:
            # A resumed run tests an epoch again where it was interrupted, on the same stream: the same numbers.
            self.scores[str(epoch)] = rollout(self.config, loop.policy, self.episodes, f"test rollouts/{epoch}")
            write_atomic(self.path, json.dumps(self.scores, indent=1).encode())
