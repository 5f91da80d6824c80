"""Safety and goal critics: the discounted probability that something happens (appendix C.3; Recovery RL).

    Q(s, a) = E[ sum_k gamma^k 1{event at step k} ],   target: y = e + gamma (1 - e)(1 - end) Q'(s', pi(s'))

with twin networks, a slowly moving target Q', and batches in which a quarter of the transitions are events. A critic of a
bad event takes the larger twin everywhere (pessimistic), a critic of a good event the smaller one, in targets and in
queries alike. A timeout ends an episode, not the future: it is never terminal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tutelage.cores import available_cores
from tutelage.errors import ConfigError
from tutelage.fleet.policy import Policy
from tutelage.learning.twins import Scale, twins
from tutelage.policies.networks import Shape, hidden_layers, network, shape_of, stored_as
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
        hidden: widths of the (fully connected) hidden layers; default: 256 and 256, for images 100, 50 and 10.
        capacity: transitions kept without an event, and a tenth as many with one; the oldest are overwritten.
        pretrain: gradient steps before the run (3000 in the dissertation).
        every: timesteps between gradient steps during the run.
    """

    gamma: float = 0.8
    tau: float = 0.005
    learning_rate: float = 3e-4
    batch: int = 256
    positives: float = 0.25
    hidden: tuple[int, ...] | None = None
    capacity: int = 50_000
    pretrain: int = 3000
    every: int = 5

    def __post_init__(self) -> None:
        if not 0 <= self.gamma < 1:
            raise ConfigError(f"a critic's gamma must be in [0, 1), got {self.gamma}")
        if not 0 < self.tau <= 1 or not 0 < self.positives < 1 or self.batch < 2 or self.every < 1 or self.capacity < 10:
            raise ConfigError("a critic needs 0 < tau <= 1, 0 < positives < 1, batch >= 2, every >= 1, capacity >= 10")


class Ring:
    """The newest transitions. A row is one, its parts side by side: obs, action, next_obs, end.

    Rows are float32, or bytes where observations are images; then a float32 is four of them.

    Args:
        capacity: of transitions.
        obs: shape of an observation.
        action_width: A.
    """

    def __init__(self, capacity: int, obs: Shape, action_width: int) -> None:
        self.capacity, self.size, self.cursor, self.obs_shape = capacity, 0, 0, shape_of(obs)
        self.dtype = stored_as(obs)
        number, width = 4 if self.dtype == torch.uint8 else 1, math.prod(self.obs_shape)
        self.widths = {"obs": width, "action": number * action_width, "next_obs": width, "end": number}
        # As NumPy leaves it to the system to give memory when it is first written to, all may be asked for at once.
        kind = np.uint8 if self.dtype == torch.uint8 else np.float32
        self.rows = torch.from_numpy(np.zeros((capacity, sum(self.widths.values())), dtype=kind))

    def pack(self, obs: Array, action: Array, next_obs: Array, end: Array) -> Array:
        """n transitions as rows (n, width)."""
        numbers = [np.asarray(x, dtype=np.float32) for x in (action, end[:, None])]
        if self.dtype == torch.uint8:
            numbers = [np.ascontiguousarray(x).view(np.uint8) for x in numbers]
        flat = len(obs), math.prod(self.obs_shape)  # not -1: there may be no transition
        parts = obs.reshape(flat), numbers[0], next_obs.reshape(flat), numbers[1]
        return np.concatenate(parts, axis=1, dtype=numbers[0].dtype)

    def add(self, rows: Array) -> None:
        """Append transitions (n, width); when there is no room any more, the oldest give way."""
        rows = rows[-self.capacity :]
        first = rows[: self.capacity - self.cursor]
        rest = rows[len(first) :]
        self.rows[self.cursor : self.cursor + len(first)] = torch.from_numpy(first)
        self.rows[: len(rest)] = torch.from_numpy(rest)
        self.cursor += len(rows)
        if self.cursor >= self.capacity:
            self.cursor -= self.capacity
        self.size = min(self.size + len(rows), self.capacity)

    def columns(self, rows: Tensor) -> dict[str, Tensor]:
        """The parts of rows (n, width), by name: views."""
        parts = dict(zip(self.widths, rows.split(list(self.widths.values()), dim=1), strict=True))
        for name, part in parts.items():
            parts[name] = part.unflatten(1, self.obs_shape) if "obs" in name else part.view(torch.float32)
        return {**parts, "end": parts["end"][:, 0]}

    def draw(self, n: int, rng: np.random.Generator) -> Tensor:
        """n transitions drawn uniformly with replacement, (n, width)."""
        return self.rows.index_select(0, torch.from_numpy(rng.integers(self.size, size=n)))

    def state_dict(self) -> dict[str, Any]:
        """The transitions and where the next one goes (copies: later transitions overwrite these rows)."""
        return {"cursor": self.cursor, "rows": self.rows[: self.size].numpy().copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.size, self.cursor = len(state["rows"]), state["cursor"]
        self.rows[: self.size] = torch.from_numpy(state["rows"])


class Critic:
    """Estimates the discounted probability of an event under the robot policy.

    Args:
        obs: shape of an observation: D, or (H, W, 3) for images.
        action_width: A.
        event: "bad" takes the larger twin (risk), "good" the smaller one (goal).
        policy: chooses the next action in targets.
        config: hyper-parameters.
        scale: (obs_mean, obs_std, action_middle, action_half), to normalise inputs.
        rng: the seeded stream of batches; seed: of the initial weights.
        threads: see `Together`; default: one a core. Networks that see vectors are asked, and learn, in them.
    """

    def __init__(
        self,
        obs: Shape,
        action_width: int,
        event: Literal["bad", "good"],
        policy: Policy,
        config: CriticConfig,
        scale: Scale,
        rng: np.random.Generator,
        seed: int,
        threads: int | None = None,
    ) -> None:
        self.config, self.policy, self.rng = config, policy, rng
        hidden = hidden_layers(obs, config.hidden)
        self.net, self.target = (
            network(obs, 2, 1, hidden, torch.Generator().manual_seed(seed), torch.sigmoid, extra=action_width)
            for _ in range(2)
        )
        self.twins = twins(
            self.net, self.target, scale, event == "bad", config.learning_rate, config.tau, threads or available_cores()
        )
        self.plain = Ring(config.capacity, obs, action_width)
        self.events = Ring(max(1, config.capacity // 10), obs, action_width)

    def __call__(self, obs: Array, actions: Array) -> Array:
        """Q(s, a) of each robot: (N, D) or (N, H, W, 3), (N, A) -> (N,) in [0, 1]."""
        return self.twins.ask(obs, actions)

    def add(self, obs: Array, action: Array, next_obs: Array, event: Array, end: Array) -> None:
        """Take in n transitions. event: (n,) bool, it happened in this step; end: (n,) bool, nothing can follow."""
        rows = self.plain.pack(obs, action, next_obs, end)
        if event.any():
            self.events.add(rows[event])
            rows = rows[~event]
        self.plain.add(rows)

    def update(self) -> float:
        """One gradient step; returns the loss (NaN when there are no transitions yet)."""
        if not self.plain.size:
            return float("nan")
        # At least one, or a small batch would never show an event.
        positives = max(1, round(self.config.positives * self.config.batch)) if self.events.size else 0
        rows = self.plain.draw(self.config.batch - positives, self.rng)
        if positives:
            rows = torch.cat([rows, self.events.draw(positives, self.rng)])
        batch = {name: part.numpy() for name, part in self.plain.columns(rows).items()}
        y = np.ones(len(rows), np.float32)  # of events, which come last
        after, end = (batch[name][: len(rows) - positives] for name in ("next_obs", "end"))
        future = self.twins.ask(after, self.policy.act(after), of_target=True)
        y[: len(after)] = self.config.gamma * (1 - end) * future
        return self.twins.step(batch["obs"], batch["action"], y)

    def updates(self, n: int) -> None:
        """n gradient steps."""
        for _ in range(n):
            self.update()

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimiser, transitions and random state."""
        return {
            "net": module_state(self.net),
            "target": module_state(self.target),
            "adam": self.twins.descent.state_dict(),
            "plain": self.plain.state_dict(),
            "events": self.events.state_dict(),
            "rng": rng_state(self.rng),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        load_module_state(self.net, state["net"])
        load_module_state(self.target, state["target"])
        self.twins.descent.load_state_dict(state["adam"])
        self.plain.load_state_dict(state["plain"])
        self.events.load_state_dict(state["events"])
        set_rng_state(self.rng, state["rng"])
