"""Gradient descent on networks that learn side by side."""

from __future__ import annotations

import copy
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from tutelage.learning.optimiser import adam, load_optimiser_state, optimiser_state
from tutelage.policies.networks import Network

SIDES = 2
"""Threads in which the networks of one ensemble learn, at most: more of them wait for the interpreter lock too often."""
_HELPERS = ThreadPoolExecutor(SIDES - 1, thread_name_prefix="learning")


class Descent:
    """Adam on K networks of one shape, each of which has a loss of its own.

    With several threads, each finds the gradients of some of the networks, and they meet once a step. To share each matrix
    product among threads, which then meet after each, costs more than it saves at the usual sizes.

    Args:
        net: the networks; every parameter leads with K.
        learning_rate: of Adam.
        threads: how many may be used; the first is the one that calls.
    """

    def __init__(self, net: Network, learning_rate: float, threads: int = 1) -> None:
        members = len(next(net.parameters()))
        sides = min(threads, members, SIDES)
        self.optimiser = adam(net.parameters(), learning_rate)
        self.members = [slice(a, b) for a, b in pairwise(members * k // sides for k in range(sides + 1))]
        self.nets = [_some(net, these) for these in self.members] if sides > 1 else [net]
        for parameter in net.parameters():
            parameter.grad = torch.zeros_like(parameter)
        self.gradients = [[p.grad[these] for p in net.parameters() if p.grad is not None] for these in self.members]

    def step(self, loss: Callable[[Network, slice], Tensor]) -> float:
        """One step of every network down its loss; returns the mean of the losses.

        loss: (k,) of k of the networks, given which members they are.
        """

        def differentiate(side: int) -> Tensor:
            losses = loss(self.nets[side], self.members[side])
            found = torch.autograd.grad(losses.sum(), list(self.nets[side].parameters()))
            torch._foreach_copy_(self.gradients[side], found)
            return losses.detach()

        others = [_HELPERS.submit(differentiate, side) for side in range(1, len(self.nets))]
        losses = torch.cat([differentiate(0), *(other.result() for other in others)])
        self.optimiser.step()
        return float(losses.sum()) / len(losses)

    def state_dict(self) -> dict[str, Any]:
        """The moments of each parameter of the K networks, by position (copies)."""
        return optimiser_state(self.optimiser)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        load_optimiser_state(self.optimiser, state)


def _some(net: Network, members: slice) -> Network:
    """Some of K networks as networks of their own, whose parameters lie in the memory of those of all."""
    own = copy.deepcopy(net)
    for mine, everybodys in zip(own.parameters(), net.parameters(), strict=True):
        mine.data = everybodys.data[members]
    return own
