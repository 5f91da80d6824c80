"""The robot policy of chapter 5: a bootstrapped ensemble whose spread is its uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tutelage.cores import available_cores
from tutelage.errors import ContractError
from tutelage.policies.mlp import BatchedMLP
from tutelage.policies.networks import Network, Shape, as_tensor, hidden_layers, network, normalise, shape_of
from tutelage.policies.weights import load_module_state, load_weights, save_policy

Array = NDArray[Any]


class EnsemblePolicy(nn.Module):
    """The mean of K networks acts; the variance between them is the uncertainty.

    Args:
        obs: shape of an observation: D, or (H, W, 3) for images, which a CNN sees (appendix B.2).
        action_low, action_high: (A,) bounds.
        members: K.
        hidden: widths of the (fully connected) hidden layers; default: 256 and 256, for images 100, 50 and 10.
        seed: of the initial weights.
        threads: see `Together`; default: one a core. Networks that see vectors are asked, and learn, in them.
    """

    def __init__(
        self,
        obs: Shape,
        action_low: Array,
        action_high: Array,
        *,
        members: int = 5,
        hidden: tuple[int, ...] | None = None,
        seed: int = 0,
        threads: int | None = None,
    ) -> None:
        super().__init__()
        self.action_middle: Tensor
        self.action_half: Tensor
        self.obs_mean: Tensor
        self.obs_std: Tensor
        self.members, self.obs_shape, self.hidden = members, shape_of(obs), hidden_layers(obs, hidden)
        self.outputs, self.threads = len(action_low), threads or available_cores()
        self.net = self._network(seed)
        low, high = torch.as_tensor(action_low).float(), torch.as_tensor(action_high).float()
        self.register_buffer("action_middle", (high + low) / 2)
        self.register_buffer("action_half", (high - low) / 2)
        self.register_buffer("obs_mean", torch.zeros(self.obs_shape[-1]))
        self.register_buffer("obs_std", torch.ones(self.obs_shape[-1]))
        self._seen: Array | None = None
        self._said: tuple[Array, Array] = np.empty(0), np.empty(0)
        if isinstance(self.net, BatchedMLP):  # what is compiled on first use is compiled now, not while robots wait
            self._ask(np.zeros((1, *self.obs_shape), np.float32))
            self.forget()

    def _network(self, seed: int) -> Network:
        generator = torch.Generator().manual_seed(seed)
        return network(self.obs_shape, self.members, self.outputs, self.hidden, generator, last=torch.tanh)

    def restart(self, seed: int) -> None:
        """New initial weights."""
        self.net.load_state_dict(self._network(seed).state_dict())
        self.forget()

    def save(self, path: Path, card: dict[str, Any]) -> None:
        """Write weights and a card (JSON values) as safetensors."""
        save_policy(path, self, {**card, "hidden": list(self.hidden), "obs_shape": list(self.obs_shape)})

    @classmethod
    def load(cls, path: Path) -> tuple[EnsemblePolicy, dict[str, Any]]:
        """Read weights and card.

        Raises:
            TutelageError: no such file, or a damaged one.
            ContractError: the file holds something else.
        """
        weights, card = load_weights(path, cls.__name__)
        try:
            middle, half = weights["action_middle"], weights["action_half"]
            members = {len(array) for name, array in weights.items() if name.startswith("net.")}  # all lead with K
            shape = tuple(card.get("obs_shape", weights["obs_mean"].shape))
            policy = cls(shape, middle - half, middle + half, members=members.pop(), hidden=tuple(card["hidden"]))
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, RuntimeError):
            raise ContractError(f"{path} lacks the shapes of an ensemble on its card") from None
        load_module_state(policy, weights)
        return policy, card

    def set_normalisation(self, obs: Array) -> None:
        """Z-score inputs with the mean and standard deviation of obs (n, D) or (n, H, W, 3), from now on.

        Those of each number of a vector, and of each channel of an image.
        """
        axes = tuple(range(obs.ndim - 1))
        self.obs_mean.copy_(torch.from_numpy(obs.mean(axis=axes)))
        self.obs_std.copy_(torch.from_numpy(obs.std(axis=axes).clip(1e-2)))
        self.forget()

    def normalise(self, obs: Tensor) -> Tensor:
        """(..., D) float32 or (..., H, W, 3) bytes -> z-scores, clipped to 10 standard deviations."""
        return normalise(obs, self.obs_mean, self.obs_std)

    def loss(self, obs: Tensor, actions: Tensor) -> Tensor:
        """Mean squared error of each member on its own batch, (K,), in units of half the action range.

        obs: (K, B, D) or (K, B, H, W, 3), actions: (K, B, A).
        """
        target = (actions - self.action_middle) / self.action_half
        error: Tensor = (self.net(self.normalise(obs)) - target).square().mean(dim=(1, 2))
        return error

    def forget(self) -> None:
        """Drop the memory of the last observations: call after the weights changed."""
        self._seen = None

    @property
    def scale(self) -> tuple[Array, Array, Array, Array]:
        """What normalises: mean, std (D,) of observations, middle, half (A,) of the range of actions; shared memory."""
        return self.obs_mean.numpy(), self.obs_std.numpy(), self.action_middle.numpy(), self.action_half.numpy()

    def _ask(self, obs: Array) -> tuple[Array, Array]:
        """The mean of the members (N, A), and their variance (N,); one pass for `act` and `uncertainty`."""
        if self._seen is not obs:
            self._said = self._ask_compiled(obs, self.net) if isinstance(self.net, BatchedMLP) else self._ask_torch(obs)
            self._seen = obs
        return self._said

    def _ask_compiled(self, obs: Array, net: BatchedMLP) -> tuple[Array, Array]:
        from tutelage.policies.compiled import ask_all, mean_and_variance, members

        obs, (mean, std, middle, half) = np.ascontiguousarray(obs, dtype=np.float32), self.scale
        said = np.empty((self.members, len(obs), self.outputs), np.float32)
        ask_all(members, said, self.threads, obs, mean, std, *net.arrays())
        action, variance = np.empty(said.shape[1:], np.float32), np.empty(len(obs), np.float32)
        mean_and_variance(said, middle, half, action, variance)
        return action, variance

    @torch.no_grad()
    def _ask_torch(self, obs: Array) -> tuple[Array, Array]:
        said = self.net(self.normalise(as_tensor(obs)))
        action = self.action_middle + self.action_half * said.mean(dim=0)
        return action.numpy(), said.var(dim=0, correction=0).mean(dim=-1).numpy()

    def act(self, obs: Array) -> Array:
        """The mean of the members: (N, D) or (N, H, W, 3) -> (N, A) float32."""
        return self._ask(obs)[0]

    def uncertainty(self, obs: Array) -> Array:
        """Ensemble variance, mean over actions, in units of the variance of the pair {low, high}: (N,), 0 to 1."""
        # Members speak in units of half the range, whose pair {-1, 1} has variance 1: no further division.
        return self._ask(obs)[1]
