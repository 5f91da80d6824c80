"""Gradient descent on networks that learn side by side."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tutelage.learning.optimiser import adam, load_optimiser_state, optimiser_state
from tutelage.policies.networks import Network


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
        torch._foreach_copy_(self.gradients, torch.autograd.grad(losses.sum(), self.parameters))
        self.optimiser.step()
        return float(losses.detach().sum()) / len(losses)

    def state_dict(self) -> dict[str, Any]:
        """The moments of each parameter of the K networks, by position (copies)."""
        return optimiser_state(self.optimiser)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        load_optimiser_state(self.optimiser, state)
