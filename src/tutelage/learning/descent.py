"""Gradient descent on networks that learn side by side: in compiled code, or by PyTorch's automatic differentiation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tutelage.cores import Together, share
from tutelage.learning.optimiser import adam, load_optimiser_state, optimiser_state
from tutelage.policies.mlp import BatchedMLP
from tutelage.policies.networks import Network

Array = NDArray[Any]


class Descent:
    """Adam on K networks of one shape, each of which has a loss of its own.

    Args:
        net: the networks; every parameter leads with K.
        learning_rate: of Adam.
    """

    def __init__(self, net: Network, learning_rate: float) -> None:
        self.parameters = list(net.parameters())
        self.optimiser = adam(self.parameters, learning_rate)
        self.gradients = [torch.zeros_like(parameter) for parameter in self.parameters]
        for parameter, gradient in zip(self.parameters, self.gradients, strict=True):
            parameter.grad = gradient

    def step(self, losses: Tensor) -> float:
        """One step of every network down its loss, (K,); returns the mean of the losses."""
        loss = self.look(losses)
        self.go()
        return loss

    def look(self, losses: Tensor) -> float:
        """The first half of a step, which changes no network: what is down for each loss, (K,); returns their mean."""
        torch._foreach_copy_(self.gradients, torch.autograd.grad(losses.sum(), self.parameters))
        return float(losses.detach().sum()) / len(losses)

    def go(self) -> None:
        """The second half."""
        self.optimiser.step()

    def state_dict(self) -> dict[str, Any]:
        """The moments of each parameter of the K networks, by position (copies)."""
        return optimiser_state(self.optimiser)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        load_optimiser_state(self.optimiser, state)


class CompiledDescent:
    """Adam on K multilayer perceptrons of one shape, each in a thread of its own; see `learning.compiled`.

    Args:
        net: the networks. They are what they were from `begin` to `end`, so they may be asked meanwhile.
        learning_rate: of Adam.
        threads: see `Together`.
    """

    def __init__(self, net: BatchedMLP, learning_rate: float, threads: int) -> None:
        self._threads, self._learning_rate, self._steps = threads, learning_rate, 0
        self._net = net
        self._new = tuple(tuple(np.empty_like(array) for array in arrays) for arrays in net.arrays())
        self._members = len(self._new[0][0])
        self._losses = np.zeros(self._members)
        size = sum(array[0].size for arrays in self._new for array in arrays)
        self._first, self._second = (np.zeros((self._members, size), np.float32) for _ in range(2))
        self._begun = Together(1, [])

    def begin(self, kernel: Callable[..., None], *data: Any) -> None:
        """Start a step of every network in the background.

        kernel: `imitate` or `criticise`; data: its arguments between losses and weights.
        """
        self._steps += 1
        rate = np.float32(self._learning_rate / (1 - 0.9**self._steps))
        correction = np.float32(1 / np.sqrt(1 - 0.999**self._steps))
        step = *self._net.arrays(), *self._new, self._first, self._second, rate, correction
        self._begun = share(kernel, self._members, self._threads, self._losses, *data, *step)

    def end(self) -> float:
        """Wait for what began; returns the mean of the losses before it."""
        self._begun.results()
        before = self._net.arrays()
        self._net.adopt(*self._new)
        self._new = before
        return float(sum(self._losses.tolist())) / self._members

    def state_dict(self) -> dict[str, Any]:
        """The moments of each parameter of the K networks, by position (copies); nothing before the first step."""
        if not self._steps:
            return {}
        moments = zip(self._parts(self._first), self._parts(self._second), strict=True)
        return {
            str(position): {"step": np.array(self._steps, np.float32), "exp_avg": first.copy(), "exp_avg_sq": second.copy()}
            for position, (first, second) in enumerate(moments)
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._steps = int(state["0"]["step"]) if state else 0
        for name, flat in (("exp_avg", self._first), ("exp_avg_sq", self._second)):
            for position, part in enumerate(self._parts(flat)):
                part[:] = state[str(position)][name] if state else 0.0

    def _parts(self, flat: Array) -> list[Array]:
        """Views of (K, P) numbers as the parameters of the networks: all weights, then all biases."""
        weights: list[Array] = []
        biases: list[Array] = []
        start = 0
        for weight, bias in zip(*self._new, strict=True):
            for array, parts in ((weight, weights), (bias, biases)):
                stop = start + array[0].size
                parts.append(flat[:, start:stop].reshape(array.shape))
                start = stop
        return weights + biases
