"""K convolutional networks trained side by side: the policies and critics that see images (appendix B.2)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, elu_

from tutelage.errors import ConfigError
from tutelage.policies.mlp import BatchedMLP

LAYERS = ((24, 5, 2), (36, 5, 2), (48, 5, 2), (64, 3, 1), (64, 3, 1))
"""Channels, kernel and stride of the five convolutions. An image of 64 x 64 becomes 64 numbers."""
HEAD = (100, 50, 10)
"""Widths of the fully connected layers between these numbers and the outputs."""
_PART = 64
"""Images that are looked at together where no gradients are wanted: more would not stay in the cache."""


class BatchedCNN(nn.Module):
    """K independent networks of five convolutions and fully connected layers, with ELU: (K, B, H, W, C) -> (K, B, outputs).

    The convolutions run one member after the other on channels-last images, which on a CPU takes less than half the time of
    one grouped convolution for all; the fully connected layers are batched.

    Args:
        members: K.
        shape: (H, W, C) of an image.
        outputs: width.
        extra: width of what is concatenated to the embedding, such as an action.
        hidden: widths of the fully connected hidden layers.
        generator: draws the initial weights (uniform, He et al. as in torch.nn).
        last: applied to the outputs, such as torch.tanh.

    Raises:
        ConfigError: the image is too small for the convolutions.
    """

    def __init__(
        self,
        members: int,
        shape: tuple[int, int, int],
        outputs: int,
        hidden: tuple[int, ...],
        generator: torch.Generator,
        last: Callable[[Tensor], Tensor] | None = None,
        extra: int = 0,
    ) -> None:
        super().__init__()
        height, width, channels = shape
        self.kernels, self.biases = nn.ParameterList(), nn.ParameterList()
        for out, kernel, stride in LAYERS:
            bound = 1 / math.sqrt(channels * kernel * kernel)
            sizes = (members, out, channels, kernel, kernel), (members, out)
            for parameters, size in zip((self.kernels, self.biases), sizes, strict=True):
                parameters.append(nn.Parameter((torch.rand(size, generator=generator) * 2 - 1) * bound))
            height, width, channels = (height - kernel) // stride + 1, (width - kernel) // stride + 1, out
        if min(height, width) < 1:
            raise ConfigError(f"images of {shape[0]} x {shape[1]} pixels are too small for a policy: it needs 61 x 61")
        self.embedding = height * width * channels
        self.head = BatchedMLP(members, self.embedding + extra, outputs, hidden, generator, last, activation=elu_)

    def forward(self, images: Tensor, extra: Tensor | None = None) -> Tensor:
        """(K, B, H, W, C), or (B, H, W, C) for the same images to all members, and extra (B, E) -> (K, B, outputs)."""
        own = images.dim() == 5
        found = [self._embed(k, images[k] if own else images) for k in range(len(self.kernels[0]))]
        return self.head(torch.stack(found), extra)  # type: ignore[no-any-return]

    def _embed(self, member: int, images: Tensor) -> Tensor:
        """(B, H, W, C) -> (B, embedding), by one member."""
        if not torch.is_grad_enabled() and len(images) > _PART:
            return torch.cat([self._embed(member, part) for part in images.split(_PART)])
        x = images.permute(0, 3, 1, 2)  # HWC in memory is what torch calls channels last: nothing is copied
        for kernels, biases, (_, _, stride) in zip(self.kernels, self.biases, LAYERS, strict=True):
            weights = kernels[member].contiguous(memory_format=torch.channels_last)
            x = elu_(conv2d(x, weights, biases[member], stride))
        return x.flatten(1)
