"""Interactive imitation learning: dataset aggregation, an update schedule, and the critics beside it (eq. 5.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from tutelage.errors import ConfigError
from tutelage.fleet.modes import MOVING, Mode
from tutelage.fleet.step import Step
from tutelage.learning.classifier import DiscrepancyClassifier
from tutelage.learning.critic import Critic
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.optimiser import adam, load_optimiser_state, optimiser_state
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
        self.optimiser = adam(policy.parameters(), config.learning_rate)
        self.restarts, self._episode_ended = 0, False

    def gradient_steps(self, n: int) -> float:
        """n gradient steps of behaviour cloning on all data so far; returns the last loss, mean over members."""
        loss = torch.zeros(())
        for _ in range(n):
            obs, actions = self.dataset.batches(self.config.batch)
            loss = self.policy.loss(obs, actions)
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self.optimiser.step()
        self.policy.forget()
        return float(loss.detach()) / self.policy.members

    def restart(self) -> None:
        """New initial weights and a new optimiser; the data stay."""
        self.restarts += 1
        self.policy.restart(derive(self.seed, f"policy/restart {self.restarts}"))
        self.optimiser = adam(self.policy.parameters(), self.config.learning_rate)

    # -- the Learner of the loop --------------------------------------------------------------------------------

    def record(self, step: Step) -> None:
        """Human actions into the dataset; every transition into the critics."""
        human = step.mode == Mode.TELEOPERATED
        if human.any():
            self.dataset.add(step.obs[human], step.wanted[human])
        self._episode_ended = bool((step.truncated | step.success | step.violation)[MOVING[step.mode]].any())
        if self.critics:
            moved = MOVING[step.mode]
            obs, action, after = step.obs[moved], step.actions[moved], step.next_obs[moved]
            violation, success = step.violation[moved], step.success[moved]
            for name, critic in self.critics.items():
                event = violation if name == "risk" else success
                critic.add(obs, action, after, event, end=violation | (success & ~step.truncated[moved]))

    def update(self, t: int) -> dict[str, float]:
        """What is due at timestep t."""
        if self.config.precision == "float32":
            return self._update(t)
        torch.set_float32_matmul_precision("medium")  # of this process, so only while nothing else computes
        try:
            return self._update(t)
        finally:
            torch.set_float32_matmul_precision("highest")

    def _update(self, t: int) -> dict[str, float]:
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
        for name, critic in self.critics.items():
            if c.schedule != "never" and (t + 1) % critic.config.every == 0:
                losses[name] = critic.update()
        return {name: loss for name, loss in losses.items() if np.isfinite(loss)}

    def state_dict(self) -> dict[str, Any]:
        return {
            "policy": module_state(self.policy),
            "adam": optimiser_state(self.optimiser),
            "dataset": self.dataset.state_dict(),
            "critics": {name: critic.state_dict() for name, critic in self.critics.items()},
            **({"classifier": self.classifier.state_dict()} if self.classifier else {}),
            "restarts": self.restarts,
            "episode_ended": self._episode_ended,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        load_module_state(self.policy, state["policy"])
        self.policy.forget()
        load_optimiser_state(self.optimiser, state["adam"])
        self.dataset.load_state_dict(state["dataset"])
        for name, critic in self.critics.items():
            critic.load_state_dict(state["critics"][name])
        if self.classifier:
            self.classifier.load_state_dict(state["classifier"])
        self.restarts, self._episode_ended = state["restarts"], state["episode_ended"]
