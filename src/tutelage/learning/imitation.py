"""Interactive imitation learning: dataset aggregation, an update schedule, and the critics beside it (eq. 5.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tutelage.errors import ConfigError
from tutelage.fleet.step import Step
from tutelage.learning.classifier import DiscrepancyClassifier
from tutelage.learning.critic import Critic
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.regression import regression
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
    """

    schedule: Literal["step", "episode", "scratch", "never"] = "step"
    every: int = 1
    gradient_steps: int = 1
    batch: int = 256
    learning_rate: float = 3e-4
    pretrain: int = 1000

    def __post_init__(self) -> None:
        if self.schedule not in ("step", "episode", "scratch", "never"):
            raise ConfigError(f"unknown schedule {self.schedule!r}: use step, episode, scratch or never")
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
        self.regression = regression(policy, config.learning_rate)
        self.restarts, self._episode_ended = 0, False
        self._heard: int | None = None
        """The timestep whose human data are in the dataset already."""
        self._begun = False
        """Whether the first gradient step of an update has begun and has not ended."""

    def gradient_steps(self, n: int) -> float:
        """n gradient steps of behaviour cloning on all data so far; returns the last loss, mean over members."""
        loss = 0.0
        for k in range(n):
            if k or not self._begun:
                self.regression.begin(self.dataset, self.config.batch)
            loss = self.regression.end()
        self._begun = False
        self.policy.forget()
        return loss

    def restart(self) -> None:
        """New initial weights and a new optimiser; the data stay."""
        self.restarts += 1
        self.policy.restart(derive(self.seed, f"policy/restart {self.restarts}"))
        self.regression = regression(self.policy, self.config.learning_rate)

    # -- the Learner of the loop --------------------------------------------------------------------------------

    def hear(self, t: int, obs: Array, wanted: Array) -> None:
        """Human actions into the dataset, before their outcome is known."""
        self._heard = t
        self._add(obs, wanted)

    def begin(self, t: int) -> None:
        """Start what is due of the policy at timestep t, if that goes on from its present weights; `update` ends it."""
        self._settle()
        if self.config.schedule == "step":
            self._begin_if_due(t)

    def record(self, step: Step) -> None:
        """Human actions into the dataset, unless they were heard; every transition into the critics."""
        if self._heard != step.t:
            self._add(step.obs[step.taught], step.wanted[step.taught])
        self._episode_ended = bool((step.truncated | step.success | step.violation)[step.moved].any())
        if self.critics:
            moved = slice(None) if step.moved.all() else step.moved  # of large observations, every copy counts
            obs, action, after = step.obs[moved], step.actions[moved], step.next_obs[moved]
            violation, success = step.violation[moved], step.success[moved]
            for name, critic in self.critics.items():
                event = violation if name == "risk" else success
                critic.add(obs, action, after, event, end=violation | (success & ~step.truncated[moved]))

    def update(self, t: int) -> dict[str, float]:
        """What is due at timestep t: the policy, the classifier, which follows it, and the critics, which ask it.

        If the policy's step began before humans were heard at t, critics learn beside it, and ask the policy of t.
        """
        if self._begun and self._heard != t:
            losses = self._update_critics(t)
            losses.update(self._update_policy())
        else:
            if not self._begun:
                self._begin_if_due(t)
            losses = self._update_policy() if self._begun else {}
            losses.update(self._update_critics(t))
        return {name: loss for name, loss in losses.items() if np.isfinite(loss)}

    def _update_policy(self) -> dict[str, float]:
        losses = {"policy": self.gradient_steps(self.config.gradient_steps)}
        if self.classifier:
            losses["classifier"] = self.classifier.updates(self.config.gradient_steps)
        return losses

    def _update_critics(self, t: int) -> dict[str, float]:
        if self.config.schedule == "never":
            return {}
        return {name: critic.update() for name, critic in self.critics.items() if (t + 1) % critic.config.every == 0}

    def _settle(self) -> None:
        """Wait for what began in a timestep that was given up before its end."""
        if self._begun:
            self.regression.end()
            self.policy.forget()
            self._begun = False

    def _begin_if_due(self, t: int) -> None:
        """Start the policy's first gradient step if it learns at timestep t."""
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
            self.regression.begin(self.dataset, c.batch)
            self._begun = True

    def _add(self, obs: Array, wanted: Array) -> None:
        if len(obs):
            self.dataset.add(obs, wanted)

    def state_dict(self) -> dict[str, Any]:
        return {
            "policy": module_state(self.policy),
            "adam": self.regression.state_dict(),
            "dataset": self.dataset.state_dict(),
            "critics": {name: critic.state_dict() for name, critic in self.critics.items()},
            **({"classifier": self.classifier.state_dict()} if self.classifier else {}),
            "restarts": self.restarts,
            "episode_ended": self._episode_ended,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._settle()
        load_module_state(self.policy, state["policy"])
        self.policy.forget()
        self.regression.load_state_dict(state["adam"])
        self.dataset.load_state_dict(state["dataset"])
        for name, critic in self.critics.items():
            critic.load_state_dict(state["critics"][name])
        if self.classifier:
            self.classifier.load_state_dict(state["classifier"])
        self.restarts, self._episode_ended = state["restarts"], state["episode_ended"]
        self._heard = None
