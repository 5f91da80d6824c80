"""A trained controller that acts as an algorithmic supervisor: a Gaussian policy whose mean is executed."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tutelage.errors import ContractError
from tutelage.policies.weights import load_module_state, load_weights, save_policy

Array = NDArray[Any]


class GaussianActor(nn.Module):
    """pi(a | s) = N(mean(s), diag(std^2)) over actions in units of half their range; tanh MLP on normalised features.

    Args:
        features: how many leading numbers of an observation the actor sees.
        action_low, action_high: (A,) bounds.
        hidden: width of each hidden layer.
    """

    def __init__(self, features: int, action_low: Array, action_high: Array, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.low: Tensor
        self.high: Tensor
        self.obs_mean: Tensor
        self.obs_std: Tensor
        self.features, self.hidden = features, tuple(hidden)
        self.net = tanh_mlp(features, len(action_low), self.hidden, last_gain=0.01)
        self.log_std = nn.Parameter(torch.full((len(action_low),), -0.5))
        low, high = torch.as_tensor(action_low).float(), torch.as_tensor(action_high).float()
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.register_buffer("obs_mean", torch.zeros(features))
        self.register_buffer("obs_std", torch.ones(features))

    def normalise(self, obs: Array) -> Tensor:
        """(N, D) observations -> (N, features) normalised float32, clipped to 10 standard deviations."""
        x = torch.from_numpy(np.ascontiguousarray(obs[:, : self.features])).float()
        return ((x - self.obs_mean) / self.obs_std).clamp_(-10, 10)

    def to_action(self, u: Tensor) -> Array:
        """Actions in units of half their range -> actions within bounds, float32."""
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        return (middle + half * u.clamp(-1, 1)).numpy()

    def log_prob(self, mean: Tensor, u: Tensor) -> Tensor:
        """Log density of u (N, A) under the policy with the given mean, (N,)."""
        z = (u - mean) / self.log_std.exp()
        return (-0.5 * z.square() - self.log_std - 0.5 * math.log(2 * math.pi)).sum(-1)

    @torch.no_grad()
    def act(self, obs: Array) -> Array:
        """The mean action for each observation: (N, D) -> (N, A) float32."""
        return self.to_action(self.net(self.normalise(obs)))

    # -- files --------------------------------------------------------------------------------------------------

    def save(self, path: Path, card: dict[str, Any]) -> None:
        """Write weights and their card (task, command, seed, steps, scores) as safetensors."""
        save_policy(path, self, {**card, "features": self.features, "hidden": list(self.hidden)})

    @classmethod
    def load(cls, path: Path) -> tuple[GaussianActor, dict[str, Any]]:
        """Read weights and card.

        Raises:
            TutelageError: no such file, or a damaged one.
            ContractError: the file holds something else, or its weights do not fit the shapes on its card.
        """
        weights, card = load_weights(path, cls.__name__)
        try:
            actor = cls(int(card["features"]), weights["low"], weights["high"], tuple(card["hidden"]))
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, RuntimeError):
            raise ContractError(f"{path} lacks the shapes of an actor on its card") from None
        load_module_state(actor, weights)
        return actor, card


def tanh_mlp(inputs: int, outputs: int, hidden: tuple[int, ...], last_gain: float) -> nn.Sequential:
    """Tanh layers with orthogonal weights; the last one scaled by `last_gain`."""
    layers: list[nn.Module] = []
    widths = [inputs, *hidden]
    for a, b in pairwise(widths):
        layers += [_orthogonal(nn.Linear(a, b), math.sqrt(2)), nn.Tanh()]
    return nn.Sequential(*layers, _orthogonal(nn.Linear(widths[-1], outputs), last_gain))


def _orthogonal(layer: nn.Linear, gain: float) -> nn.Linear:
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
