"""Gradient steps of the policy towards what humans did (eq. 5.3), beside whatever else this process computes."""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import torch

from tutelage.cores import Together
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.descent import CompiledDescent, Descent
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.mlp import BatchedMLP


class Regression(Protocol):
    """Adam on the mean squared error of each member of an ensemble."""

    def begin(self, data: AggregatedDataset, batch: int) -> None:
        """Draw a batch for each member, and start one gradient step in the background; the policy changes in `end`."""
        ...

    def end(self) -> float:
        """Wait for the step, and let the policy take it; returns the loss before it, mean over members."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments (copies), by the position of the parameter; nothing before the first step."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        ...


def regression(policy: EnsemblePolicy, learning_rate: float) -> Regression:
    """How this policy learns: networks that see vectors in compiled code, others by PyTorch's automatic differentiation.

    Args:
        policy: the ensemble; its `threads` are those in which it learns, too.
        learning_rate: of Adam.
    """
    if isinstance(policy.net, BatchedMLP):
        return CompiledRegression(policy, policy.net, learning_rate)
    return BatchedRegression(policy, learning_rate)


class CompiledRegression:
    """Each member learns in a thread of its own. Arguments: see `regression`."""

    def __init__(self, policy: EnsemblePolicy, net: BatchedMLP, learning_rate: float) -> None:
        from tutelage.learning.compiled import imitate

        self._imitate, self._scale = imitate, policy.scale
        self._descent = CompiledDescent(net, learning_rate, policy.threads)

    def begin(self, data: AggregatedDataset, batch: int) -> None:
        rows = data.obs.rows.numpy(), data.actions.rows.numpy()
        self._descent.begin(self._imitate, *rows, data.draw(batch), *self._scale)

    def end(self) -> float:
        return self._descent.end()

    def state_dict(self) -> dict[str, Any]:
        return self._descent.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._descent.load_state_dict(state)


class BatchedRegression:
    """All members learn together, as batched products of PyTorch, in one background task. Arguments: see `regression`."""

    def __init__(self, policy: EnsemblePolicy, learning_rate: float) -> None:
        self._policy, self._begun = policy, Together(1, [])
        self._descent = Descent(policy.net, learning_rate)

    def begin(self, data: AggregatedDataset, batch: int) -> None:
        look = partial(self._look, *data.batches(batch), torch.get_num_threads())
        self._begun = Together(self._policy.threads, [look])

    def end(self) -> float:
        (loss,) = self._begun.results()
        self._descent.go()
        return float(loss)

    def _look(self, obs: torch.Tensor, actions: torch.Tensor, threads: int) -> float:
        torch.set_num_threads(threads)  # each thread has a number of its own
        return self._descent.look(self._policy.loss(obs, actions))

    def state_dict(self) -> dict[str, Any]:
        return self._descent.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._descent.load_state_dict(state)
