"""Proximal policy optimisation: how the algorithmic supervisors were trained.

Short on purpose: one class, one file. Observations and returns are normalised by running statistics, timeouts are
bootstrapped (they are not failures), and the learning rate follows the KL divergence of each update.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tutelage.errors import ConfigError, ContractError
from tutelage.fleet.fleet import Fleet
from tutelage.learning.optimiser import load_optimiser_state, optimiser_state
from tutelage.policies.expert import GaussianActor, tanh_mlp
from tutelage.policies.weights import load_module_state, module_state
from tutelage.seeding import derive, rng_state, set_rng_state, stream
from tutelage.store import load_tree, save_tree

Array = NDArray[Any]


@dataclass(frozen=True)
class PPOConfig:
    """Hyper-parameters.

    Attributes:
        rollout: timesteps of each robot between updates.
        epochs: passes over the rollout at each update.
        minibatch: transitions in a gradient step.
        gamma: discount.
        lam: lambda of generalised advantage estimation.
        clip: clipping range of the probability ratio.
        target_kl: the learning rate is adapted to keep the KL divergence of an update near this; an update
            stops at twice as much.
        learning_rate: initial learning rate of Adam.
        max_grad_norm: gradients are scaled down to this norm.
        entropy: weight of the entropy bonus.
        fall_penalty: subtracted from the reward of a step that ends in violation, for a safer gait; scores never
            include it.
        hidden: widths of the hidden layers of actor and critic.
    """

    rollout: int = 64
    epochs: int = 5
    minibatch: int = 1024
    gamma: float = 0.99
    lam: float = 0.95
    clip: float = 0.2
    target_kl: float = 0.012
    learning_rate: float = 3e-4
    max_grad_norm: float = 1.0
    entropy: float = 0.0
    fall_penalty: float = 0.0
    hidden: tuple[int, ...] = (256, 128)

    def __post_init__(self) -> None:
        if min(self.rollout, self.epochs, self.minibatch, *self.hidden) < 1:
            raise ConfigError("PPO needs rollout, epochs, minibatch and hidden widths of at least 1")
        if not (0 <= self.gamma <= 1 and 0 <= self.lam <= 1 and self.learning_rate > 0 and self.target_kl > 0):
            raise ConfigError("PPO needs gamma and lam in [0, 1], learning_rate > 0 and target_kl > 0")


class RunningMoments:
    """Mean and variance of everything seen so far, merged batch by batch (Chan et al.)."""

    def __init__(self, width: int) -> None:
        self.count, self.mean, self.m2 = 1e-4, np.zeros(width), np.full(width, 1e-4)

    def update(self, x: Array) -> None:
        """x: (n, width)."""
        n, mean = len(x), x.mean(axis=0)
        delta, total = mean - self.mean, self.count + n
        self.m2 = self.m2 + np.square(x - mean).sum(axis=0) + np.square(delta) * self.count * n / total
        self.mean, self.count = self.mean + delta * n / total, total

    @property
    def std(self) -> Array:
        """(width,) standard deviation, at least 1e-3."""
        return np.sqrt(self.m2 / self.count).clip(1e-3)


class PPO:
    """Trains a `GaussianActor` on a fleet.

    Args:
        fleet: any fleet; violations end an episode, the horizon truncates it.
        features: how many leading numbers of an observation actor and critic see.
        seed: root seed.
    """

    def __init__(self, fleet: Fleet, features: int, config: PPOConfig, seed: int) -> None:
        self.fleet, self.config, self.features = fleet, config, features
        torch.manual_seed(derive(seed, "ppo/initial weights"))
        self.actor = GaussianActor(features, fleet.action_low, fleet.action_high, config.hidden)
        self.critic = tanh_mlp(features, 1, config.hidden, last_gain=1.0)
        self.parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.learning_rate = config.learning_rate
        self.optimiser = torch.optim.Adam(self.parameters, lr=self.learning_rate, eps=1e-5)
        self.rng = stream(seed, "ppo/noise")
        self.obs_moments, self.return_moments = RunningMoments(features), RunningMoments(1)
        self.steps = 0
        self._discounted = np.zeros(fleet.num_envs)
        self._obs, _ = fleet.reset(seed=derive(seed, "ppo/fleet") % 2**32)
        self._returns = np.zeros(fleet.num_envs)
        self.finished: list[tuple[float, float]] = []
        """(return, survived) of the episodes that ended in the last rollout."""

    def iterate(self) -> dict[str, float]:
        """One rollout and one update; returns what happened, by name."""
        batch = self._collect()
        return {"steps": self.steps, **self._update(**batch)}

    @torch.no_grad()
    def _collect(self) -> dict[str, Tensor]:
        c, n = self.config, self.fleet.num_envs
        xs, us, log_probs, rewards, values, nexts, ends = [], [], [], [], [], [], []
        raw = []
        self.finished = []
        for _ in range(c.rollout):
            x = self.actor.normalise(self._obs)
            mean = self.actor.net(x)
            noise = torch.from_numpy(self.rng.standard_normal(mean.shape, dtype=np.float32))
            u = mean + self.actor.log_std.exp() * noise
            raw.append(self._obs[:, : self.features].copy())
            obs, reward, terminated, truncated, _ = self.fleet.step(self.actor.to_action(u))
            self._returns += reward
            reward = reward - c.fall_penalty * terminated
            after = self.actor.normalise(obs)
            done = terminated | truncated
            self._discounted = self._discounted * c.gamma + reward
            self.return_moments.update(self._discounted[:, None])
            self._discounted[done] = 0.0
            if done.any():
                self.finished += list(zip(self._returns[done].tolist(), truncated[done].astype(float).tolist(), strict=True))
                self._returns[done] = 0.0
                obs, _ = self.fleet.reset(options={"reset_mask": done})
            self._obs = obs
            xs.append(x)
            us.append(u)
            log_probs.append(self.actor.log_prob(mean, u))
            rewards.append(torch.from_numpy(reward / self.return_moments.std).float())
            values.append(self.critic(x)[:, 0])
            nexts.append(torch.where(torch.from_numpy(terminated), 0.0, self.critic(after)[:, 0]))
            ends.append(torch.from_numpy(done).float())
        self.steps += n * c.rollout
        self.obs_moments.update(np.concatenate(raw))

        advantage, running = [torch.zeros(n)] * c.rollout, torch.zeros(n)
        for t in reversed(range(c.rollout)):
            delta = rewards[t] + c.gamma * nexts[t] - values[t]
            running = delta + c.gamma * c.lam * (1 - ends[t]) * running
            advantage[t] = running
        a = torch.cat(advantage)
        return {
            "x": torch.cat(xs), "u": torch.cat(us), "log_prob": torch.cat(log_probs),
            "target": a + torch.cat(values), "advantage": (a - a.mean()) / (a.std() + 1e-8),
        }  # fmt: skip

    def _update(self, x: Tensor, u: Tensor, log_prob: Tensor, target: Tensor, advantage: Tensor) -> dict[str, float]:
        c = self.config
        for _ in range(c.epochs):
            kls: list[float] = []
            for index in torch.from_numpy(self.rng.permutation(len(x))).split(c.minibatch):
                mean = self.actor.net(x[index])
                log_ratio = self.actor.log_prob(mean, u[index]) - log_prob[index]
                ratio, a = log_ratio.exp(), advantage[index]
                surrogate = torch.minimum(ratio * a, ratio.clamp(1 - c.clip, 1 + c.clip) * a).mean()
                value_loss = (self.critic(x[index])[:, 0] - target[index]).square().mean()
                loss = -surrogate + 0.5 * value_loss - c.entropy * self.actor.log_std.sum()
                kls.append(float((ratio - 1 - log_ratio).mean().detach()))
                self.optimiser.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.parameters, c.max_grad_norm)
                self.optimiser.step()
            kl = float(np.mean(kls))
            if kl > 2 * c.target_kl:
                break
        self._adapt(kl)
        with torch.no_grad():
            self.actor.obs_mean.copy_(torch.from_numpy(self.obs_moments.mean))
            self.actor.obs_std.copy_(torch.from_numpy(self.obs_moments.std))
        returns = [r for r, _ in self.finished] or [float("nan")]
        return {
            "return": float(np.mean(returns)),
            "survived": float(np.mean([s for _, s in self.finished] or [float("nan")])),
            "kl": kl,
            "learning_rate": self.learning_rate,
            "std": float(self.actor.log_std.detach().exp().mean()),
        }

    def _adapt(self, kl: float) -> None:
        """Move the learning rate so that the last pass over a rollout ends near the target divergence."""
        if kl > 1.5 * self.config.target_kl:
            self.learning_rate = max(self.learning_rate / 1.3, 3e-5)
        elif kl < self.config.target_kl / 1.5:
            self.learning_rate = min(self.learning_rate * 1.1, 1e-3)
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate

    # -- resume -------------------------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        """Write everything needed to go on: weights, optimiser, statistics, random state, physics."""
        save_tree(
            path,
            {
                "config": asdict(self.config),
                "steps": self.steps,
                "learning_rate": self.learning_rate,
                "actor": module_state(self.actor),
                "critic": module_state(self.critic),
                "adam": optimiser_state(self.optimiser),
                "moments": {
                    name: {"count": m.count, "mean": m.mean, "m2": m.m2}
                    for name, m in (("obs", self.obs_moments), ("return", self.return_moments))
                },
                "rng": rng_state(self.rng),
                "fleet": self.fleet.state_dict(),
                "discounted": self._discounted,
                "returns": self._returns,
            },
        )

    def load(self, path: Path) -> None:
        """Go on from what `save` wrote.

        Raises:
            ContractError: it was written by another fleet, or with other networks.
        """
        try:
            self._restore(load_tree(path))
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError, ContractError):
            raise ContractError(f"{path} does not fit this fleet and these settings; use those that wrote it") from None

    def _restore(self, tree: dict[str, Any]) -> None:
        self.steps, self.learning_rate = tree["steps"], tree["learning_rate"]
        load_module_state(self.actor, tree["actor"])
        load_module_state(self.critic, tree["critic"])
        load_optimiser_state(self.optimiser, tree["adam"])
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate
        for name, m in (("obs", self.obs_moments), ("return", self.return_moments)):
            saved = tree["moments"][name]
            m.count, m.mean, m.m2 = saved["count"], saved["mean"], saved["m2"]
        set_rng_state(self.rng, tree["rng"])
        self.fleet.load_state_dict(tree["fleet"])
        self._obs = tree["fleet"]["obs"]
        self._discounted, self._returns = tree["discounted"], tree["returns"]
