"""Transitions as those of a robot's mirror images: experience that costs no simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tutelage.fleet.reflection import Reflection

Array = NDArray[Any]


class Mirrors:
    """The robot itself and its reflections, as signed permutations of features (G, D) and actions (G, A)."""

    def __init__(self, reflections: Sequence[Reflection], features: int, actions: int) -> None:
        order = [np.arange(features), *(r.observation for r in reflections)]
        sign = [np.ones(features), *(r.observation_sign for r in reflections)]
        self.order, self.sign = torch.from_numpy(np.stack(order)), torch.from_numpy(np.stack(sign)).float()
        order = [np.arange(actions), *(r.action for r in reflections)]
        sign = [np.ones(actions), *(r.action_sign for r in reflections)]
        self.action_order, self.action_sign = torch.from_numpy(np.stack(order)), torch.from_numpy(np.stack(sign)).float()

    def draw(self, rng: np.random.Generator, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Each row of features x (n, D) and of actions u (n, A) as one of its G mirror images, the same for both."""
        k = torch.from_numpy(rng.integers(len(self.order), size=len(x)))
        return x.gather(1, self.order[k]) * self.sign[k], u.gather(1, self.action_order[k]) * self.action_sign[k]

    def all_of(self, x: Array) -> Array:
        """All mirror images of features: (n, D) -> (G n, D)."""
        pairs = zip(self.order.numpy(), self.sign.numpy(), strict=True)
        return np.concatenate([x[:, order] * sign for order, sign in pairs])
