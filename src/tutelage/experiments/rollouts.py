"""Test rollouts between epochs: the policy as it is, without interventions and without learning (section 2.6)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tutelage.envs.rollout import rollout
from tutelage.envs.task_fleet import TaskFleet
from tutelage.experiments.assemble import fleet_of
from tutelage.experiments.config import RunConfig
from tutelage.fleet.loop import Loop
from tutelage.fleet.step import Step
from tutelage.seeding import derive
from tutelage.store import write_atomic


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
            self.scores[str(epoch)] = self._score(loop, derive(self.config.seed, f"test rollouts/{epoch}") % 2**32)
            write_atomic(self.path, json.dumps(self.scores, indent=1).encode())

    def _score(self, loop: Loop, seed: int) -> dict[str, float]:
        c = self.config
        rule = {"success_return": loop.fleet.success_return} if isinstance(loop.fleet, TaskFleet) else {}
        fleet = fleet_of(c, self.episodes, c.disturbance, **rule)
        episodes = rollout(fleet, loop.policy, seed)
        fleet.close()
        return {
            "return_mean": float(episodes.returns.mean()),
            "return_sd": float(episodes.returns.std()),
            "survived": float(episodes.survived.mean()),
            "succeeded": float(episodes.succeeded.mean()),
        }
