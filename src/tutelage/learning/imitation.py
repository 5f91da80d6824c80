"""Interactive imitation learning: dataset aggregation, an update schedule, and the critics beside it (eq. 5.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from tutelage.errors import ConfigError
from tutelage.fleet.step import Step
from tutelage.learning.classifier import DiscrepancyClassifier
from tutelage.learning.critic import Critic
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.descent import Descent
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.weights import load_module_state, module_state
from tutelage.seeding import derive

Array = NDArray[Any]


@dataclass(frozen=True)
class LearnerConfig:
    """How the policy is updated.

    Attributes:
        schedule: "step" (after every `every` timesteps), "episode" (after a timestep in which an episode ended),
            "scratch" (every `every` timesteps, from new initial weights), "never" (behaviour cloning).
        every: timesteps between updates.
        gradient_steps: gradient steps of an update.
        batch: pairs in a gradient step of a member.
        learning_rate: of Adam.
        pretrain: gradient steps of behaviour cloning on the offline data, before the run.
        precision: of the matrix products in updates during the run. "bfloat16" has 8 bits and sums in 32; it is faster on
            processors that have such products (AMX, AVX512-BF16) and changes nothing on others.
    """

    schedule: Literal["step", "episode", "scratch", "never"] = "step"
    every: int = 1
    gradient_steps: int = 1
    batch: int = 256
    learning_rate: float = 3e-4
    pretrain: int = 1000
    precision: Literal["float32", "bfloat16"] = "float32"

    def __post_init__(self) -> None:
        if self.schedule not in ("step", "episode", "scratch", "never"):
            raise ConfigError(f"unknown schedule {self.schedule!r}: use step, episode, scratch or never")
        if self.precision not in ("float32", "bfloat16"):
            raise ConfigError(f"unknown precision {self.precision!r}: use float32 or bfloat16")
        if min(self.every, self.gradient_steps, self.batch) < 1 or self.pretrain < 0 or not self.learning_rate > 0:
            raise ConfigError("learning needs every, gradient_steps and batch >= 1, pretrain >= 0 and learning_rate > 0")


class ImitationLearner:
    """Keeps what humans did, and trains the ensemble on it; keeps what happened, and trains the critics on that.

    Args:
        policy: the ensemble to improve.
        dataset: D, with the offline data already in it.
        config: the schedule.
        critics: by the name of the signal they estimate: "risk" or "goal".
        classifier: f of SafeDAgger, updated whenever the policy is.
        seed: root seed, for new initial weights.
    """

    def __init__(
        self,
        policy: EnsemblePolicy,
        dataset: AggregatedDataset,
        config: LearnerConfig,
        critics: dict[str, Critic] | None = None,
        classifier: DiscrepancyClassifier | None = None,
        seed: int = 0,
    ) -> None:
        self.policy, self.dataset, self.config, self.seed = policy, dataset, config, seed
        self.critics, self.classifier = critics or {}, classifier
        self.descent = Descent(policy.net, config.learning_rate)
        self.restarts, self._episode_ended = 0, False
        self._heard: int | None = None

    def gradient_steps(self, n: int) -> float:
        """n gradient steps of behaviour cloning on all data so far; returns the last loss, mean over members."""
        loss = 0.0
        for _ in range(n):
            obs, actions = self.dataset.batches(self.config.batch)
            loss = self.descent.step(self.policy.loss(obs, actions))
        self.policy.forget()
        return loss

    def restart(self) -> None:
        """New initial weights and a new optimiser; the data stay."""
        self.restarts += 1
        self.policy.restart(derive(self.seed, f"policy/restart {self.restarts}"))
        self.descent = Descent(self.policy.net, self.config.learning_rate)

    # -- the Learner of the loop --------------------------------------------------------------------------------

    def hear(self, t: int, obs: Array, wanted: Array) -> dict[str, float]:
        """Human actions into the dataset; the policy learns from them at once, unless its schedule waits for the outcome."""
        self._heard = t
        self._add(obs, wanted)
        return {} if self.config.schedule == "episode" else self._precisely(self._imitate, t)

    def record(self, step: Step) -> None:
        """Human actions into the dataset, unless they were heard; every transition into the critics."""
        if self._heard != step.t:
            self._add(step.obs[step.taught], step.wanted[step.taught])
        self._episode_ended = bool((step.truncated | step.success | step.violation)[step.moved].any())
        if self.critics:
            moved = step.moved
            obs, action, after = step.obs[moved], step.actions[moved], step.next_obs[moved]
            violation, success = step.violation[moved], step.success[moved]
            for name, critic in self.critics.items():
                event = violation if name == "risk" else success
                critic.add(obs, action, after, event, end=violation | (success & ~step.truncated[moved]))

    def update(self, t: int) -> dict[str, float]:
        """What is due at timestep t, less what `hear` did already."""
        return self._precisely(self._improve, t)

    def _add(self, obs: Array, wanted: Array) -> None:
        if len(obs):
            self.dataset.add(obs, wanted)

    def _precisely(self, work: Callable[[int], dict[str, float]], t: int) -> dict[str, float]:
        """Work at timestep t with matrix products of the precision that the configuration asks for."""
        if self.config.precision == "float32":
            return work(t)
        torch.set_float32_matmul_precision("medium")  # of this process, so only while nothing else computes
        try:
            return work(t)
        finally:
            torch.set_float32_matmul_precision("highest")

    def _improve(self, t: int) -> dict[str, float]:
        done = self._heard == t and self.config.schedule != "episode"
        losses = {} if done else self._imitate(t)
        for name, critic in self.critics.items():
            if self.config.schedule != "never" and (t + 1) % critic.config.every == 0:
                losses[name] = critic.update()
        return {name: loss for name, loss in losses.items() if np.isfinite(loss)}

    def _imitate(self, t: int) -> dict[str, float]:
        """The policy, and the classifier, which follows it."""
        losses: dict[str, float] = {}
        c = self.config
        due = {
            "step": (t + 1) % c.every == 0,
            "scratch": (t + 1) % c.every == 0,
            "episode": self._episode_ended,
            "never": False,
        }[c.schedule]
        if due and len(self.dataset):
            if c.schedule == "scratch":
                self.restart()
            losses["policy"] = self.gradient_steps(c.gradient_steps)
            if self.classifier:
                losses["classifier"] = self.classifier.updates(c.gradient_steps)
        return {name: loss for name, loss in losses.items() if np.isfinite(loss)}

    def state_dict(self) -> dict[str, Any]:
        return {
            "policy": module_state(self.policy),
            "adam": self.descent.state_dict(),
            "dataset": self.dataset.state_dict(),
            "critics": {name: critic.state_dict() for name, critic in self.critics.items()},
            **({"classifier": self.classifier.state_dict()} if self.classifier else {}),
            "restarts": self.restarts,
            "episode_ended": self._episode_ended,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        load_module_state(self.policy, state["policy"])
        self.policy.forget()
        self.descent.load_state_dict(state["adam"])
        self.dataset.load_state_dict(state["dataset"])
        for name, critic in self.critics.items():
            critic.load_state_dict(state["critics"][name])
        if self.classifier:
            self.classifier.load_state_dict(state["classifier"])
        self.restarts, self._episode_ended = state["restarts"], state["episode_ended"]
        self._heard = None
