"""Safety and goal critics: the discounted probability that something happens (appendix C.3; Recovery RL).

    Q(s, a) = E[ sum_k gamma^k 1{event at step k} ],   target: y = e + gamma (1 - e)(1 - end) Q'(s', pi(s'))

with twin networks, a slowly moving target Q', and batches in which a quarter of the transitions are events. A critic of a
bad event takes the larger twin everywhere (pessimistic), a critic of a good event the smaller one, in targets and in
queries alike. A timeout ends an episode, not the future: it is never terminal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tutelage.errors import ConfigError
from tutelage.fleet.policy import Policy
from tutelage.learning.optimiser import adam, load_optimiser_state, optimiser_state
from tutelage.policies.mlp import BatchedMLP
from tutelage.policies.weights import load_module_state, module_state
from tutelage.seeding import rng_state, set_rng_state

Array = NDArray[Any]


@dataclass(frozen=True)
class CriticConfig:
    """Hyper-parameters of a critic.

    Attributes:
        gamma: discount: an event k steps ahead counts gamma^k.
        tau: how far the target network moves towards the critic at each gradient step.
        learning_rate: of Adam.
        batch: transitions in a gradient step.
        positives: fraction of events in a batch, once there are any.
        hidden: widths of the hidden layers.
        capacity: transitions kept without an event, and a tenth as many with one; the oldest are overwritten.
        pretrain: gradient steps before the run (3000 in the dissertation).
        every: timesteps between gradient steps during the run.
    """

    gamma: float = 0.8
    tau: float = 0.005
    learning_rate: float = 3e-4
    batch: int = 256
    positives: float = 0.25
    hidden: tuple[int, ...] = (256, 256)
    capacity: int = 50_000
    pretrain: int = 3000
    every: int = 5

    def __post_init__(self) -> None:
        if not 0 <= self.gamma < 1:
            raise ConfigError(f"a critic's gamma must be in [0, 1), got {self.gamma}")
        if not 0 < self.tau <= 1 or not 0 < self.positives < 1 or self.batch < 2 or self.every < 1 or self.capacity < 10:
            raise ConfigError("a critic needs 0 < tau <= 1, 0 < positives < 1, batch >= 2, every >= 1, capacity >= 10")


class Ring:
    """The newest transitions: obs, action, next_obs, end."""

    def __init__(self, capacity: int, obs_width: int, action_width: int) -> None:
        self.capacity, self.size, self.cursor = capacity, 0, 0
        self.columns = {
            "obs": torch.zeros(0, obs_width),
            "action": torch.zeros(0, action_width),
            "next_obs": torch.zeros(0, obs_width),
            "end": torch.zeros(0),
        }

    def add(self, **rows: Array) -> None:
        """Append n transitions; memory grows up to the capacity, then the oldest give way."""
        n = len(rows["end"])
        if n > self.capacity:
            rows, n = {k: v[-self.capacity :] for k, v in rows.items()}, self.capacity
        room = len(self.columns["end"])
        if self.size + n > room and room < self.capacity:
            more = min(max(1024, 2 * room, self.size + n), self.capacity) - room
            self.columns = {k: torch.cat([c, c.new_zeros(more, *c.shape[1:])]) for k, c in self.columns.items()}
        room = len(self.columns["end"])
        index = torch.from_numpy((self.cursor + np.arange(n)) % room) if room else torch.zeros(0, dtype=torch.long)
        for name, column in self.columns.items():
            column[index] = torch.from_numpy(np.asarray(rows[name], dtype=np.float32))
        self.cursor = (self.cursor + n) % max(room, 1) if room == self.capacity else self.cursor + n
        self.size = min(self.size + n, room)

    def draw(self, n: int, rng: np.random.Generator) -> dict[str, Tensor]:
        """n transitions drawn uniformly with replacement."""
        index = torch.from_numpy(rng.integers(self.size, size=n))
        return {name: column[index] for name, column in self.columns.items()}

    def state_dict(self) -> dict[str, Any]:
        """The transitions and where the next one goes (copies: later transitions overwrite these rows)."""
        return {"cursor": self.cursor, "columns": {k: c[: self.size].numpy().copy() for k, c in self.columns.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.columns = {k: torch.from_numpy(c.copy()) for k, c in state["columns"].items()}
        self.size, self.cursor = len(self.columns["end"]), state["cursor"]


class Critic:
    """Estimates the discounted probability of an event under the robot policy.

    Args:
        obs_width, action_width: D, A.
        event: "bad" takes the larger twin (risk), "good" the smaller one (goal).
        policy: chooses the next action in targets.
        config: hyper-parameters.
        scale: (obs_mean, obs_std, action_middle, action_half), to normalise inputs.
        rng: the seeded stream of batches; seed: of the initial weights.
    """

    def __init__(
        self,
        obs_width: int,
        action_width: int,
        event: Literal["bad", "good"],
        policy: Policy,
        config: CriticConfig,
        scale: tuple[Tensor, Tensor, Tensor, Tensor],
        rng: np.random.Generator,
        seed: int,
    ) -> None:
        self.config, self.policy, self.rng, self.scale = config, policy, rng, scale
        self.event = event
        self.net, self.target = (
            BatchedMLP(2, obs_width + action_width, 1, config.hidden, torch.Generator().manual_seed(seed), torch.sigmoid)
            for _ in range(2)
        )
        self.optimiser = adam(self.net.parameters(), config.learning_rate)
        self.plain = Ring(config.capacity, obs_width, action_width)
        self.events = Ring(max(1, config.capacity // 10), obs_width, action_width)

    def __call__(self, obs: Array, actions: Array) -> Array:
        """Q(s, a) of each robot: (N, D), (N, A) -> (N,) in [0, 1]."""
        s, a = (torch.from_numpy(np.asarray(x, np.float32)) for x in (obs, actions))
        with torch.no_grad():
            q = self._q(self.net, s, a)
        return self._worst(q).numpy()

    def add(self, obs: Array, action: Array, next_obs: Array, event: Array, end: Array) -> None:
        """Take in n transitions. event: (n,) bool, it happened in this step; end: (n,) bool, nothing can follow."""
        rows = {"obs": obs, "action": action, "next_obs": next_obs, "end": end}
        self.events.add(**{k: v[event] for k, v in rows.items()})
        self.plain.add(**{k: v[~event] for k, v in rows.items()})

    def update(self) -> float:
        """One gradient step; returns the loss (NaN when there are no transitions yet)."""
        if not self.plain.size:
            return float("nan")
        # At least one, or a small batch would never show an event.
        positives = max(1, round(self.config.positives * self.config.batch)) if self.events.size else 0
        batch = self.plain.draw(self.config.batch - positives, self.rng)
        event = torch.zeros(self.config.batch)
        if positives:
            more = self.events.draw(positives, self.rng)
            batch = {k: torch.cat([v, more[k]]) for k, v in batch.items()}
            event[-positives:] = 1.0
        with torch.no_grad():
            then = torch.from_numpy(np.asarray(self.policy.act(batch["next_obs"].numpy()), np.float32))
            future = self._worst(self._q(self.target, batch["next_obs"], then))
            y = event + self.config.gamma * (1 - event) * (1 - batch["end"]) * future
        loss = (self._q(self.net, batch["obs"], batch["action"]) - y).square().mean(dim=1).sum()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(list(self.target.parameters()), list(self.net.parameters()), self.config.tau)
        return float(loss.detach()) / 2

    def _worst(self, q: Tensor) -> Tensor:
        """The more pessimistic twin: (2, B) -> (B,)."""
        return q.amax(0) if self.event == "bad" else q.amin(0)

    def updates(self, n: int) -> None:
        """n gradient steps."""
        for _ in range(n):
            self.update()

    def _q(self, net: BatchedMLP, obs: Tensor, actions: Tensor) -> Tensor:
        """(B, D), (B, A) -> (2, B)."""
        obs_mean, obs_std, middle, half = self.scale
        x = torch.cat([((obs - obs_mean) / obs_std).clamp_(-10, 10), (actions - middle) / half], dim=1)
        return net(x)[:, :, 0]  # type: ignore[no-any-return]

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimiser, transitions and random state."""
        return {
            "net": module_state(self.net),
            "target": module_state(self.target),
            "adam": optimiser_state(self.optimiser),
            "plain": self.plain.state_dict(),
            "events": self.events.state_dict(),
            "rng": rng_state(self.rng),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        load_module_state(self.net, state["net"])
        load_module_state(self.target, state["target"])
        load_optimiser_state(self.optimiser, state["adam"])
        self.plain.load_state_dict(state["plain"])
        self.events.load_state_dict(state["events"])
        set_rng_state(self.rng, state["rng"])
