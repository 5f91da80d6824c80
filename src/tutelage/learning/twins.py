"""The twin networks of a critic with their slowly moving target: what they say, and one gradient step of theirs."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tutelage.learning.descent import CompiledDescent, Descent
from tutelage.policies.mlp import BatchedMLP
from tutelage.policies.networks import Network, as_tensor, normalise

Array = NDArray[Any]
Scale = tuple[Tensor, Tensor, Tensor, Tensor]
"""obs_mean, obs_std, action_middle, action_half: what normalises the inputs."""


class Twins(Protocol):
    """Two networks Q, and their target Q', which follows them."""

    @property
    def descent(self) -> Descent | CompiledDescent:
        """Of Q."""
        ...

    def ask(self, obs: Array, actions: Array, of_target: bool = False) -> Array:
        """The larger or the smaller of both, for observations (B, ...) and actions (B, A): (B,) in [0, 1]."""
        ...

    def step(self, obs: Array, actions: Array, y: Array) -> float:
        """One gradient step of Q towards y (B,), one of Q' towards Q; returns the mean squared error before."""
        ...


def twins(
    net: Network, target: Network, scale: Scale, largest: bool, learning_rate: float, tau: float, threads: int
) -> Twins:
    """Q and Q': those that see vectors in compiled code, others by PyTorch.

    Args:
        net, target: their networks, of two members each.
        scale: normalises the inputs.
        largest: whether it is the larger of two that counts.
        learning_rate: of Adam.
        tau: how far Q' goes towards Q in a step.
        threads: see `Together`.
    """
    if isinstance(net, BatchedMLP) and isinstance(target, BatchedMLP):
        return CompiledTwins(net, target, scale, largest, learning_rate, tau, threads)
    return BatchedTwins(net, target, scale, largest, learning_rate, tau)


class CompiledTwins:
    """Each of both learns in a thread of its own. Arguments: see `twins`."""

    def __init__(
        self, net: BatchedMLP, target: BatchedMLP, scale: Scale,
        largest: bool, learning_rate: float, tau: float, threads: int,
    ) -> None:  # fmt: skip
        from tutelage.learning.compiled import criticise
        from tutelage.policies.compiled import ask_all, critics

        self.descent = CompiledDescent(net, learning_rate, threads)
        self._ask_all, self._critics, self._criticise = ask_all, critics, criticise
        self._net, self._target = net, target.arrays()
        self._scale, self._tau = tuple(s.numpy() for s in scale), np.float32(tau)
        self._largest, self._threads = largest, threads

    def ask(self, obs: Array, actions: Array, of_target: bool = False) -> Array:
        obs, actions = (np.ascontiguousarray(x, dtype=np.float32) for x in (obs, actions))
        said = np.empty((2, len(obs), 1), np.float32)
        arrays = self._target if of_target else self._net.arrays()
        self._ask_all(self._critics, said, self._threads, obs, actions, *self._scale, *arrays)
        return np.asarray((said.max if self._largest else said.min)(axis=0)[:, 0])

    def step(self, obs: Array, actions: Array, y: Array) -> float:
        batch = [np.ascontiguousarray(x, dtype=np.float32) for x in (obs, actions, y)]
        self.descent.begin(self._criticise, *batch, *self._scale, *self._target, self._tau)
        return self.descent.end()


class BatchedTwins:
    """Both learn together, as batched products of PyTorch. Arguments: see `twins`."""

    def __init__(self, net: Network, target: Network, scale: Scale, largest: bool, learning_rate: float, tau: float) -> None:
        self.descent = Descent(net, learning_rate)
        self._net, self._target, self._scale, self._largest, self._tau = net, target, scale, largest, tau

    def _q(self, net: Network, obs: Array, actions: Array) -> Tensor:
        """(B, ...), (B, A) -> (2, B)."""
        mean, std, middle, half = self._scale
        return net(normalise(as_tensor(obs), mean, std), (as_tensor(actions) - middle) / half)[:, :, 0]  # type: ignore[no-any-return]

    @torch.no_grad()
    def ask(self, obs: Array, actions: Array, of_target: bool = False) -> Array:
        q = self._q(self._target if of_target else self._net, obs, actions)
        return (q.amax(0) if self._largest else q.amin(0)).numpy()

    def step(self, obs: Array, actions: Array, y: Array) -> float:
        loss = self.descent.step((self._q(self._net, obs, actions) - as_tensor(y)).square().mean(dim=1))
        with torch.no_grad():
            torch._foreach_lerp_(list(self._target.parameters()), list(self._net.parameters()), self._tau)
        return loss
