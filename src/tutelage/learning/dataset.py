"""The aggregated dataset D of eq. 5.3, with true online bootstrapping."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tutelage.errors import ConfigError
from tutelage.seeding import rng_state, set_rng_state

Array = NDArray[Any]


class GrowingArray:
    """Rows appended at the end, in a tensor that doubles when full."""

    def __init__(self, shape: tuple[int, ...], dtype: torch.dtype) -> None:
        self._data, self.size = torch.empty((256, *shape), dtype=dtype), 0

    def append(self, rows: Array) -> None:
        """Add rows (n, *shape)."""
        n = len(rows)
        if self.size + n > len(self._data):
            bigger = torch.empty((max(2 * len(self._data), self.size + n), *self._data.shape[1:]), dtype=self._data.dtype)
            bigger[: self.size] = self._data[: self.size]
            self._data = bigger
        self._data[self.size : self.size + n] = torch.from_numpy(np.ascontiguousarray(rows)).to(self._data.dtype)
        self.size += n

    def replace(self, rows: Array) -> None:
        """Hold rows (n, *shape) and no others, in new memory: views of the old ones stay as they are."""
        self._data, self.size = self._data.new_empty((256, *self._data.shape[1:])), 0
        self.append(rows)

    @property
    def rows(self) -> Tensor:
        """(size, *shape), a view."""
        return self._data[: self.size]


class AggregatedDataset:
    """Pairs (s, pi_H(s)) of all humans so far, and for each ensemble member a bag of them.

    A pair enters each member's bag Poisson(1) times when it arrives (online bagging, Oza and Russell): in the limit
    each bag is a bootstrap sample of the data, and it stays one while data keep coming.

    Args:
        obs_shape: shape of an observation.
        action_width: A.
        members: K.
        rng: the seeded stream of bags and batches.
        bootstrap: False: every member sees everything.
        dtype: of the observations in memory: images are kept as bytes.
    """

    def __init__(
        self,
        obs_shape: tuple[int, ...],
        action_width: int,
        members: int,
        rng: np.random.Generator,
        bootstrap: bool = True,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.obs = GrowingArray(obs_shape, dtype)
        self.actions = GrowingArray((action_width,), torch.float32)
        self.bags = [GrowingArray((), torch.int64) for _ in range(members)]
        self.rng, self.bootstrap = rng, bootstrap

    def __len__(self) -> int:
        return self.obs.size

    def add(self, obs: Array, actions: Array) -> None:
        """Append n pairs: obs (n, ...), actions (n, A)."""
        index = np.arange(self.obs.size, self.obs.size + len(obs))
        self.obs.append(obs)
        self.actions.append(actions)
        for bag in self.bags:
            bag.append(np.repeat(index, self.rng.poisson(1.0, len(index))) if self.bootstrap else index)

    def draw(self, size: int) -> NDArray[np.int64]:
        """The rows of an independent batch for each member, drawn from its bag: (K, size).

        Raises:
            ConfigError: there are no data.
        """
        if not len(self):
            raise ConfigError("there are no human data to learn from yet; give offline data or wait for interventions")
        # A bag can be empty only with a handful of pairs; its member then learns from all of them.
        bags = [bag.rows.numpy() if bag.size else np.arange(len(self)) for bag in self.bags]
        draws = self.rng.integers(np.array([[len(bag)] for bag in bags]), size=(len(bags), size))
        return np.stack([bag[draw] for bag, draw in zip(bags, draws, strict=True)])

    def batches(self, size: int) -> tuple[Tensor, Tensor]:
        """An independent batch for each member: obs (K, size, ...), actions (K, size, A). Raises: see `draw`."""
        index = torch.from_numpy(self.draw(size))
        obs, actions = (rows.index_select(0, index.flatten()) for rows in (self.obs.rows, self.actions.rows))
        return obs.unflatten(0, index.shape), actions.unflatten(0, index.shape)

    def state_dict(self) -> dict[str, Any]:
        """All pairs, bags and the random state."""
        return {
            "obs": self.obs.rows.numpy(),
            "actions": self.actions.rows.numpy(),
            "bags": {str(k): bag.rows.numpy() for k, bag in enumerate(self.bags)},
            "rng": rng_state(self.rng),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        for array, rows in [
            (self.obs, state["obs"]), (self.actions, state["actions"]),
            *((bag, state["bags"][str(k)]) for k, bag in enumerate(self.bags)),
        ]:  # fmt: skip
            array.replace(rows)
        set_rng_state(self.rng, state["rng"])
