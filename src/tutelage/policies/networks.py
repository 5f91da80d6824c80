"""From what is observed to the networks that see it: vectors go through MLPs, images through CNNs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tutelage.policies.mlp import BatchedMLP
from tutelage.policies.vision import HEAD, BatchedCNN

Network = BatchedMLP | BatchedCNN
Shape = int | tuple[int, ...]
"""Of an observation: D for a vector, (H, W, 3) for an image."""
LIMIT = 10.0
"""Z-scores of observations are clipped to so many standard deviations."""


def shape_of(obs: Shape) -> tuple[int, ...]:
    """(D,) or (H, W, 3)."""
    return (obs,) if isinstance(obs, int) else tuple(obs)


def stored_as(obs: Shape) -> torch.dtype:
    """How observations are kept in memory: images as the bytes that they are, vectors as float32."""
    return torch.uint8 if len(shape_of(obs)) == 3 else torch.float32


def as_tensor(obs: NDArray[Any]) -> Tensor:
    """Observations as normalisation takes them: images stay bytes, all else becomes float32. Copied only if need be."""
    obs = np.asarray(obs)
    return torch.from_numpy(obs if obs.dtype == np.uint8 else np.asarray(obs, dtype=np.float32))


def normalise(obs: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Z-scores, clipped to 10 standard deviations: of each number of a vector (..., D), of each channel of images."""
    return ((obs - mean) / std).clamp_(-LIMIT, LIMIT)


def hidden_layers(obs: Shape, hidden: tuple[int, ...] | None, plain: tuple[int, ...] = (256, 256)) -> tuple[int, ...]:
    """Widths of the fully connected hidden layers. hidden: as the user wishes; None: `plain`, for images those of B.2."""
    if hidden is not None:
        return hidden
    return HEAD if len(shape_of(obs)) == 3 else plain


def network(
    obs: Shape,
    members: int,
    outputs: int,
    hidden: tuple[int, ...],
    generator: torch.Generator,
    last: Callable[[Tensor], Tensor] | None = None,
    extra: int = 0,
) -> Network:
    """K networks that take normalised observations (K, B, ...) or (B, ...), and `extra` further numbers where asked.

    Raises:
        ConfigError: images that are too small.
    """
    shape = shape_of(obs)
    if len(shape) == 3:
        return BatchedCNN(members, (shape[0], shape[1], shape[2]), outputs, hidden, generator, last, extra)
    return BatchedMLP(members, shape[0] + extra, outputs, hidden, generator, last)
